// A path through keyframes, and the camera-path file that `nerfcli render --cameras FILE` follows (nerfstudio's format).
"use strict";

/** The view of a path at a time in [0, keyframes - 1]: Catmull-Rom in place, the shorter arc in turn. */
function viewAlong(keyframes, time) {
  const last = keyframes.length - 1, i = Math.min(Math.floor(time), Math.max(0, last - 1)), t = time - i;
  const [a, b, c, d] = [i - 1, i, i + 1, i + 2].map(k => keyframes[Math.max(0, Math.min(last, k))]);
  const place = b.place.map((v, n) => {
    const [p, q, r, s] = [a.place[n], v, c.place[n], d.place[n]];
    return 0.5 * (2 * q + (r - p) * t + (2 * p - 5 * q + 4 * r - s) * t * t + (3 * q - p - 3 * r + s) * t * t * t);
  });
  return { place, turn: turnOf(between(quaternionOf(b.turn), quaternionOf(c.turn), t)), fov: b.fov + (c.fov - b.fov) * t };
}

/** All views of a path: so many seconds from keyframe to keyframe. */
function viewsAlong(keyframes, { seconds, fps }) {
  const count = Math.max(1, Math.round((keyframes.length - 1) * seconds * fps));
  if (keyframes.length < 2) return keyframes;
  return Array.from({ length: count + 1 }, (_, k) => viewAlong(keyframes, k / count * (keyframes.length - 1)));
}

/** `world_from_cam` with OpenGL axes, 16 numbers row by row. */
function openGl({ place, turn }) {
  return [...turn.flatMap((row, i) => [row[0], -row[1], -row[2], place[i]]), 0, 0, 0, 1];
}

function cameraPath(keyframes, { seconds, fps, width, height }) {
  const degrees = view => view.fov * 180 / Math.PI, aspect = width / height, views = viewsAlong(keyframes, { seconds, fps });
  return {
    camera_type: "perspective", render_height: height, render_width: width, fps, seconds: views.length / fps,
    is_cycle: false, smoothness_value: 0, default_fov: degrees(keyframes[0]),
    keyframes: keyframes.map(k => ({ matrix: JSON.stringify(openGl(k)), fov: degrees(k), aspect })),
    camera_path: views.map(v => ({ camera_to_world: openGl(v), fov: degrees(v), aspect })),
  };
}

/** The keyframes of such a file; its views where it has none. Throws where it is something else. */
function keyframesOf(text) {
  const content = JSON.parse(text), list = content.keyframes?.length ? content.keyframes : content.camera_path;
  if (!Array.isArray(list) || !list.length) throw new Error("it has no keyframes");
  return list.map(entry => {
    let m = entry.matrix ?? entry.camera_to_world;
    if (typeof m === "string") m = JSON.parse(m);
    m = m.flat();
    if (m.length < 12 || !m.slice(0, 12).every(Number.isFinite)) throw new Error("a matrix is not of 16 numbers");
    const turn = orthonormal([0, 1, 2].map(i => [m[4 * i], -m[4 * i + 1], -m[4 * i + 2]]));
    return { place: [m[3], m[7], m[11]], turn, fov: (entry.fov || 50) * Math.PI / 180 };
  });
}
