// What a ray sees, as nerfcli/kernels/reference defines it: marching, hash grid, networks, compositing, depths.
// Lengths are those of the training frame; a distance that is undefined is -1. The #defines before this come from
// the field: see `shaderSource` in field.js.

uniform isampler2D table;      // four features of a row in a texel, 16-bit levels
uniform usampler3D occupied;   // 1 in cells that hold something
uniform usampler3D blocks;     // 1 in blocks of 4^3 cells that hold something, or touch one that does
uniform sampler2D cuts;        // distances at which rays are cut
uniform isampler3D sky;        // background by direction, 16-bit levels of logits
uniform usampler3D seen;       // coverage + 256 * parallax of the surface in cells, see coverage.py
layout(std140) uniform Networks { mat4 networks[NETWORKS]; };

uniform mat3 trainingFromCamera;
uniform vec3 origin;
uniform vec4 lens;             // fx, fy, cx, cy in pixels of the whole picture
uniform vec2 size;             // of the whole picture, pixels
uniform float scales[LEVELS];  // what a level of a table's row is worth
uniform float skyScale;
uniform float stride;          // pixels of the whole picture per pixel drawn, along an axis
uniform vec2 corner;           // the first of them that is drawn
uniform float deepest;         // optical depth at which rays stop
uniform float negligible;      // samples of less weight are grey
uniform vec4 targets;          // optical depths of the quantiles
uniform vec3 background;
uniform bool boxed;
uniform mat3 sceneFromTraining;
uniform vec3 sceneOrigin, boxLow, boxHigh;

layout(location = 0) out vec4 outColour;  // rgb on the background, opacity
layout(location = 1) out vec4 outEnds;    // mean, spread, median, heaviest
layout(location = 2) out vec4 outShares;  // quantiles 5 %, 95 %, the chosen one; coverage + parallax / 256 at the median

const int RES[LEVELS] = int[LEVELS](RESOLUTIONS);
const int FIRST[LEVELS] = int[LEVELS](FIRST_ROWS);

float cutAt(int k) { return texelFetch(cuts, ivec2(k & 1023, k >> 10), 0).x; }

vec4 row(int level, uint index) {
  int k = FIRST[level] + int(index);
  return vec4(texelFetch(table, ivec2(k & (TABLE_WIDTH - 1), k >> TABLE_BITS), 0));
}

// Points of the training frame as coordinates of the unit cube.
vec3 cube(vec3 p) {
#if CONTRACTION == 0
  return p * 0.5 + 0.5;
#else
  float norm = sqrt(max(dot(p, p), 1.0));
  return p * ((2.0 - 1.0 / norm) / norm * 0.25) + 0.5;
#endif
}

// How much of a pixel's width at a point is left in the cube.
float stretch(vec3 p) {
#if CONTRACTION == 0
  return 0.5;
#else
  float norm = sqrt(max(dot(p, p), 1.0));
  return (2.0 - 1.0 / norm) / norm * 0.25;
#endif
}

vec4 level(int l, vec3 p, float width) {
  int side = RES[l];
  if (side == 0) return vec4(0);
  vec3 s = clamp(p, 0.0, 1.0) * float(side);
  ivec3 c = min(ivec3(s), side - 1);
  vec3 t = s - vec3(c);
  uvec3 u = uvec3(c);
  uint vertices = uint(side + 1);
  bool dense = side <= LARGEST_DENSE;
  vec4 sum = vec4(0);
  for (int k = 0; k < 8; k++) {
    uvec3 d = uvec3(k & 1, (k >> 1) & 1, k >> 2), q = u + d;
    uint i = dense ? (q.z * vertices + q.y) * vertices + q.x
                   : (q.x ^ (q.y * 2654435761u) ^ (q.z * 805459861u)) & ROW_MASK;
    vec3 v = mix(1.0 - t, t, vec3(d));
    sum += v.x * v.y * v.z * row(l, i);
  }
#if ANTIALIAS
  sum /= max(1.0, float(side) * width);
#endif
  return sum * scales[l];
}

#if HASH
struct Code { vec4 hidden[HIDDEN]; vec4 first; };

float density(vec3 p, float width, out Code code) {
  vec4 e[LEVELS];
  for (int l = 0; l < LEVELS; l++) e[l] = level(l, p, width);
  code.first = vec4(0);
  for (int j = 0; j < HIDDEN; j++) {
    vec4 s = vec4(0);
    for (int i = 0; i < LEVELS; i++) s += networks[W1 + j * LEVELS + i] * e[i];
    code.hidden[j] = max(s, 0.0);
    code.first += networks[W2 + j] * code.hidden[j];
  }
  return exp(clamp(code.first.x, -15.0, 15.0));
}

vec3 colour(Code code, vec3 p, vec4 directed[HIDDEN], vec4 harmonics[4]) {
  vec4 g[4];
  g[0] = code.first;
  for (int j = 1; j < 4; j++) {
    vec4 s = vec4(0);
    for (int i = 0; i < HIDDEN; i++) s += networks[W2 + j * HIDDEN + i] * code.hidden[i];
    g[j] = s;
  }
  vec4 a[HIDDEN];
  for (int j = 0; j < HIDDEN; j++) {
    vec4 s = directed[j];
    for (int i = 0; i < 4; i++) s += networks[C1 + j * 8 + i] * g[i];
    a[j] = max(s, 0.0);
  }
  vec4 c = vec4(0);
  for (int j = 0; j < HIDDEN; j++) {
    vec4 s = vec4(0);
    for (int i = 0; i < HIDDEN; i++) s += networks[C2 + j * HIDDEN + i] * a[i];
    c += networks[C3 + j] * max(s, 0.0);
  }
  return 1.0 / (1.0 + exp(-c.xyz));
}
#else
// A dense grid: every "level" is a table of four numbers at the same vertices; log density, then red, green and blue of
// each harmonic.
struct Code { vec4 first; };

float density(vec3 p, float width, out Code code) {
  code.first = level(0, p, width);
  return exp(clamp(code.first.x, -15.0, 15.0));
}

vec3 colour(Code code, vec3 p, vec4 directed[HIDDEN], vec4 harmonics[4]) {
  vec3 sum = vec3(0);
  for (int l = 0; l < LEVELS; l++) {
    vec4 v = l == 0 ? code.first : level(l, p, 0.0);
    for (int i = 0; i < 4; i++) {
      int k = 4 * l + i - 1;
      if (k >= 0 && k < 3 * HARMONICS) sum[k % 3] += v[i] * harmonics[k / 3 >> 2][k / 3 & 3];
    }
  }
  return 1.0 / (1.0 + exp(-sum));
}
#endif

// The 16 real spherical harmonics up to degree 3.
void harmonicsOf(vec3 d, out vec4 h[4]) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  h[0] = vec4(0.28209479177387814, 0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x);
  h[1] = vec4(1.0925484305920792 * x * y, 1.0925484305920792 * y * z, 0.31539156525252005 * (3.0 * zz - 1.0),
              1.0925484305920792 * x * z);
  h[2] = vec4(0.5462742152960396 * (xx - yy), 0.5900435899266435 * y * (3.0 * xx - yy),
              2.890611442640554 * x * y * z, 0.4570457994644657 * y * (5.0 * zz - 1.0));
  h[3] = vec4(0.3731763325901154 * z * (5.0 * zz - 3.0), 0.4570457994644657 * x * (5.0 * zz - 1.0),
              1.445305721320277 * z * (xx - yy), 0.5900435899266435 * x * (xx - 3.0 * yy));
}

vec3 behind(vec3 d) {
#if SKY_SIDE
  vec3 s = clamp((d * 0.5 + 0.5) * float(SKY_SIDE - 1), 0.0, float(SKY_SIDE - 1));
  ivec3 c = min(ivec3(s), SKY_SIDE - 2 < 0 ? 0 : SKY_SIDE - 2);
  vec3 t = s - vec3(c), sum = vec3(0);
  for (int k = 0; k < 8; k++) {
    ivec3 e = ivec3(k & 1, (k >> 1) & 1, k >> 2);
    vec3 v = mix(1.0 - t, t, vec3(e));
    sum += v.x * v.y * v.z * vec3(texelFetch(sky, min(c + e, SKY_SIDE - 1), 0).xyz);
  }
  return 1.0 / (1.0 + exp(-sum * skyScale));
#else
  return background;
#endif
}

// 1 - exp(-x), with all digits where x is small.
float opacityOf(float x) {
  return x < 0.1 ? x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0)))) : 1.0 - exp(-x);
}

// Where light ends inside an interval of constant density, as a share of its length, and the variance of that.
float meanShare(float x) {
  if (x < 0.25) {
    float xx = x * x;
    return 0.5 - x * (1.0 / 12.0 - xx * (1.0 / 720.0 - xx * (1.0 / 30240.0 - xx / 1209600.0)));
  }
  float y = min(x, 80.0);
  return 1.0 / x - 1.0 / (exp(y) - 1.0);
}

float varianceShare(float x) {
  if (x < 1.0) {
    float xx = x * x;
    return 1.0 / 12.0 - xx * (1.0 / 240.0 - xx * (1.0 / 6048.0 - xx * (1.0 / 172800.0 - xx / 5322240.0)));
  }
  float e = exp(-min(x, 80.0));
  return 1.0 / (x * x) - e / ((1.0 - e) * (1.0 - e));
}

bool holdsSomething(vec3 p) {
  ivec3 cell = min(ivec3(clamp(p, 0.0, 1.0) * float(SIDE)), SIDE - 1);
  return texelFetch(occupied, cell, 0).x != 0u;
}

bool mayHoldSomething(vec3 p) {
  ivec3 cell = min(ivec3(clamp(p, 0.0, 1.0) * float(SIDE)), SIDE - 1);
  return texelFetch(blocks, cell / 4, 0).x != 0u;
}

bool outsideBox(vec3 p) {
  vec3 q = sceneFromTraining * p + sceneOrigin;
  return any(lessThan(q, boxLow)) || any(greaterThan(q, boxHigh));
}

void main() {
  vec2 place = gl_FragCoord.xy * stride + corner;
  vec2 pixel = vec2(place.x, size.y - place.y);
  vec3 d = normalize(trainingFromCamera * vec3((pixel - lens.zw) / lens.xy, 1.0));
  float cone = 2.0 / (lens.x + lens.y);
  vec4 h[4];
  harmonicsOf(d, h);
  vec4 directed[HIDDEN];
#if HASH
  for (int j = 0; j < HIDDEN; j++) {
    vec4 s = vec4(0);
    for (int i = 0; i < 4; i++) s += networks[C1 + j * 8 + 4 + i] * h[i];
    directed[j] = s;
  }
#endif
  float tau = 0.0, total = 0.0, mean = 0.0, apart = 0.0, largest = 0.0, heaviest = -1.0;
  vec3 rgb = vec3(0);
  vec4 shares = vec4(-1);
  for (int first = 0; first < INTERVALS && tau < deepest; first += 16) {
    int past = min(first + 16, INTERVALS);
    float start = cutAt(first), end = cutAt(past);
    if (end - start <= REACH && !mayHoldSomething(cube(origin + d * ((start + end) * 0.5)))) continue;
    for (int k = first; k < past && tau < deepest; k++) {
      end = cutAt(k + 1);
      float middle = (start + end) * 0.5, length = end - start, begin = start;
      start = end;
      vec3 at = origin + d * middle, p = cube(at);
      if (any(lessThan(p, vec3(0))) || any(greaterThan(p, vec3(1))) || !holdsSomething(p)) continue;
      if (boxed && outsideBox(at)) continue;
      Code code;
      float sigma = density(p, cone * middle * stretch(at), code);
      float x = sigma * length, after = tau + x, weight = exp(-tau) * opacityOf(x);
      rgb += weight * (weight > negligible ? colour(code, p, directed, h) : vec3(0.5));
      float where = begin + length * meanShare(x);
      if (weight > 0.0) {
        total += weight;
        float off = where - mean;
        mean += weight / total * off;
        apart += weight * (off * (where - mean) + length * length * varianceShare(x));
      }
      if (weight > largest) { largest = weight; heaviest = where; }
      vec4 crossing = begin + min((targets - tau) / sigma, vec4(length));
      bvec4 now = bvec4(uvec4(lessThan(shares, vec4(0))) * uvec4(greaterThanEqual(vec4(after), targets)));
      shares = mix(shares, crossing, vec4(now));
      tau = after;
    }
  }
  float opacity = opacityOf(tau);
  outColour = vec4(clamp(rgb + exp(-tau) * behind(d), 0.0, 1.0), opacity);
  outEnds = total > 0.0 ? vec4(mean, sqrt(max(apart / total, 0.0)), shares.x, heaviest) : vec4(-1);
  float photos = 0.0;
#if SEEN_SIDE
  if (shares.x >= 0.0) {
    ivec3 cell = min(ivec3(clamp(cube(origin + d * shares.x), 0.0, 1.0) * float(SEEN_SIDE)), SEEN_SIDE - 1);
    uint both = texelFetch(seen, cell, 0).x;
    photos = float(both & 255u) + float(both >> 8) / 256.0;
  }
#endif
  outShares = vec4(shares.yzw, photos);
}
