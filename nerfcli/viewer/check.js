// The proof inside: small pictures that `nerfcli render` made of three cameras, against what this device draws.
"use strict";

/** The value of a map at a pixel in scene units; NaN where it is undefined. As `valueOf` in show.glsl. */
function valueOf(map, { colour, ends, shares }, i, { factor, farthest, minOpacity }) {
  const alpha = colour[4 * i + 3], mean = ends[4 * i], median = ends[4 * i + 2], moment = Math.max(mean, 0) * alpha;
  if (map === "opacity") return alpha;
  if (map === "moment") return moment * factor;
  if (map === "background") return (moment + (1 - alpha) * farthest) * factor;
  if (alpha < minOpacity || mean < 0) return NaN;
  const photos = shares[4 * i + 3];
  if (map === "coverage") return median < 0 ? NaN : Math.floor(photos);
  if (map === "parallax") return median < 0 ? NaN : 256 * (photos - Math.floor(photos));
  let value = mean;
  if (map === "median") value = median;
  else if (map === "max-weight") value = ends[4 * i + 3];
  else if (map === "quantile") value = shares[4 * i + 2];
  else if (map === "spread") value = ends[4 * i + 1];
  else if (map === "disagreement") value = median < 0 ? -1 : Math.abs(median - mean);
  return value < 0 ? NaN : value * factor;
}

/** The cosine between the ray of a pixel and the optical axis. */
function cosineAt(view, x, y) {
  return 1 / Math.hypot((x + 0.5 - view.lens[2]) / view.lens[0], (y + 0.5 - view.lens[3]) / view.lens[1], 1);
}

/** Largest and root mean square difference of each map over the cameras of the proof. */
function compare(renderer, scene) {
  const { width, height, cameras, maps, share } = scene.proof, found = {};
  let at = 0;
  for (const camera of cameras) {
    const view = { ...camera, width, height, share };
    const picture = renderer.picture(view);
    for (const map of ["colour", ...maps]) {
      const sums = found[map] ||= { all: [], undefinedHere: 0, undefinedThere: 0, unit: 1 };
      for (let i = 0; i < width * height; i++) {
        const cosine = cosineAt(view, i % width, Math.floor(i / width));
        const where = { factor: cosine / scene.training_from_scene.scale, farthest: scene.march.far, minOpacity: 0.5 };
        const values = map === "colour" ? [0, 1, 2].map(c => picture.colour[4 * i + c]) : [valueOf(map, picture, i, where)];
        for (const value of values) {
          const expected = scene.expected[at++];
          if (Number.isNaN(value) !== Number.isNaN(expected)) sums[Number.isNaN(value) ? "undefinedHere" : "undefinedThere"]++;
          else if (!Number.isNaN(value)) sums.all.push(Math.abs(value - expected));
        }
      }
    }
  }
  return Object.fromEntries(Object.entries(found).map(([map, { all, undefinedHere, undefinedThere }]) => {
    const sorted = Float64Array.from(all).sort(), rank = share => sorted[Math.floor(share * (sorted.length - 1))] ?? 0;
    const rms = Math.sqrt(sorted.reduce((sum, v) => sum + v * v, 0) / Math.max(1, sorted.length));
    return [map, { rms, median: rank(0.5), percentile_99: rank(0.99), largest: rank(1), numbers: sorted.length,
      undefined_here: undefinedHere, undefined_there: undefinedThere }];
  }));
}
