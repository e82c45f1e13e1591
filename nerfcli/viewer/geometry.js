// Vectors and rotations in float64. A camera's turn is `world_from_cam`: its columns are right, down and ahead.
"use strict";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const added = (a, b, factor = 1) => a.map((v, i) => v + factor * b[i]);
const scaled = (a, factor) => a.map(v => v * factor);
const norm = a => Math.hypot(...a);
const unit = a => scaled(a, 1 / (norm(a) || 1));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const transposed = m => [0, 1, 2].map(i => m.map(row => row[i]));
const times = (m, v) => m.map(row => dot(row, v));
const product = (a, b) => { const t = transposed(b); return a.map(row => t.map(column => dot(row, column))); };
const column = (m, i) => m.map(row => row[i]);
const columns = m => [...column(m, 0), ...column(m, 1), ...column(m, 2)];
const fromColumns = (x, y, z) => transposed([x, y, z]);

/** The rotation about an axis, Rodrigues. */
function aboutAxis(axis, angle) {
  const [x, y, z] = unit(axis), c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return [[c + x * x * k, x * y * k - z * s, x * z * k + y * s], [y * x * k + z * s, c + y * y * k, y * z * k - x * s],
    [z * x * k - y * s, z * y * k + x * s, c + z * z * k]];
}

/** The nearest orthonormal columns, after many small turns. */
function orthonormal(turn) {
  const z = unit(column(turn, 2)), x = unit(added(column(turn, 0), z, -dot(column(turn, 0), z)));
  return fromColumns(x, cross(z, x), z);
}

/** Quaternion w, x, y, z of a rotation. */
function quaternionOf(m) {
  const t = m[0][0] + m[1][1] + m[2][2];
  let q;
  if (t > 0) q = [1 + t, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
  else {
    const i = m[0][0] > m[1][1] && m[0][0] > m[2][2] ? 0 : m[1][1] > m[2][2] ? 1 : 2, j = (i + 1) % 3, k = (i + 2) % 3;
    q = [m[k][j] - m[j][k], 0, 0, 0];
    q[1 + i] = 1 + m[i][i] - m[j][j] - m[k][k];
    q[1 + j] = m[j][i] + m[i][j];
    q[1 + k] = m[k][i] + m[i][k];
  }
  const length = Math.hypot(...q);
  return q.map(v => v / length);
}

function turnOf([w, x, y, z]) {
  return [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
}

/** Spherical interpolation of quaternions along the shorter arc. */
function between(a, b, share) {
  let cosine = a.reduce((sum, v, i) => sum + v * b[i], 0);
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(1, Math.abs(cosine));
  const angle = Math.acos(cosine), sine = Math.sin(angle);
  const [p, q] = sine < 1e-6 ? [1 - share, share] : [Math.sin((1 - share) * angle) / sine, Math.sin(share * angle) / sine];
  const mixed = a.map((v, i) => p * v + sign * q * b[i]), length = Math.hypot(...mixed);
  return mixed.map(v => v / length);
}
