// Pictures by the server's CPU, for devices without a graphics card: what `Renderer` and `Schedule` are otherwise.
// A picture is a stack of layers, coarse to fine; until the first layer of a new view comes, the last one is warped.
"use strict";

const NUMBERS = 12, HEAD = 32, WARP_PX = 400, FAR = 1e6;

class Remote {
  constructor(scene, canvas) {
    Object.assign(this, { scene, canvas, full: true, layers: [], wanted: null, running: false });
    this.context = canvas.getContext("2d");
    this.client = Array.from(crypto.getRandomValues(new Uint8Array(8)), v => v.toString(16)).join("");
    this.version = 0;
    this.latencies = [];  // milliseconds from a motion to its first picture, for tests
  }

  schedule(callbacks) {
    Object.assign(this, callbacks);
    return this;
  }

  /** Show a view; the one before is given up as soon as something of it was seen. */
  want(view) {
    this.wanted = { ...view, asked: performance.now() };
    if (this.layers.length && !sameView(view, this.view)) this.warp(view);
    if (this.seen) this.request?.abort();
    if (!this.running) this.run();
  }

  async run() {
    this.running = true;
    while (this.wanted) {
      const view = this.wanted;
      this.wanted = null;
      try {
        await this.draw(view);
      } catch (error) {
        if (error.name === "AbortError") continue;
        $("status").textContent = `no picture from the server: ${error.message}`;
        await new Promise(resolve => setTimeout(resolve, 1000));
        this.wanted ||= view;
      }
    }
    this.running = false;
  }

  async draw(view) {
    const version = this.version;
    if (this.complete && version === this.drawnVersion && sameView(view, this.view)) return this.rested(view, this);
    this.request = new AbortController();
    this.seen = this.complete = false;
    const { place, turn, lens, width, height, share } = view;
    const body = JSON.stringify({ client: this.client, view: { place, turn, lens, width, height, share } });
    const answer = await fetch("picture", { method: "POST", body, signal: this.request.signal });
    if (!answer.ok) throw new Error(await answer.text());
    const reader = answer.body.getReader(), store = new Store();
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      store.add(value);
      for (let record; (record = store.record());) {
        if (!this.seen) {
          this.begin(view, version);
          this.latencies.push(performance.now() - view.asked);
        }
        this.place(record);
      }
      if (this.seen) this.shown(view, this, this);
      if (this.seen && this.wanted) return this.request.abort();
    }
    this.complete = this.layers.at(-1)?.stride === 1 && this.layers.at(-1).left === 0;
    if (this.complete && !this.wanted) this.rested(view, this);
  }

  begin(view, version) {
    this.view = view;
    this.drawnVersion = version;
    this.layers = [];
    this.seen = true;
  }

  /** Put a tile into the layer of its stride. */
  place({ stride, x, y, width, height, pictureWidth, pictureHeight, numbers }) {
    let layer = this.layers.at(-1);
    if (!layer || layer.stride !== stride) {
      layer = new Layer(stride, pictureWidth, pictureHeight);
      this.layers.push(layer);
    }
    const row = 4 * width;
    ["colour", "ends", "shares"].forEach((name, plane) => {
      for (let v = 0; v < height; v++) {
        const from = (plane * height + v) * row;
        layer[name].set(numbers.subarray(from, from + row), 4 * ((y + v) * pictureWidth + x));
      }
    });
    layer.left -= width * height;
    layer.fresh.push([x, y, width, height]);
    this.still = null;
  }

  /** Show the layers, the coarse ones where the finer ones have not come yet. */
  present(fine, coarse, view, look) {
    const { context, canvas } = this, key = JSON.stringify([look.map, look.axis, look.range, look.gains]);
    if (!this.layers.length) return;
    for (const layer of this.layers) {
      if (layer.key !== key) layer.fresh = [[0, 0, layer.width, layer.height]];
      layer.key = key;
      for (const tile of layer.fresh.splice(0)) this.colour(layer, tile, look);
    }
    context.imageSmoothingEnabled = look.map === 0;
    context.imageSmoothingQuality = "medium";
    for (const { canvas: picture, stride, width, height } of this.layers) {
      context.drawImage(picture, 0, 0, width * stride, height * stride);
    }
    this.look = look;
    canvas.dataset.stride = this.layers.at(-1).stride;
  }

  /** Colours of a tile of a layer, as show.glsl makes them; clear where nothing has come yet. */
  colour(layer, [left, top, width, height], look) {
    const { scene } = this, pixels = new ImageData(width, height), map = MAPS[look.map];
    const lens = this.view.lens.map(v => v / layer.stride), where = { farthest: scene.march.far, minOpacity: look.minOpacity };
    const factor = look.map === 1 ? 1 : 1 / scene.training_from_scene.scale, [low, high] = look.range;
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const i = (top + y) * layer.width + left + x, o = 4 * (y * width + x);
      if (layer.colour[4 * i + 3] < 0) continue;
      pixels.data[o + 3] = 255;
      if (look.map === 0) {
        for (let c = 0; c < 3; c++) pixels.data[o + c] = 255 * withGain(layer.colour[4 * i + c], look.gains[c]);
        continue;
      }
      where.factor = factor * (look.axis === "z" && look.map !== 1 ? cosineAt({ lens }, left + x, top + y) : 1);
      const value = valueOf(map, layer, i, where);
      if (Number.isNaN(value)) {
        const grey = ((left + x >> 2) + (top + y >> 2)) & 1 ? 161 : 112;
        for (let c = 0; c < 3; c++) pixels.data[o + c] = grey;
        continue;
      }
      const level = Math.round(255 * Math.max(0, Math.min(1, (value - low) / Math.max(high - low, 1e-30))));
      for (let c = 0; c < 3; c++) pixels.data[o + c] = scene.colours[3 * level + c];
    }
    layer.context.putImageData(pixels, left, top);
  }

  /** The numbers at a pixel of the last view: the finest layer that has it, and the index there. */
  at(x, y) {
    for (const layer of [...this.layers].reverse()) {
      const i = Math.min(layer.height - 1, Math.floor(y / layer.stride)) * layer.width
        + Math.min(layer.width - 1, Math.floor(x / layer.stride));
      if (layer.colour[4 * i + 3] >= 0) return [layer, i];
    }
    return null;
  }

  /** The last picture as it was shown, small, with the distance of each pixel along its ray in scene units. */
  stillOf() {
    const factor = Math.min(1, WARP_PX / this.view.width), width = Math.max(1, Math.round(this.view.width * factor));
    const height = Math.max(1, Math.round(this.view.height * factor)), canvas = new OffscreenCanvas(width, height);
    const context = canvas.getContext("2d", { willReadFrequently: true }), distances = new Float32Array(width * height);
    for (const { canvas: picture, stride, width: w, height: h } of this.layers) {
      context.drawImage(picture, 0, 0, w * stride * factor, h * stride * factor);
    }
    const far = FAR * this.scene.size, scale = this.scene.training_from_scene.scale;
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const found = this.at((x + 0.5) / factor, (y + 0.5) / factor), median = found ? found[0].ends[4 * found[1] + 2] : NaN;
      distances[y * width + x] = median < 0 ? far : median / scale;  // NaN where nothing has come yet
    }
    const colours = new Uint32Array(context.getImageData(0, 0, width, height).data.buffer);
    return { width, height, factor, colours, distances, view: this.view };
  }

  /** Move what was last seen to another view, by its depths; what was hidden stays grey until the server has it. */
  warp(view) {
    if (!this.look) return;
    const still = this.still ||= this.stillOf(), { width, height, factor, colours, distances } = still;
    const from = still.view.lens.map(v => v * factor), factorTo = width / view.width, to = view.lens.map(v => v * factorTo);
    const high = Math.max(1, Math.round(view.height * factorTo)), nearest = new Float32Array(width * high).fill(Infinity);
    const pixels = new ImageData(width, high), out = new Uint32Array(pixels.data.buffer).fill(0xff707070);
    const turn = product(transposed(view.turn), still.view.turn);
    const shift = times(transposed(view.turn), added(still.view.place, view.place, -1));
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const i = y * width + x, a = (x + 0.5 - from[2]) / from[0], b = (y + 0.5 - from[3]) / from[1];
      const z1 = distances[i] / Math.sqrt(1 + a * a + b * b);
      const px = z1 * (turn[0][0] * a + turn[0][1] * b + turn[0][2]) + shift[0];
      const py = z1 * (turn[1][0] * a + turn[1][1] * b + turn[1][2]) + shift[1];
      const pz = z1 * (turn[2][0] * a + turn[2][1] * b + turn[2][2]) + shift[2];
      if (!(pz > 1e-6 * z1)) continue;
      // As wide as the pixel is now and a little more, so that no cracks open; beside its middle it gives way to others.
      const half = Math.min(4, 0.65 * z1 / pz * to[0] / from[0]), u = to[2] + to[0] * px / pz, v = to[3] + to[1] * py / pz;
      const middleX = Math.floor(u), middleY = Math.floor(v), last = Math.min(high - 1, Math.floor(v + half));
      for (let w = Math.max(0, Math.floor(v - half)); w <= last; w++) {
        for (let k = Math.max(0, Math.floor(u - half)); k <= Math.min(width - 1, Math.floor(u + half)); k++) {
          const o = w * width + k, z = k === middleX && w === middleY ? pz : 1.02 * pz;
          if (z >= nearest[o]) continue;
          nearest[o] = z;
          out[o] = colours[i];
        }
      }
    }
    const picture = new OffscreenCanvas(width, high);
    picture.getContext("2d").putImageData(pixels, 0, 0);
    this.context.imageSmoothingEnabled = true;
    this.context.drawImage(picture, 0, 0, view.width, view.height);
    this.canvas.dataset.stride = "warped";
  }

  /** The numbers of the finest layer, as `Renderer.read`. */
  read() {
    const { colour, ends, shares } = this.layers.at(-1);
    return [colour, ends, shares];
  }

  /** A small picture of the last view, as `Renderer.picture`. */
  picture({ width, height }) {
    const small = { width, height, colour: new Float32Array(4 * width * height), ends: new Float32Array(4 * width * height),
      shares: new Float32Array(4 * width * height) };
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const [layer, i] = this.at((x + 0.5) / width * this.view.width, (y + 0.5) / height * this.view.height);
      for (const name of ["colour", "ends", "shares"]) small[name].set(layer[name].subarray(4 * i, 4 * i + 4), 4 * (y * width + x));
    }
    return small;
  }

  /** What the ray of a pixel of the last view sees, as `Renderer.probe`. */
  probe(view, x, y) {
    const found = this.layers.length ? this.at(x / view.width * this.view.width, y / view.height * this.view.height) : null;
    if (!found) return { rgb: [0, 0, 0], opacity: 0, mean: -1, spread: -1, median: -1, low: -1, high: -1 };
    const [{ colour, ends, shares }, i] = found, four = values => [...values.subarray(4 * i, 4 * i + 4)];
    const [mean, spread, median] = four(ends), [low, high] = four(shares), [r, g, b, opacity] = four(colour);
    return { rgb: [r, g, b], opacity, mean, spread, median, low, high };
  }
}

/** A picture with one pixel for stride x stride of the view; alpha is -1 where nothing has come yet. */
class Layer {
  constructor(stride, width, height) {
    Object.assign(this, { stride, width, height, left: width * height, fresh: [], key: "" });
    for (const name of ["colour", "ends", "shares"]) this[name] = new Float32Array(4 * width * height).fill(-1);
    this.canvas = new OffscreenCanvas(width, height);
    this.context = this.canvas.getContext("2d");
  }
}

/** Bytes as they come, and the tiles that are complete in them. */
class Store {
  constructor() {
    this.bytes = new Uint8Array(2 ** 20);
    this.start = this.end = 0;
  }

  add(more) {
    if (this.end + more.length > this.bytes.length) {
      const held = this.bytes.subarray(this.start, this.end);
      const room = new Uint8Array(Math.max(this.bytes.length, 2 * (held.length + more.length)));
      room.set(held);
      [this.bytes, this.start, this.end] = [room, 0, held.length];
    }
    this.bytes.set(more, this.end);
    this.end += more.length;
  }

  record() {
    if (this.end - this.start < HEAD) return null;
    const head = new Uint32Array(this.bytes.slice(this.start, this.start + HEAD).buffer);
    const [stride, x, y, width, height, pictureWidth, pictureHeight] = head, length = 4 * NUMBERS * width * height;
    if (this.end - this.start < HEAD + length) return null;
    const numbers = new Float32Array(this.bytes.slice(this.start + HEAD, this.start + HEAD + length).buffer);
    this.start += HEAD + length;
    return { stride, x, y, width, height, pictureWidth, pictureHeight, numbers };
  }
}

function sameView(a, b) {
  const numbers = v => JSON.stringify([v.place, v.turn, v.lens, v.width, v.height, v.share]);
  return Boolean(a && b) && numbers(a) === numbers(b);
}
