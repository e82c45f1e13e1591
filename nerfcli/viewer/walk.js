// Where the visitor stands, and how keys, mouse and fingers move that. Lengths are in the scene's units.
"use strict";

class Walk {
  /** `changed` is called after each motion; `pivotAt(x, y)` gives the point under a pixel, or null. */
  constructor(scene, changed, pivotAt) {
    this.scene = scene;
    this.changed = changed;
    this.pivotAt = pivotAt;
    this.place = [0, 0, 0];
    this.turn = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    this.fov = 0.9;
    this.speed = scene.size / 4;
    this.held = new Set();
    this.pointers = new Map();
    this.pivot = null;
  }

  ahead() { return column(this.turn, 2); }

  turnBy(axis, angle) { this.turn = orthonormal(product(aboutAxis(axis, angle), this.turn)); }

  look(yaw, pitch) {
    this.turnBy(this.scene.up, -yaw);
    this.turnBy(column(this.turn, 0), -pitch);
  }

  orbit(yaw, pitch, pivot) {
    for (const [axis, angle] of [[this.scene.up, -yaw], [column(this.turn, 0), pitch]]) {
      const r = aboutAxis(axis, angle);
      this.place = added(pivot, times(r, added(this.place, pivot, -1)));
      this.turn = orthonormal(product(r, this.turn));
    }
  }

  move(right, down, ahead) {
    [right, down, ahead].forEach((length, i) => { this.place = added(this.place, column(this.turn, i), length); });
  }

  stand(place, turn, fov) {
    this.place = [...place];
    this.turn = turn.map(row => [...row]);
    if (fov) this.fov = fov;
    this.changed();
  }

  /** The keys that are down move; called for each frame with the seconds since the last one. */
  step(seconds) {
    if (!this.held.size) return;
    const pull = (more, less) => (this.held.has(more) ? 1 : 0) - (this.held.has(less) ? 1 : 0);
    const length = this.speed * seconds * (this.held.has("shift") ? 4 : 1), angle = 1.2 * seconds;
    this.move(length * pull("d", "a"), length * pull("q", "e"), length * pull("w", "s"));
    if (pull("arrowright", "arrowleft") || pull("arrowdown", "arrowup")) {
      this.look(angle * pull("arrowright", "arrowleft"), angle * pull("arrowdown", "arrowup"));
    }
    this.changed();
  }

  /** Listen on an element; `taken(event)` says whether something else has use for a press. */
  listen(element, taken) {
    element.addEventListener("contextmenu", event => event.preventDefault());
    element.addEventListener("pointerdown", event => {
      if (taken(event)) return;
      element.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
      const distance = this.scene.size / 2;
      this.pivot = this.pivotAt(event.offsetX, event.offsetY) || added(this.place, this.ahead(), distance);
    });
    element.addEventListener("pointermove", event => {
      const before = this.pointers.get(event.pointerId);
      if (!before) return;
      const now = [event.offsetX, event.offsetY], dx = now[0] - before[0], dy = now[1] - before[1];
      const depth = Math.max(1e-9, dot(added(this.pivot, this.place, -1), this.ahead()));
      const perPixel = depth * 2 * Math.tan(this.fov / 2) / element.clientHeight;
      if (this.pointers.size === 2) {
        const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
        const apart = Math.hypot(before[0] - other[0], before[1] - other[1]);
        const then = Math.hypot(now[0] - other[0], now[1] - other[1]);
        this.move(-dx * perPixel / 2, -dy * perPixel / 2, depth * (1 - apart / Math.max(then, 1)));
      } else if (event.shiftKey || event.buttons & 6) this.move(-dx * perPixel, -dy * perPixel, 0);
      else if (event.altKey) this.look(-dx * this.fov / element.clientHeight, -dy * this.fov / element.clientHeight);
      else this.orbit(4 * dx / element.clientHeight, -4 * dy / element.clientHeight, this.pivot);
      this.pointers.set(event.pointerId, now);
      this.changed();
    });
    for (const name of ["pointerup", "pointercancel"]) {
      element.addEventListener(name, event => this.pointers.delete(event.pointerId));
    }
    element.addEventListener("wheel", event => {
      event.preventDefault();
      const point = this.pivotAt(event.offsetX, event.offsetY) || added(this.place, this.ahead(), this.scene.size / 2);
      const share = Math.max(-1, Math.min(0.5, -event.deltaY / 800));
      this.place = added(this.place, added(point, this.place, -1), share);
      this.changed();
    }, { passive: false });
    const moves = new Set(["w", "a", "s", "d", "q", "e", "shift", "arrowleft", "arrowright", "arrowup", "arrowdown"]);
    addEventListener("keydown", event => {
      const key = event.key.toLowerCase();
      if (event.ctrlKey || event.metaKey || event.target.matches("input, select, textarea") || !moves.has(key)) return;
      this.held.add(key);
      if (key.startsWith("arrow")) event.preventDefault();
    });
    addEventListener("keyup", event => this.held.delete(event.key.toLowerCase()));
    addEventListener("blur", () => this.held.clear());
  }

  /** The view for a picture of so many pixels. */
  view(width, height) {
    const focal = height / 2 / Math.tan(this.fov / 2);
    return { place: this.place, turn: this.turn, lens: [focal, focal, width / 2, height / 2], width, height };
  }

  fragment() {
    const digits = values => values.map(v => Number(v.toPrecision(7))).join(",");
    return `p=${digits(this.place)}&q=${digits(quaternionOf(this.turn))}&f=${Number((this.fov * 180 / Math.PI).toFixed(3))}`;
  }

  /** Stand where a fragment says; false where it says nothing that makes sense. */
  read(parameters) {
    const numbers = name => (parameters.get(name) || "").split(",").map(Number);
    const place = numbers("p"), q = numbers("q"), [degrees] = numbers("f");
    if (place.length !== 3 || q.length !== 4 || ![...place, ...q].every(Number.isFinite) || !Math.hypot(...q)) return false;
    const length = Math.hypot(...q);
    this.stand(place, turnOf(q.map(v => v / length)), degrees > 1 && degrees < 170 ? degrees * Math.PI / 180 : 0);
    return true;
  }
}
