// When what is drawn: at once and coarse while the camera moves, then finer and finer, tiles from the middle out.
"use strict";

const MOST_STRIDE = 16, TILE_MS = 40, COARSE_MS = 60;

class Schedule {
  /** `shown` is called whenever there is more to see, `rested` when all is drawn. */
  constructor(renderer, { shown, rested }) {
    Object.assign(this, { renderer, shown, rested });
    this.msPerPixel = 0.0005;
    this.running = false;
    this.wanted = null;
    this.fine = this.coarse = null;
  }

  /** Draw a view, and no other that was asked for before. */
  want(view) {
    this.wanted = view;
    if (!this.running) this.run();
  }

  async run() {
    this.running = true;
    try {
      while (this.wanted && !this.renderer.gl.isContextLost()) {
        const view = this.wanted;
        this.wanted = null;
        await this.refine(view);
      }
    } finally {
      this.running = false;
    }
  }

  async refine(view) {
    const { renderer } = this;
    if (this.fine?.width !== view.width || this.fine?.height !== view.height) {
      renderer.release(this.fine);
      this.fine = renderer.target(view.width, view.height);
    }
    let stride = 2;
    while (stride < MOST_STRIDE && view.width * view.height / stride ** 2 * this.msPerPixel > COARSE_MS) stride *= 2;
    renderer.clear(this.fine);
    // The first stage is not given up for a newer view: something has to be seen of a motion.
    for (let first = true; stride >= 1; stride /= 2, first = false) {
      const target = stride === 1 ? this.fine
        : renderer.target(Math.ceil(view.width / stride), Math.ceil(view.height / stride));
      for (const tile of this.tiles(target, first)) {
        const began = performance.now();
        renderer.draw(target, view, { stride, tile });
        await finished(renderer.gl);
        const each = (performance.now() - began) / (tile[2] * tile[3]);
        this.msPerPixel = 0.7 * this.msPerPixel + 0.3 * each;
        if (renderer.gl.isContextLost()) return;
        if (this.wanted && !first) {
          if (stride > 1) renderer.release(target);
          return;
        }
        if (stride === 1) this.shown(view, this.fine, this.coarse);
      }
      if (stride > 1) {
        renderer.release(this.coarse);
        this.coarse = target;
        this.shown(view, this.fine, this.coarse);
      }
      if (this.wanted) return;
    }
    this.rested(view, this.fine);
  }

  /** Tiles of a target, from its middle out; the whole where that is quick. */
  tiles(target, whole) {
    const pixels = TILE_MS / this.msPerPixel, { width, height } = target;
    if (whole || width * height <= pixels) return [[0, 0, width, height]];
    const side = Math.max(8, Math.min(512, Math.floor(Math.sqrt(pixels)))), tiles = [];
    for (let y = 0; y < height; y += side) for (let x = 0; x < width; x += side) {
      tiles.push([x, y, Math.min(side, width - x), Math.min(side, height - y)]);
    }
    const off = ([x, y, w, h]) => Math.hypot(x + w / 2 - width / 2, y + h / 2 - height / 2);
    return tiles.sort((a, b) => off(a) - off(b));
  }
}

/** Resolves when the device has done what it was given; a shader's time is seen in no other way. */
function finished(gl) {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  return new Promise(resolve => {
    const ask = () => {
      const state = gl.isContextLost() ? gl.CONDITION_SATISFIED : gl.clientWaitSync(fence, 0, 0);
      if (state === gl.TIMEOUT_EXPIRED) setTimeout(ask, 1);
      else {
        gl.deleteSync(fence);
        resolve();
      }
    };
    // A turn of the event loop at least, so that keys and pointer are heard.
    setTimeout(ask, 0);
  });
}
