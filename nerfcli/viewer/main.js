// The page: what is shown, and what the controls do.
"use strict";

const $ = id => document.getElementById(id);
const WORDS = { colour: "colour", opacity: "opacity", conditional: "mean depth (conditional)", median: "median depth",
  "max-weight": "depth of the heaviest interval (max-weight)", moment: "moment", background: "mean with the background",
  quantile: "quantile", spread: "spread: standard deviation of where light ends",
  disagreement: "disagreement: |median - mean|", coverage: "coverage: training photos that see the surface",
  parallax: "parallax: largest angle between two photos that see it" };
const state = { map: 0, axis: "z", range: [0, 1], minOpacity: 0.5, gains: [1, 1, 1], share: 0.25, photo: -1, wipe: 0.5,
  compare: "wipe", frusta: true, frustumSize: 1, box: null, showBox: false, clip: false, points: [], picking: false,
  keyframes: [], playing: false, scale: 1, dragged: null };

function trouble(text) {
  $("trouble").textContent = text;
  $("trouble").hidden = false;
  document.body.dataset.state = "trouble";
}

async function start() {
  let scene;
  try {
    scene = await readScene();
  } catch (error) {
    trouble(`This page cannot be shown: ${error.message}. Make it again with nerfcli export RUN --to page --overwrite.`);
    return;
  }
  if (scene.live) startLive(scene);
  else startHere(scene);
}

/** Draw on this device; the page, or nothing where that is not possible. */
function startHere(scene) {
  const canvas = $("field");
  canvas.addEventListener("webglcontextlost", event => {
    event.preventDefault();
    trouble("The browser lost its graphics context; the page continues once it is restored.");
  });
  const begin = () => {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    const missing = whatIsMissing(gl);
    if (missing) return trouble(missing);
    try {
      return new Renderer(gl, scene, { trace: $("trace").textContent, show: $("show").textContent });
    } catch (error) {
      return trouble(`This page cannot be shown: ${error.message}`);
    }
  };
  const renderer = begin();
  if (!renderer) return;
  const page = show(scene, renderer);
  canvas.addEventListener("webglcontextrestored", () => {
    const again = begin();
    if (!again) return;
    $("trouble").hidden = true;
    page.restart(again);
  });
  return page;
}

function show(scene, renderer) {
  const page = new Page(scene, renderer);
  globalThis.nerfcliPage = page;  // for the browser's console, and for tests
  document.body.dataset.state = "ready";
  if (location.hash === "#check") page.check();
  return page;
}

class Page {
  constructor(scene, renderer) {
    this.scene = scene;
    this.unit = scene.unit === "metre" ? "m" : "units";
    this.maps = MAPS.filter(name => scene.seen || !["coverage", "parallax"].includes(name));
    state.box = [...scene.box];
    this.walk = new Walk(scene, () => this.moved(), (x, y) => this.pointAt(x, y)?.middle || null);
    this.overlay = new Overlay($("over"), scene);
    this.controls();
    this.restart(renderer);
    this.goHome();
    if (location.hash.length > 1) this.fromAddress();
    addEventListener("hashchange", () => { if (location.hash !== this.address) this.fromAddress(); });
    new ResizeObserver(() => this.request()).observe($("stage"));
    let last = performance.now();
    const frame = now => {
      this.walk.step(Math.min(0.1, (now - last) / 1000));
      if (state.playing) this.playOn((now - last) / 1000);
      last = now;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  restart(renderer) {
    this.renderer = renderer;
    this.schedule = renderer.schedule({
      shown: (view, fine, coarse) => this.present(view, fine, coarse),
      rested: (view, fine) => this.rested(view, fine),
    });
    this.request();
  }

  /** The view on the screen, in pixels of the drawing. */
  view() {
    const stage = $("stage"), share = state.scale;
    const width = Math.max(16, Math.round(stage.clientWidth * share));
    const height = Math.max(16, Math.round(stage.clientHeight * share));
    return { ...this.walk.view(width, height), share: state.share, box: state.clip ? state.box : null };
  }

  request() {
    if (!this.schedule) return;
    this.done = false;
    const view = this.view(), canvas = $("field");
    if (canvas.width !== view.width || canvas.height !== view.height) Object.assign(canvas, { width: view.width, height: view.height });
    this.schedule.want(view);
    this.decorate();
  }

  moved() {
    if (state.photo >= 0) this.leavePhoto();
    this.request();
  }

  present(view, fine, coarse) {
    this.drawn = { view, fine, coarse: coarse || fine };
    this.renderer.present(fine, this.drawn.coarse, view, { ...state, gains: this.gains() });
    this.decorate();
    $("status").textContent = this.renderer.full ? "" : "half precision on this device: three digits of depths";
  }

  rested(view, fine) {
    this.probe = this.renderer.picture({ ...view, ...this.small(view) });
    if (MAPS[state.map] !== "colour" && $("auto").checked) this.findRange();
    this.present(view, fine, fine);
    if (state.photo >= 0 && state.compare === "error") this.signedError(view, fine);
    this.address = `#${this.walk.fragment()}&m=${MAPS[state.map]}&a=${state.axis}&s=${state.share}`;
    try {
      history.replaceState(null, "", this.address);
    } catch { /* some browsers refuse it for files: the address then stays as it is */ }
    this.done = true;
    document.body.dataset.rested = String(Number(document.body.dataset.rested || 0) + 1);
  }

  /** A view of 64 pixels across with the same rays, for ranges and for what hides cameras. */
  small(view) {
    const factor = 64 / view.width;
    return { width: 64, height: Math.max(1, Math.round(view.height * factor)), lens: view.lens.map(v => v * factor) };
  }

  gains() {
    const own = state.photo >= 0 ? this.scene.photos[state.photo].log_gains : [0, 0, 0], stops = Number($("ev").value);
    return own.map(gain => Math.exp(gain) * 2 ** stops);
  }

  /** Which share of the probe's map is where: the colours go from its 1st to its 99th percentile. */
  findRange() {
    const map = MAPS[state.map], view = { ...this.view() }, small = { ...view, ...this.small(view) }, values = [];
    for (let i = 0; i < this.probe.width * this.probe.height; i++) {
      const cosine = state.axis === "z" ? cosineAt(small, i % this.probe.width, Math.floor(i / this.probe.width)) : 1;
      values.push(valueOf(map, this.probe, i, { factor: cosine / this.scene.training_from_scene.scale,
        farthest: this.scene.march.far, minOpacity: state.minOpacity }));
    }
    const sorted = values.filter(Number.isFinite).sort((a, b) => a - b);
    const rank = share => sorted[Math.round(share * (sorted.length - 1))] ?? share;
    const distance = !["spread", "disagreement"].includes(map);
    state.range = COUNTS[map]?.[0] || [distance ? rank(0.01) : 0, rank(0.99)];
    $("low").value = Number(state.range[0].toPrecision(4));
    $("high").value = Number(state.range[1].toPrecision(4));
    this.legend();
  }

  legend() {
    const map = MAPS[state.map], context = $("bar").getContext("2d"), bar = context.createImageData(256, 1);
    $("legend").hidden = map === "colour";
    for (let i = 0; i < 256; i++) bar.data.set([...this.scene.colours.slice(3 * i, 3 * i + 3), 255], 4 * i);
    context.putImageData(bar, 0, 0);
    const [low, high] = state.range, [, unit] = COUNTS[map] || [null, ` ${this.unit}`];
    $("ticks").replaceChildren(...[0, 0.25, 0.5, 0.75, 1].map(share => {
      const tick = document.createElement("span");
      tick.textContent = `${Number((low + share * (high - low)).toPrecision(3))}${share === 1 ? unit : ""}`;
      return tick;
    }));
    const axis = COUNTS[map] ? "" : state.axis === "z" ? ", along the optical axis" : ", along the ray";
    const share = map === "quantile" ? ` ${state.share}` : "";
    const unitWords = COUNTS[map] ? "" : this.scene.unit === "metre" ? ", in metres" : ", in units of the scene";
    $("meaning").textContent = `${WORDS[map]}${share}${axis}${unitWords}; hatched: no value`;
  }

  // Overlay and photos

  decorate() {
    const stage = $("stage"), width = stage.clientWidth, height = stage.clientHeight;
    const view = this.walk.view(width, height);
    this.overlay.draw(view, state, tip => this.isVisible(tip, width, height));
    this.placePhoto(view);
  }

  /** Whether nothing of the scene stands before a point at a pixel, as far as the last probe shows. */
  isVisible([x, y, z], width, height) {
    const { probe } = this;
    if (!probe) return true;
    const column = Math.floor(x / width * probe.width), line = Math.floor(y / height * probe.height);
    if (column < 0 || line < 0 || column >= probe.width || line >= probe.height) return true;
    const median = probe.ends[4 * (line * probe.width + column) + 2];
    return median < 0 || z < 1.02 * median / this.scene.training_from_scene.scale;
  }

  goTo(index) {
    const { photos } = this.scene, photo = photos[index];
    if (!photo) return;
    const stage = $("stage"), scale = Math.min(stage.clientWidth / photo.width, stage.clientHeight / photo.height);
    state.photo = index;
    Object.assign(this.walk, { place: [...photo.place], turn: photo.turn.map(row => [...row]),
      fov: 2 * Math.atan(stage.clientHeight / 2 / (photo.lens[1] * scale)) });
    $("photo-name").textContent = `${photo.name}${photo.split === "test" ? " (held out)" : ""}`;
    if (photo.picture) $("photo").src = photo.picture;
    $("error").hidden = true;
    this.request();
  }

  leavePhoto() {
    state.photo = -1;
    $("photo-name").textContent = "none";
    $("error").hidden = true;
  }

  nextPhoto(step) {
    const count = this.scene.photos.length;
    if (count) this.goTo(state.photo < 0 ? (step > 0 ? 0 : count - 1) : (state.photo + step + count) % count);
  }

  /** Where the photo lies on the stage: pixels left, top, width, height. */
  photoBox(view) {
    const photo = this.scene.photos[state.photo], scale = view.lens[1] / photo.lens[1];
    return { left: view.lens[2] - photo.lens[2] * scale, top: view.lens[3] - photo.lens[3] * scale,
      width: photo.width * scale, height: photo.height * scale };
  }

  placePhoto(view) {
    const there = state.photo >= 0 && Boolean(this.scene.photos[state.photo].picture);
    const wiping = there && state.compare === "wipe";
    $("photo").hidden = $("wipe").hidden = !wiping;
    if (!there || state.compare !== "error") $("error").hidden = true;
    if (!there) return;
    const box = this.photoBox(view);
    for (const id of ["photo", "error"]) for (const name in box) $(id).style[name] = `${box[name]}px`;
    $("photo").style.clipPath = `inset(0 ${100 * (1 - state.wipe)}% 0 0)`;
    $("wipe").style.left = `${box.left + state.wipe * box.width}px`;
    $("wipe").setAttribute("aria-valuenow", Math.round(100 * state.wipe));
  }

  /** Rendering minus photo, mean of the channels: red is too bright, blue too dark, full colour from 0.2 on. */
  async signedError(view, fine) {
    const photo = this.scene.photos[state.photo], image = $("photo");
    if (!photo?.picture) return;
    const box = this.photoBox(view);
    await image.decode();
    const width = image.naturalWidth, height = image.naturalHeight, canvas = $("error");
    Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    const pixels = context.getImageData(0, 0, width, height), [colour] = this.renderer.read(fine), gains = this.gains();
    const each = box.width / width;
    let sum = 0, count = 0;
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const i = 4 * (y * width + x), u = Math.floor(box.left + (x + 0.5) * each), v = Math.floor(box.top + (y + 0.5) * each);
      if (u < 0 || v < 0 || u >= view.width || v >= view.height) { pixels.data[i + 3] = 0; continue; }
      let off = 0;
      for (let c = 0; c < 3; c++) {
        const rendered = withGain(colour[4 * (v * view.width + u) + c], gains[c]), given = pixels.data[i + c] / 255;
        off += (rendered - given) / 3;
        sum += (rendered - given) ** 2;
        count++;
      }
      const level = Math.max(-1, Math.min(1, off / 0.2)), pale = 255 * (1 - Math.abs(level));
      pixels.data.set(level > 0 ? [255, pale, pale, 255] : [pale, pale, 255, 255], i);
    }
    context.putImageData(pixels, 0, 0);
    canvas.hidden = state.compare !== "error";
    const psnr = -10 * Math.log10(sum / Math.max(1, count));
    $("status").textContent = `rendering minus photo: red too bright, blue too dark, full colour from 0.2; `
      + `${psnr.toFixed(1)} dB at ${width} x ${height} pixels`;
  }

  // Measuring

  /** The point of the scene under a pixel of the stage, with where 5 and 95 % of the light have ended; null for none. */
  pointAt(x, y) {
    const view = this.walk.view($("stage").clientWidth, $("stage").clientHeight);
    const seen = this.renderer.probe({ ...view, share: state.share, box: state.clip ? state.box : null }, x, y);
    if (seen.median < 0) return null;
    const local = unit([(Math.floor(x) + 0.5 - view.lens[2]) / view.lens[0], (Math.floor(y) + 0.5 - view.lens[3]) / view.lens[1], 1]);
    const along = times(view.turn, local);
    const at = distance => distance < 0 ? null : added(view.place, along, distance / this.scene.training_from_scene.scale);
    return { middle: at(seen.median), low: at(seen.low), high: at(seen.high) };
  }

  pick(x, y) {
    const point = this.pointAt(x, y);
    if (!point) {
      $("distance").textContent = "Less than half of the light is absorbed there, so there is no point to measure from.";
      return;
    }
    state.points = state.points.length === 2 ? [point] : [...state.points, point];
    if (state.points.length === 2) $("distance").textContent = this.distanceInWords(...state.points);
    else $("distance").textContent = `First point at ${point.middle.map(v => v.toPrecision(5)).join(", ")} ${this.unit}.`;
    this.decorate();
  }

  distanceInWords(a, b) {
    const apart = norm(added(a.middle, b.middle, -1)), ends = ["low", "middle", "high"];
    const all = ends.flatMap(i => ends.map(k => a[i] && b[k] ? norm(added(a[i], b[k], -1)) : NaN)).filter(Number.isFinite);
    const open = !a.high || !b.high ? " or more: not all light is absorbed there" : "";
    return `${apart.toPrecision(4)} ${this.unit}; ${Math.min(...all).toPrecision(4)} to ${Math.max(...all).toPrecision(4)}${open} `
      + "over the range in which 5 to 95 % of the light is absorbed";
  }

  // Box and path

  boxChanged() {
    const inputs = [...$("numbers").children];
    state.box.forEach((value, i) => { if (inputs[i] !== document.activeElement) inputs[i].value = Number(value.toPrecision(5)); });
    $("numbers").hidden = $("command-line").hidden = !state.showBox;
    const listed = state.box.map(v => Number(v.toPrecision(6))).join(",");
    $("command").textContent = `nerfcli export ${this.scene.run_in_shell} --to mesh --box=${listed}`;
    if (state.clip) this.request();
    else this.decorate();
  }

  pathSettings() {
    const number = id => Number($(id).value);
    return { seconds: number("seconds") || 2, fps: number("fps") || 24, width: number("width") || 1280, height: number("height") || 720 };
  }

  listKeys() {
    $("keys").replaceChildren(...state.keyframes.map((key, index) => {
      const item = document.createElement("li"), words = [["go", () => this.walk.stand(key.place, key.turn, key.fov)],
        ["up", () => state.keyframes.splice(Math.max(0, index - 1), 0, state.keyframes.splice(index, 1)[0])],
        ["remove", () => state.keyframes.splice(index, 1)]];
      item.textContent = key.place.map(v => v.toPrecision(3)).join(", ");
      for (const [word, act] of words) {
        const button = document.createElement("button");
        button.textContent = word;
        button.onclick = () => { act(); this.listKeys(); this.decorate(); };
        item.append(button);
      }
      return item;
    }));
    $("render-line").hidden = !state.keyframes.length;
    $("render").textContent = `nerfcli render ${this.scene.run_in_shell} --cameras camera_path.json --video`;
  }

  play() {
    state.playing = !state.playing && state.keyframes.length > 1;
    this.time = 0;
    $("play").textContent = state.playing ? "Stop (Space)" : "Play (Space)";
  }

  playOn(seconds) {
    this.time += seconds / this.pathSettings().seconds;
    if (this.time > state.keyframes.length - 1) return this.play();
    const { place, turn, fov } = viewAlong(state.keyframes, this.time);
    this.walk.stand(place, turn, fov);
  }

  savePath() {
    if (!state.keyframes.length) return;
    const text = JSON.stringify(cameraPath(state.keyframes, this.pathSettings()), null, 1), link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
    link.download = "camera_path.json";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  async check() {
    // The proof is of the newest field, which this page may not draw yet.
    while (this.scene.live && await fetchProof(this.scene) !== this.scene.version) await drawNewest(this);
    const found = compare(this.renderer, this.scene), table = $("checked");
    const rows = [["map", "largest", "99 %", "rms"], ...Object.entries(found).map(([map, f]) =>
      [map, ...[f.largest, f.percentile_99, f.rms].map(v => v.toExponential(1))])];
    table.replaceChildren(...rows.map(cells => {
      const row = document.createElement("tr");
      row.append(...cells.map(text => Object.assign(document.createElement("td"), { textContent: text })));
      return row;
    }));
    table.hidden = false;
    table.dataset.found = JSON.stringify(found);
  }

  goHome() {
    const { home } = this.scene;
    this.walk.stand(home.place, home.turn, home.fov);
  }

  fromAddress() {
    const parameters = new URLSearchParams(location.hash.slice(1)), map = this.maps.indexOf(parameters.get("m"));
    const share = Number(parameters.get("s"));
    if (["z", "ray"].includes(parameters.get("a"))) $("axis").value = state.axis = parameters.get("a");
    if (share >= 0.01 && share <= 0.99) $("share").value = state.share = share;
    if (map >= 0) this.choose(map);
    this.walk.read(parameters);
  }

  choose(map) {
    state.map = map;
    const name = MAPS[map], depth = name !== "colour" && !COUNTS[name];
    $("map").value = name;
    $("axis-line").hidden = !depth;
    $("share-line").hidden = name !== "quantile";
    $("range-line").hidden = $("auto-line").hidden = name === "colour";
    this.legend();
    this.request();
  }

  controls() {
    const { scene } = this, on = (id, name, act) => $(id).addEventListener(name, act);
    document.title = $("title").textContent = scene.run;
    $("about").textContent = scene.about;
    for (const name of this.maps) $("map").add(new Option(WORDS[name], name));
    on("map", "change", () => this.choose(MAPS.indexOf($("map").value)));
    on("axis", "change", () => { state.axis = $("axis").value; this.legend(); this.request(); });
    $("share").value = state.share;
    on("share", "change", () => { state.share = Math.min(0.99, Math.max(0.01, Number($("share").value) || 0.5)); this.legend(); this.request(); });
    for (const [i, id] of ["low", "high"].entries()) on(id, "change", () => {
      state.range[i] = Number($(id).value);
      $("auto").checked = false;
      this.legend();
      this.request();
    });
    on("auto", "change", () => this.request());
    on("ev", "input", () => { $("ev-value").textContent = `${$("ev").value} EV`; this.again(); });
    on("scale", "change", () => { state.scale = Number($("scale").value); this.request(); });
    on("frusta", "change", () => { state.frusta = $("frusta").checked; this.decorate(); });
    on("frustum-size", "input", () => { state.frustumSize = Number($("frustum-size").value); this.decorate(); });
    on("previous", "click", () => this.nextPhoto(-1));
    on("next", "click", () => this.nextPhoto(1));
    $("compare").value = state.compare;
    on("compare", "change", () => { state.compare = $("compare").value; this.request(); });
    const slide = event => {
      const view = this.walk.view($("stage").clientWidth, $("stage").clientHeight), box = this.photoBox(view);
      const x = event.clientX - $("stage").getBoundingClientRect().left;
      state.wipe = Math.min(1, Math.max(0, (x - box.left) / box.width));
      this.decorate();
    };
    on("wipe", "pointerdown", event => $("wipe").setPointerCapture(event.pointerId));
    on("wipe", "pointermove", event => { if (event.buttons) slide(event); });
    on("wipe", "keydown", event => {
      const step = { ArrowLeft: -0.05, ArrowRight: 0.05 }[event.key];
      if (!step) return;
      event.stopPropagation();
      state.wipe = Math.min(1, Math.max(0, state.wipe + step));
      this.decorate();
    });
    on("measure", "click", () => this.press("measure", state.picking = !state.picking));
    on("forget", "click", () => { state.points = []; $("distance").textContent = ""; this.decorate(); });
    on("box", "click", () => { this.press("box", state.showBox = !state.showBox); this.boxChanged(); });
    on("clip", "change", () => { state.clip = $("clip").checked; this.request(); });
    for (let i = 0; i < 6; i++) {
      const input = Object.assign(document.createElement("input"), { type: "number", step: "any",
        title: `${i < 3 ? "low" : "high"} ${"xyz"[i % 3]}, ${this.unit}` });
      input.addEventListener("change", () => { if (Number.isFinite(input.valueAsNumber)) state.box[i] = input.valueAsNumber; this.boxChanged(); });
      $("numbers").append(input);
    }
    on("add", "click", () => this.addKey());
    on("play", "click", () => this.play());
    on("save", "click", () => this.savePath());
    on("open", "change", async () => {
      try {
        state.keyframes = keyframesOf(await $("open").files[0].text());
      } catch (error) {
        $("status").textContent = `This is no camera path: ${error.message}`;
      }
      this.listKeys();
      this.decorate();
    });
    for (const button of document.querySelectorAll(".copy")) {
      button.onclick = () => navigator.clipboard?.writeText($(button.dataset.of).textContent);
    }
    on("check", "click", () => this.check());
    on("fold", "click", () => { $("panel").classList.toggle("folded"); });
    this.walk.listen($("field"), event => this.taken(event));
    on("field", "pointermove", event => this.dragBox(event));
    on("field", "pointerup", () => { state.dragged = null; });
    addEventListener("keydown", event => this.key(event));
    this.choose(0);
  }

  press(id, down) { $(id).setAttribute("aria-pressed", String(down)); }

  again() { if (this.drawn) this.present(this.drawn.view, this.drawn.fine, this.drawn.coarse); }

  addKey() {
    const { place, turn, fov } = this.walk;
    state.keyframes.push({ place: [...place], turn: turn.map(row => [...row]), fov });
    this.listKeys();
    this.decorate();
  }

  /** Whether a press on the picture is for a handle of the box, a measured point, or a camera. */
  taken(event) {
    $("field").focus();
    const x = event.offsetX, y = event.offsetY;
    if (event.button) return false;
    if (state.picking) {
      this.pick(x, y);
      return true;
    }
    const handle = this.overlay.handleAt(x, y);
    if (handle) {
      state.dragged = { ...handle, from: [x, y], value: state.box[handle.face] };
      $("field").setPointerCapture(event.pointerId);
      return true;
    }
    const photo = state.frusta ? this.overlay.photoAt(x, y) : -1;
    if (photo >= 0) this.goTo(photo);
    return photo >= 0;
  }

  dragBox(event) {
    const { dragged } = state;
    if (!dragged) return;
    const [a, b] = dragged.along, length = a * a + b * b;
    if (!length) return;
    let value = dragged.value + ((event.offsetX - dragged.from[0]) * a + (event.offsetY - dragged.from[1]) * b) / length;
    const other = state.box[(dragged.face + 3) % 6];
    value = dragged.face < 3 ? Math.min(value, other) : Math.max(value, other);
    state.box[dragged.face] = value;
    this.boxChanged();
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select, textarea")) return;
    const acts = { "[": () => this.nextPhoto(-1), "]": () => this.nextPhoto(1), p: () => this.addKey(), m: () => $("measure").click(),
      b: () => $("box").click(), home: () => { this.goHome(); }, " ": () => { event.preventDefault(); this.play(); } };
    if (/^[0-9]$/.test(event.key)) this.choose(event.key === "0" ? 9 : Number(event.key) - 1);
    else acts[event.key.toLowerCase()]?.();
  }
}

function withGain(value, gain) {
  if (gain === 1) return value;
  const light = (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4) * gain;
  return Math.min(1, light <= 0.0031308 ? light * 12.92 : 1.055 * light ** (1 / 2.4) - 0.055);
}

start();
