// The page of a bench: two plots, and what is behind the point that was picked.
"use strict";

const bench = JSON.parse(document.getElementById("bench").textContent);
const megabytes = (count) => (count === null ? "not measured" : `${(count / 1e6).toFixed(count < 1e7 ? 1 : 0)} MB`);
const seconds = (spread) => spread.repeats > 1
  ? `${short(spread.median)} s (quartiles ${short(spread.low)} to ${short(spread.high)}, ${spread.repeats} times)`
  : `${short(spread.median)} s`;
const pareto = (point) => point.pareto === null ? "a repeat with another seed"
  : point.pareto ? "in the Pareto set" : `pointless beside ${point.dominated_by}`;

const PARTS = {
  rendering: {
    facts: (p) => [["time for a picture", seconds(p.seconds)], ["PSNR, held-out photos", `${p.psnr.toFixed(3)} dB`],
      ["quadrature error", `${short(p.quadrature_levels)} levels rms`],
      ["left out of a channel, at most", `${short(p.truncation_bound_levels)} levels`],
      ["peak memory", megabytes(p.peak_memory_bytes)], ["field", megabytes(p.field_bytes)], ["", pareto(p)]],
    command: (p) => (p.options === null ? null : `nerfcli render RUN ${p.options}`.trim()),
    colours: (p) => {
      const s = p.settings;
      if (p.name === "default") return ["default", 6];
      if (p.name.includes("thread")) return ["threads", 3];
      if (p.name.includes("tile")) return ["tile", 4];
      if (p.name.includes("stored")) return ["precision of the file", 5];
      return p.name.includes(",") ? ["both", 2] : s.step !== 1 ? ["step along rays", 0] : ["tolerance", 1];
    },
    x: { label: "seconds for a picture", log: true, of: (p) => p.seconds.median, spread: (p) => p.seconds },
    ys: [
      { name: "quadrature error", label: "distance to the converged rendering, levels of 255 (rms)", log: true, of: (p) => Math.max(p.quadrature_levels, 1e-3), better: -1 },
      { name: "PSNR", label: "PSNR against held-out photos, dB", of: (p) => p.psnr, better: 1, least: 0.05,
        rules: (part) => [{ y: part.converged_psnr, label: "converged: what remains is the field's error" }] },
      { name: "peak memory", label: "peak memory, MB", of: (p) => (p.peak_memory_bytes || 0) / 1e6, better: -1 },
    ],
    pictures: (p, part) => [["render", p.pictures.render], ["held-out photo", part.truth],
      ["distance to the photo, yellow from 64 levels", p.pictures.error],
      ["distance to the converged picture, yellow from 16 levels", p.pictures.quadrature]],
  },
  training: {
    facts: (p) => [["training", `${seconds(p.seconds)}, ${p.steps} steps, ${Math.round(p.samples_per_second / 1000)} k samples/s`],
      ["PSNR, held-out pixels", `${p.psnr.toFixed(2)} dB`], ["quadrature error", `${short(p.quadrature_levels)} levels rms`],
      ["peak memory", megabytes(p.peak_memory_bytes)], ["field", megabytes(p.field_bytes)],
      [`picture of ${p.render_size.join(" x ")}`, seconds(p.render_seconds)],
      ["kernels", p.compiled === null ? "as in this run" : p.compiled ? "compiled" : "plain torch"],
      ["", pareto(p)]],
    command: (p) => (p.options === null ? null : `nerfcli train SCENE --budget ${Math.round(p.seconds.median)}s ${p.options}`.trim()),
    colours: (p) => ({ default: ["default and its seeds", 6], seed: ["default and its seeds", 6], time: ["training time", 0], rows: ["rows of a table", 1],
      batch: ["batch", 4], run: ["this run", 5] })[p.group],
    xs: [
      { name: "training time", label: "seconds of training", log: true, of: (p) => p.seconds.median },
      { name: "field size", label: "size of the field, MB", log: true, of: (p) => p.field_bytes / 1e6 },
      { name: "peak memory", label: "peak memory of the training, MB", log: true, of: (p) => p.peak_memory_bytes / 1e6 },
      { name: "rendering time", label: "seconds for a small picture", log: true, of: (p) => p.render_seconds.median, spread: (p) => p.render_seconds },
    ],
    ys: [{ name: "PSNR", label: "PSNR on held-out pixels, dB", of: (p) => p.psnr, better: 1, least: 0.1,
      bands: (part) => { const d = part.points.find((p) => p.group === "default"); return part.noise_db && d ? [{ low: d.psnr - part.noise_db, high: d.psnr + part.noise_db, label: "within chance of the default" }] : []; } }],
    pictures: (p) => [["render", p.pictures.render], ["held-out photo", p.pictures.truth],
      ["distance to the photo, yellow from 64 levels", p.pictures.error]],
  },
};

function behind(name, point) {
  const part = bench[name], how = PARTS[name], place = document.getElementById(`${name}-point`);
  place.textContent = "";
  place.appendChild(document.createElement("h3")).textContent = point.name;
  const list = place.appendChild(document.createElement("dl"));
  for (const [what, value] of how.facts(point)) {
    const pair = list.appendChild(document.createElement("div"));
    pair.appendChild(document.createElement("dt")).textContent = what || "verdict";
    pair.appendChild(document.createElement("dd")).textContent = value;
  }
  const command = how.command(point);
  if (command !== null) place.appendChild(document.createElement("code")).textContent = command;
  const row = place.appendChild(document.createElement("div"));
  row.className = "pictures";
  for (const [caption, file] of how.pictures(point, part)) {
    if (!(file in bench.pictures)) continue;
    const figure = row.appendChild(document.createElement("figure"));
    const picture = figure.appendChild(document.createElement("img"));
    picture.src = bench.pictures[file];
    picture.alt = `${caption}: ${point.name}`;
    figure.appendChild(document.createElement("figcaption")).textContent = caption;
  }
}

// The points that no other beats in both axes as they are drawn, along x.
function front(points, x, y) {
  let best = -Infinity;
  return [...points].sort((a, b) => x.of(a) - x.of(b) || y.better * (y.of(b) - y.of(a)))
    .filter((p) => y.better * y.of(p) > best && ((best = y.better * y.of(p)), true));
}

function draw(name) {
  const part = bench[name], how = PARTS[name], place = document.getElementById(`${name}-plot`);
  if (!part || !place) return;
  const xs = how.xs || [how.x];
  const state = { x: xs[0], y: how.ys[0], picked: part.points[0].name };
  const choices = document.getElementById(`${name}-choice`);
  const again = () => {
    const { x, y } = state, groups = new Map();
    for (const p of part.points) {
      const [label, colour] = how.colours(p), spread = x.spread ? x.spread(p) : undefined;
      if (!groups.has(label)) groups.set(label, { name: label, colour, marker: "dot", points: [] });
      groups.get(label).points.push({ id: p.name, x: x.of(p), y: y.of(p), low: spread && spread.low, high: spread && spread.high,
        title: p.name, facts: how.facts(p).map(([what, value]) => (what ? `${what}: ${value}` : value)), strong: p.pareto === true });
    }
    const line = front(part.points.filter((p) => p.pareto !== null), x, y).map((p) => ({ id: p.name, x: x.of(p), y: y.of(p) }));
    const drawn = plot(place, { x, y, rules: y.rules ? y.rules(part) : [], bands: y.bands ? y.bands(part) : [],
      series: [{ marker: "line", colour: 6, points: line }, ...groups.values()], pick: (id) => { state.picked = id; location.replace(`#${name}:${encodeURIComponent(id)}`); behind(name, part.points.find((p) => p.name === id)); } });
    drawn.select(state.picked);
  };
  const options = [...xs.filter(() => xs.length > 1).map((x) => ["x", x]), ...how.ys.filter(() => how.ys.length > 1).map((y) => ["y", y])];
  for (const [axis, option] of options) {
    const button = choices.appendChild(document.createElement("button"));
    button.type = "button";
    button.textContent = option.name;
    button.setAttribute("aria-pressed", String(state[axis] === option));
    button.addEventListener("click", () => {
      state[axis] = option;
      for (const other of choices.children) other.setAttribute("aria-pressed", String(other === button));
      again();
    });
  }
  const [at, wanted] = decodeURIComponent(location.hash.slice(1)).split(/:(.*)/s);
  const start = (at === name && part.points.find((p) => p.name === wanted)) || part.points.find((p) => p.name === "default") || part.points[0];
  state.picked = start.name;
  again();
  behind(name, start);
}

draw("rendering");
draw("training");
