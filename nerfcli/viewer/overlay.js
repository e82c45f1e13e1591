// What is drawn over the rendering: photos as frusta, the crop box with its handles, what was measured, the path.
"use strict";

const FACES = [0, 1, 2, 3, 4, 5];

class Overlay {
  constructor(canvas, scene) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.scene = scene;
    this.pictures = scene.photos.map(photo => photo.picture && new Image());
    if (scene.live) this.fetchPictures();
    else this.pictures.forEach((image, index) => { if (image) image.src = scene.photos[index].picture; });
    this.places = [];   // of the photos' middles on the screen, for clicks
    this.handles = [];  // of the box
  }

  /** Small pictures from the server, one after the other, so that they are in nobody's way. */
  async fetchPictures() {
    for (const [index, image] of this.pictures.entries()) {
      if (!image) continue;
      image.src = `${this.scene.photos[index].picture}&px=160`;
      await image.decode().catch(() => { this.pictures[index] = null; });
    }
  }

  /** Pixel of a point, or null behind the camera. */
  pixel(point, view) {
    const q = times(transposed(view.turn), added(point, view.place, -1));
    if (q[2] < 1e-6 * this.scene.size) return null;
    return [view.lens[2] + view.lens[0] * q[0] / q[2], view.lens[3] + view.lens[1] * q[1] / q[2], q[2]];
  }

  line(points, view, { closed = false } = {}) {
    const { context } = this, seen = points.map(point => this.pixel(point, view));
    context.beginPath();
    seen.forEach((p, i) => {
      const before = seen[i - 1];
      if (p && before) context.lineTo(p[0], p[1]);
      else if (p) context.moveTo(p[0], p[1]);
    });
    if (closed && seen.every(Boolean)) context.closePath();
    context.stroke();
  }

  draw(view, state, visible) {
    const { context, canvas } = this;
    canvas.width = view.width;
    canvas.height = view.height;
    context.lineWidth = 1.5;
    if (state.frusta) this.frusta(view, state, visible);
    if (state.box && state.showBox) this.box(view, state.box);
    else this.handles = [];
    this.measured(view, state);
    if (state.keyframes.length > 1 && !state.playing) {
      context.strokeStyle = "#ffb74d";
      this.line(viewsAlong(state.keyframes, { seconds: 1, fps: 16 }).map(v => v.place), view);
      for (const key of state.keyframes) this.dot(key.place, view, "#ffb74d");
    }
  }

  frusta(view, state, visible) {
    const { context, scene } = this, depth = scene.frustum * state.frustumSize;
    this.places = scene.photos.map((photo, index) => {
      if (index === state.photo) return null;
      const [fx, fy, cx, cy] = photo.lens, eye = photo.place;
      const corners = [[0, 0], [photo.width, 0], [photo.width, photo.height], [0, photo.height]].map(([x, y]) =>
        added(eye, times(photo.turn, [(x - cx) / fx * depth, (y - cy) / fy * depth, depth])));
      const seen = corners.map(corner => this.pixel(corner, view)), tip = this.pixel(eye, view);
      if (!tip || seen.some(p => !p) || tip[2] < 2 * depth) return null;
      context.globalAlpha = visible(tip) ? 1 : 0.25;
      const extent = Math.hypot(seen[0][0] - seen[2][0], seen[0][1] - seen[2][1]);
      const image = this.pictures[index];
      if (extent > 14 && image?.complete && image.naturalWidth) this.quad(image, seen);
      context.strokeStyle = photo.split === "test" ? "#ff8a65" : "#4fc3f7";
      this.line([...corners, corners[0]], view);
      for (const corner of corners) this.line([eye, corner], view);
      context.globalAlpha = 1;
      return { seen, depth: tip[2], index };
    }).filter(Boolean);
  }

  /** A picture on four corners of the screen, as two affine triangles. */
  quad(image, [a, b, c, d]) {
    const { context } = this, w = image.naturalWidth, h = image.naturalHeight;
    for (const [p, q, r, corner] of [[a, b, d, 0], [c, d, b, 1]]) {
      context.save();
      context.beginPath();
      context.moveTo(p[0], p[1]);
      context.lineTo(q[0], q[1]);
      context.lineTo(r[0], r[1]);
      context.clip();
      const x = [(q[0] - p[0]) / w, (q[1] - p[1]) / w], y = [(r[0] - p[0]) / h, (r[1] - p[1]) / h];
      if (corner) context.setTransform(-x[0], -x[1], -y[0], -y[1], p[0] + x[0] * w + y[0] * h, p[1] + x[1] * w + y[1] * h);
      else context.setTransform(x[0], x[1], y[0], y[1], p[0], p[1]);
      context.drawImage(image, 0, 0);
      context.restore();
    }
  }

  /** The nearest photo whose frustum shows at a pixel; -1 for none. */
  photoAt(x, y) {
    const inside = corners => {
      let odd = false;
      corners.forEach((p, i) => {
        const q = corners[(i + 3) % 4];
        if ((p[1] > y) !== (q[1] > y) && x < (q[0] - p[0]) * (y - p[1]) / (q[1] - p[1]) + p[0]) odd = !odd;
      });
      return odd;
    };
    const hit = this.places.filter(place => inside(place.seen)).sort((a, b) => a.depth - b.depth);
    return hit.length ? hit[0].index : -1;
  }

  box(view, box) {
    const { context } = this, at = (x, y, z) => [box[x], box[1 + y], box[2 + z]];
    context.strokeStyle = "#aed581";
    for (const [i, j] of [[0, 0], [0, 3], [3, 0], [3, 3]]) {
      this.line([at(0, i, j), at(3, i, j)], view);
      this.line([at(i, 0, j), at(i, 3, j)], view);
      this.line([at(i, j, 0), at(i, j, 3)], view);
    }
    this.handles = FACES.map(face => {
      const middle = [0, 1, 2].map(axis => (box[axis] + box[axis + 3]) / 2), axis = face % 3;
      middle[axis] = box[face];
      const step = [0, 0, 0];
      step[axis] = 0.01 * this.scene.size;
      const p = this.pixel(middle, view), q = this.pixel(added(middle, step), view);
      if (!p || !q) return null;
      context.fillStyle = ["#e57373", "#81c784", "#64b5f6"][axis];
      context.beginPath();
      context.arc(p[0], p[1], 6, 0, 7);
      context.fill();
      return { face, x: p[0], y: p[1], along: [(q[0] - p[0]) / step[axis], (q[1] - p[1]) / step[axis]] };
    }).filter(Boolean);
  }

  handleAt(x, y) { return this.handles.find(handle => Math.hypot(handle.x - x, handle.y - y) < 12) || null; }

  dot(point, view, colour) {
    const p = this.pixel(point, view);
    if (!p) return;
    this.context.fillStyle = colour;
    this.context.beginPath();
    this.context.arc(p[0], p[1], 4, 0, 7);
    this.context.fill();
  }

  measured(view, state) {
    const { context } = this;
    context.strokeStyle = "#fff176";
    if (state.points.length === 2) this.line(state.points.map(p => p.middle), view);
    for (const point of state.points) this.dot(point.middle, view, "#fff176");
  }
}
