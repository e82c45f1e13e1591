// From what rays saw to what is on the screen: one of the maps in colours, on the background of the page.

uniform sampler2D fineColour, fineEnds, fineShares, coarseColour, coarseEnds, coarseShares;
uniform sampler2D colours;     // the colour map, 256 x 1
uniform vec4 lens;
uniform vec2 size, coarseSize;
uniform int map;               // which, see MAPS in field.js
uniform bool alongAxis;        // z instead of the distance along the ray
uniform float sceneUnits;      // per unit of the training frame
uniform vec2 range;            // of the colours
uniform float minOpacity, farthest;
uniform vec3 gains;            // of linear light

out vec4 shown;

vec3 linear(vec3 s) { return mix(s / 12.92, pow(max((s + 0.055) / 1.055, 0.0), vec3(2.4)), step(0.04045, s)); }
vec3 srgb(vec3 l) { return mix(l * 12.92, 1.055 * pow(max(l, 0.0), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, l)); }

// The value of a map at a pixel; -1 where it is undefined.
float valueOf(int which, vec4 c, vec4 e, vec4 s, float unit) {
  float alpha = c.a, moment = max(e.x, 0.0) * alpha;
  if (which == 1) return alpha;
  if (which == 5) return moment * unit;
  if (which == 6) return (moment + (1.0 - alpha) * farthest) * unit;
  if (alpha < minOpacity || e.x < 0.0) return -1.0;
  if (which == 2) return e.x * unit;
  if (which == 3) return e.z < 0.0 ? -1.0 : e.z * unit;
  if (which == 4) return e.w * unit;
  if (which == 7) return s.z < 0.0 ? -1.0 : s.z * unit;
  if (which == 8) return e.y * unit;
  if (which >= 10) return e.z < 0.0 ? -1.0 : which == 10 ? floor(s.w) : 256.0 * fract(s.w);
  return e.z < 0.0 ? -1.0 : abs(e.z - e.x) * unit;
}

// Colours of the coarse picture, linear between its pixels.
vec3 between(vec2 place) {
  vec2 at = place - 0.5, share = fract(at);
  ivec2 low = ivec2(floor(at)), most = ivec2(coarseSize) - 1;
  vec3 sum = vec3(0);
  for (int k = 0; k < 4; k++) {
    ivec2 step = ivec2(k & 1, k >> 1);
    vec2 weight = mix(1.0 - share, share, vec2(step));
    sum += weight.x * weight.y * texelFetch(coarseColour, clamp(low + step, ivec2(0), most), 0).rgb;
  }
  return sum;
}

void main() {
  vec2 place = gl_FragCoord.xy;
  vec4 c = texelFetch(fineColour, ivec2(place), 0), e, s;
  if (c.a < 0.0) {  // not drawn yet
    ivec2 at = min(ivec2(place * coarseSize / size), ivec2(coarseSize) - 1);
    c = texelFetch(coarseColour, at, 0);
    e = texelFetch(coarseEnds, at, 0);
    s = texelFetch(coarseShares, at, 0);
    if (map == 0) c.rgb = between(place * coarseSize / size);
  } else {
    e = texelFetch(fineEnds, ivec2(place), 0);
    s = texelFetch(fineShares, ivec2(place), 0);
  }
  if (map == 0) {
    shown = vec4(gains == vec3(1) ? c.rgb : clamp(srgb(linear(c.rgb) * gains), 0.0, 1.0), 1.0);
    return;
  }
  vec2 pixel = vec2(place.x, size.y - place.y);
  float cosine = inversesqrt(1.0 + dot((pixel - lens.zw) / lens.xy, (pixel - lens.zw) / lens.xy));
  float value = valueOf(map, c, e, s, sceneUnits * (alongAxis ? cosine : 1.0));
  if (value < 0.0) {
    ivec2 cell = ivec2(place) / 4;
    shown = vec4(vec3(((cell.x + cell.y) & 1) == 0 ? 0.44 : 0.63), 1.0);
    return;
  }
  float level = clamp((value - range.x) / max(range.y - range.x, 1e-30), 0.0, 1.0);
  shown = vec4(texelFetch(colours, ivec2(int(level * 255.0 + 0.5), 0), 0).rgb, 1.0);
}
