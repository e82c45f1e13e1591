// The page's data: decoded, checked, and put where the shader finds them.
"use strict";

const MAPS = ["colour", "opacity", "conditional", "median", "max-weight", "moment", "background", "quantile", "spread",
  "disagreement", "coverage", "parallax"];
// Maps that are no lengths: ends of their colours, and what follows the last number of the legend.
const COUNTS = { opacity: [[0, 1], ""], coverage: [[0, 8], " or more photos"], parallax: [[0, 30], " degrees or more"] };

/** All that the page was made with. */
async function readScene() {
  if (!globalThis.DecompressionStream) throw new Error("this browser lacks DecompressionStream; use one of 2023 or later");
  const element = document.getElementById("scene");
  if (!element) throw new Error('this file is incomplete: it lacks "scene"');
  let scene;
  try {
    scene = JSON.parse(element.textContent);
  } catch {
    throw new Error('this file is damaged: "scene" is not JSON');
  }
  if (scene.format !== "nerfcli page 1") throw new Error(`this file has the format ${scene.format}`);
  scene.colours = await bytesOf("colours");
  if (scene.live) return scene;
  const names = ["expected", "table", "networks", "cuts", "occupied", "seen", ...(scene.field.sky ? ["sky"] : [])];
  const arrays = Object.fromEntries(await Promise.all(names.map(async name => [name, await bytesOf(name)])));
  scene.expected = new Float32Array(arrays.expected.buffer);
  scene.seenCells = new Uint16Array(arrays.seen.buffer);
  return withField(scene, arrays);
}

/** The scene with the arrays of its field, from their bytes. Throws where a length is wrong. */
function withField(scene, arrays) {
  const { field, march } = scene;
  const bytes = (name, length) => {
    if (arrays[name]?.length !== length) throw new Error(`the field's "${name}" has ${arrays[name]?.length} bytes, expected ${length}`);
    return arrays[name];
  };
  scene.table = new Int16Array(bytes("table", 8 * field.rows).buffer);
  scene.networks = new Float32Array(bytes("networks", 64 * field.networks).buffer);
  scene.cuts = new Float32Array(bytes("cuts", 4 * (march.intervals + 1)).buffer);
  scene.cells = cellsOf(bytes("occupied", Math.ceil(march.side ** 3 / 8)), march.side);
  scene.sky = field.sky ? new Int16Array(bytes("sky", 6 * field.sky.side ** 3).buffer) : null;
  return scene;
}

/** One byte per cell of packed bits, the lowest bit first. */
function cellsOf(bits, side) {
  const cells = new Uint8Array(side ** 3);
  for (let i = 0; i < cells.length; i++) cells[i] = (bits[i >> 3] >> (i & 7)) & 1;
  return cells;
}

/** One byte per block of 4^3 cells: whether it or a neighbour holds something. */
function blocksOf(cells, side) {
  const count = Math.ceil(side / 4), own = new Uint8Array(count ** 3), near = new Uint8Array(count ** 3);
  for (let i = 0; i < cells.length; i++) {
    if (!cells[i]) continue;
    const x = i % side, y = Math.floor(i / side) % side, z = Math.floor(i / side / side);
    own[((z >> 2) * count + (y >> 2)) * count + (x >> 2)] = 1;
  }
  for (let z = 0; z < count; z++) for (let y = 0; y < count; y++) for (let x = 0; x < count; x++) {
    if (!own[(z * count + y) * count + x]) continue;
    for (let c = Math.max(z - 1, 0); c <= Math.min(z + 1, count - 1); c++)
      for (let b = Math.max(y - 1, 0); b <= Math.min(y + 1, count - 1); b++)
        for (let a = Math.max(x - 1, 0); a <= Math.min(x + 1, count - 1); a++) near[(c * count + b) * count + a] = 1;
  }
  return { count, near };
}

/** A number as GLSL writes floats, with all digits of a float32. */
function glslFloat(value) {
  const text = Math.fround(value).toPrecision(9);
  return /[.e]/.test(text) ? text : `${text}.0`;
}

/** The fragment shader for a field of this size. */
function shaderSource(scene, body, tableBits) {
  const { field, march } = scene, hidden = field.width / 4, levels = field.resolutions.length;
  const start = { W1: 0, W2: hidden * levels };
  start.C1 = start.W2 + 4 * hidden;
  start.C2 = start.C1 + 8 * hidden;
  start.C3 = start.C2 + hidden * hidden;
  const defines = {
    LEVELS: levels, HIDDEN: Math.max(1, hidden), NETWORKS: Math.max(1, field.networks), ...start,
    HASH: field.kind === "hash" ? 1 : 0, HARMONICS: field.harmonics, ANTIALIAS: field.antialias ? 1 : 0,
    CONTRACTION: field.contraction, SIDE: march.side, INTERVALS: march.intervals,
    REACH: glslFloat((4 / march.side) * (field.contraction === 0 ? 4 : 7.8)),
    LARGEST_DENSE: field.largestDense, ROW_MASK: `${field.rowMask}u`,
    TABLE_BITS: tableBits, TABLE_WIDTH: 2 ** tableBits,
    SKY_SIDE: field.sky ? field.sky.side : 0, SEEN_SIDE: scene.seen || 0,
    RESOLUTIONS: field.resolutions.join(","), FIRST_ROWS: field.firstRows.join(","),
  };
  return glslHead("isampler2D", "usampler3D", "isampler3D")
    + Object.entries(defines).map(([name, value]) => `#define ${name} ${value}`).join("\n") + "\n" + body;
}

function glslHead(...samplers) {
  return "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\n"
    + samplers.map(name => `precision highp ${name};\n`).join("");
}
