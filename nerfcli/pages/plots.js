// Plots of points in SVG: axes, series, error bars; hover shows what a point is, click or Enter picks it.
// Our own two hundred lines, because a plotting library inside each page would weigh megabytes (plotly.js 3 to 4 MB).
"use strict";

const SVG = "http://www.w3.org/2000/svg";

function svg(name, attributes, parent) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (parent) parent.appendChild(element);
  return element;
}

// Numbers at which an axis is labelled, inside [low, high].
function ticks(low, high, log) {
  const marks = [];
  if (log && high / low >= 8) {
    for (let decade = Math.floor(Math.log10(low)); decade <= Math.log10(high); decade++)
      for (const digit of high / low > 300 ? [1] : [1, 2, 5]) marks.push(digit * 10 ** decade);
  } else {
    const rough = (high - low) / 5, unit = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find((factor) => factor * unit >= rough) * unit;
    for (let index = Math.ceil(low / step); index * step <= high; index++) marks.push(index * step);
  }
  return marks.filter((mark) => mark >= low && mark <= high).map((mark) => Number(mark.toPrecision(12)));
}

// A few digits, without exponents where people read numbers.
function short(value) {
  if (value === 0 || (Math.abs(value) >= 1e-3 && Math.abs(value) < 1e6)) return String(Number(value.toPrecision(4)));
  return value.toExponential(1);
}

// The range of an axis with room at both ends; never of length 0.
function range(values, log, least) {
  let low = Math.min(...values), high = Math.max(...values);
  if (log) {
    const room = Math.max(Math.log10(high / low) * 0.07, 0.03);
    return [low / 10 ** room, high * 10 ** room];
  }
  const room = Math.max((high - low) * 0.08, least || Math.abs(high) * 0.02 || 1);
  return [low - room, high + room];
}

// Draw into an element.
//   spec.x, spec.y: {label, log, least}; least: room at the ends at least, in the axis's unit
//   spec.series: [{name, marker: "dot" | "line", points: [{id, x, y, low, high, title, facts: [text], strong}]}]
//   spec.rules: [{y, label}] horizontal lines; spec.bands: [{low, high, label}] along y
//   spec.pick(id): called when a point is chosen
// Returns {select(id)}.
function plot(element, spec) {
  element.textContent = "";
  element.classList.add("plot");
  const width = 1040, height = 420, left = 66, right = 16, top = 14, bottom = 46;
  const points = spec.series.flatMap((series) => series.points);
  const rules = spec.rules || [], bands = spec.bands || [];
  const [x0, x1] = range(points.flatMap((p) => [p.x, p.low ?? p.x, p.high ?? p.x]), spec.x.log, spec.x.least);
  const [y0, y1] = range([...points.map((p) => p.y), ...rules.map((r) => r.y),
    ...bands.flatMap((b) => [b.low, b.high])], spec.y.log, spec.y.least);
  const share = (value, low, high, log) =>
    log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
  const column = (value) => left + share(value, x0, x1, spec.x.log) * (width - left - right);
  const row = (value) => height - bottom - share(value, y0, y1, spec.y.log) * (height - top - bottom);

  const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": `${spec.y.label} against ${spec.x.label}` }, element);
  for (const mark of ticks(x0, x1, spec.x.log)) {
    svg("line", { x1: column(mark), x2: column(mark), y1: top, y2: height - bottom, class: "gridline" }, root);
    svg("text", { x: column(mark), y: height - bottom + 18, "text-anchor": "middle" }, root).textContent = short(mark);
  }
  for (const mark of ticks(y0, y1, spec.y.log)) {
    svg("line", { x1: left, x2: width - right, y1: row(mark), y2: row(mark), class: "gridline" }, root);
    svg("text", { x: left - 8, y: row(mark) + 4, "text-anchor": "end" }, root).textContent = short(mark);
  }
  svg("text", { x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle", class: "axis" }, root).textContent = spec.x.label;
  svg("text", { x: -(top + height - bottom) / 2, y: 14, "text-anchor": "middle", transform: "rotate(-90)", class: "axis" }, root).textContent = spec.y.label;
  for (const band of bands) {
    svg("rect", { x: left, width: width - left - right, y: row(band.high), height: Math.max(1, row(band.low) - row(band.high)), class: "band" }, root);
    svg("text", { x: left + 6, y: row(band.high) - 5 }, root).textContent = band.label;
  }
  for (const rule of rules) {
    svg("line", { x1: left, x2: width - right, y1: row(rule.y), y2: row(rule.y), class: "rule" }, root);
    svg("text", { x: width - right - 4, y: row(rule.y) - 5, "text-anchor": "end" }, root).textContent = rule.label;
  }

  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  element.appendChild(tip);
  const show = (point) => {
    tip.textContent = "";
    const head = document.createElement("b");
    head.textContent = point.title;
    tip.appendChild(head);
    for (const fact of point.facts || []) tip.appendChild(document.createElement("div")).textContent = fact;
    tip.hidden = false;
    const scale = root.getBoundingClientRect().width / width;
    const atLeft = column(point.x) * scale, beyond = atLeft + 14 + tip.offsetWidth > element.clientWidth;
    tip.style.left = `${Math.max(0, beyond ? atLeft - tip.offsetWidth - 14 : atLeft + 14)}px`;
    tip.style.top = `${Math.max(0, row(point.y) * scale - tip.offsetHeight / 2)}px`;
  };

  const markers = new Map();
  let picked = null;
  const select = (id) => {
    if (picked !== null && markers.has(picked)) markers.get(picked).classList.remove("picked");
    picked = id;
    if (markers.has(id)) markers.get(id).classList.add("picked");
  };
  spec.series.forEach((series, number) => {
    const colour = `s${series.colour ?? number}`;
    if (series.marker === "line" && series.points.length > 1) {
      const path = series.points.map((p, i) => `${i ? "L" : "M"}${column(p.x).toFixed(1)} ${row(p.y).toFixed(1)}`).join("");
      svg("path", { d: path, class: `line ${colour}` }, root);
    }
    if (series.marker === "line" && !series.pickable) return;
    for (const point of series.points) {
      const group = svg("g", { class: `point ${colour}${point.strong ? " strong" : ""}`, tabindex: 0, role: "button", "aria-label": point.title, "data-id": point.id }, root);
      if (point.low !== undefined) svg("line", { x1: column(point.low), x2: column(point.high), y1: row(point.y), y2: row(point.y), class: "spread" }, group);
      svg("circle", { cx: column(point.x), cy: row(point.y), r: 13, class: "reach" }, group);
      svg("circle", { cx: column(point.x), cy: row(point.y), r: point.strong ? 6.5 : 5, class: "mark" }, group);
      group.addEventListener("pointerenter", () => show(point));
      group.addEventListener("pointerleave", () => { tip.hidden = true; });
      group.addEventListener("focus", () => show(point));
      group.addEventListener("blur", () => { tip.hidden = true; });
      const pick = () => { select(point.id); if (spec.pick) spec.pick(point.id); };
      group.addEventListener("click", pick);
      group.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); pick(); } });
      markers.set(point.id, group);
    }
  });

  const named = spec.series.filter((series) => series.name);
  if (named.length > 1) {
    const legend = element.appendChild(document.createElement("div"));
    legend.className = "legend";
    named.forEach((series) => {
      const entry = legend.appendChild(document.createElement("span"));
      entry.className = `s${series.colour ?? spec.series.indexOf(series)}`;
      entry.textContent = series.name;
    });
  }
  return { select };
}
