// WebGL2: textures of the field, targets of what rays saw, the two shaders, and reading back.
"use strict";

const CORNERS = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }`;

/** What this browser cannot do, in words; null where it can. */
function whatIsMissing(gl) {
  if (!gl) return "This browser has no WebGL2, which draws this page. Try a current Firefox, Chrome, Edge or Safari, "
    + "with hardware acceleration switched on in its settings.";
  if (gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float")) return null;
  return "This browser's WebGL2 cannot draw into floating-point pictures (EXT_color_buffer_float), which this page needs.";
}

class Renderer {
  /** Throws with words where something cannot be compiled or does not fit. */
  constructor(gl, scene, shaders) {
    this.gl = gl;
    this.scene = scene;
    // Half floats keep three digits of a depth; said where depths are shown.
    this.full = Boolean(gl.getExtension("EXT_color_buffer_float"));
    if (!this.full) gl.getExtension("EXT_color_buffer_half_float");
    this.shaders = shaders;
    this.load();
  }

  /** Take the numbers of the scene's field, at first and whenever they are others. */
  load() {
    const { gl, scene, shaders } = this, bits = Math.max(10, Math.ceil(Math.log2(scene.field.rows) / 2));
    const limit = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (2 ** bits > limit) throw new Error(`the field needs textures of ${2 ** bits} pixels, this device has ${limit}`);
    const block = gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE);
    if (64 * scene.field.networks > block) throw new Error(`the networks need ${64 * scene.field.networks} bytes of `
      + `uniforms, this device has ${block}`);
    const source = shaderSource(scene, shaders.trace, bits);
    if (source !== this.source) {
      if (this.trace) gl.deleteProgram(this.trace.program);
      this.trace = this.program(source);
      this.source = source;
    }
    this.show ||= this.program(glslHead() + shaders.show);
    for (const name in this.textures || {}) gl.deleteTexture(this.textures[name]);
    this.textures = this.fieldTextures(bits);
    this.background = scene.field.background;
    this.bindNetworks();
  }

  /** Draws views as they are asked for, see `Schedule`. */
  schedule(callbacks) { return new Schedule(this, callbacks); }

  program(fragment) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, CORNERS], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(`this device does not compile the shader: ${gl.getShaderInfoLog(shader)}`);
      }
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`this device does not link the shader: ${gl.getProgramInfoLog(program)}`);
    }
    const places = {};
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
    for (let i = 0; i < count; i++) {
      const { name } = gl.getActiveUniform(program, i);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  texture(unit, make, volume = false) {
    const { gl } = this, kind = volume ? gl.TEXTURE_3D : gl.TEXTURE_2D, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    make(kind);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  fieldTextures(bits) {
    const { gl, scene } = this, width = 2 ** bits, height = Math.ceil(scene.field.rows / width);
    const padded = new Int16Array(4 * width * height);
    padded.set(scene.table);
    const side = scene.march.side, blocks = blocksOf(scene.cells, side);
    const rows = Math.ceil(scene.cuts.length / 1024), cuts = new Float32Array(1024 * rows).fill(scene.cuts.at(-1));
    cuts.set(scene.cuts);
    const sky = scene.field.sky ? scene.field.sky.side : 1, voxels = new Int16Array(4 * sky ** 3);
    if (scene.sky) for (let i = 0; i < sky ** 3; i++) for (let c = 0; c < 3; c++) {
      voxels[4 * i + c] = scene.sky[c * sky ** 3 + i];
    }
    const cells = scene.seen || 1, seen = scene.seenCells || new Uint16Array(1);
    return {
      table: this.texture(0, kind =>
        gl.texImage2D(kind, 0, gl.RGBA16I, width, height, 0, gl.RGBA_INTEGER, gl.SHORT, padded)),
      occupied: this.texture(1, kind =>
        gl.texImage3D(kind, 0, gl.R8UI, side, side, side, 0, gl.RED_INTEGER, gl.UNSIGNED_BYTE, scene.cells), true),
      blocks: this.texture(2, kind => gl.texImage3D(kind, 0, gl.R8UI, blocks.count, blocks.count, blocks.count, 0,
        gl.RED_INTEGER, gl.UNSIGNED_BYTE, blocks.near), true),
      cuts: this.texture(3, kind => gl.texImage2D(kind, 0, gl.R32F, 1024, rows, 0, gl.RED, gl.FLOAT, cuts)),
      sky: this.texture(4, kind =>
        gl.texImage3D(kind, 0, gl.RGBA16I, sky, sky, sky, 0, gl.RGBA_INTEGER, gl.SHORT, voxels), true),
      colours: this.texture(5, kind =>
        gl.texImage2D(kind, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, scene.colours)),
      seen: this.texture(5, kind => gl.texImage3D(kind, 0, gl.R16UI, cells, cells, cells, 0,
        gl.RED_INTEGER, gl.UNSIGNED_SHORT, seen), true),
    };
  }

  bindNetworks() {
    const { gl } = this, buffer = this.networks ||= gl.createBuffer();
    const place = gl.getUniformBlockIndex(this.trace.program, "Networks");
    if (place === gl.INVALID_INDEX) return;
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, buffer);
    const { networks } = this.scene;  // a dense grid has none, but the block of the shader wants its 64 bytes
    gl.bufferData(gl.UNIFORM_BUFFER, networks.length ? networks : new Float32Array(16), gl.STATIC_DRAW);
    gl.uniformBlockBinding(this.trace.program, place, 0);
  }

  /** A picture of what rays saw: three textures of four numbers. */
  target(width, height) {
    const { gl } = this, buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    const textures = [0, 1, 2].map(index => {
      const texture = this.texture(15, kind =>
        gl.texStorage2D(kind, 1, this.full ? gl.RGBA32F : gl.RGBA16F, width, height));
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + index, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1, gl.COLOR_ATTACHMENT2]);
    const target = { buffer, textures, width, height };
    this.clear(target);
    return target;
  }

  clear(target) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, -1]);
  }

  release(target) {
    if (!target) return;
    target.textures.forEach(texture => this.gl.deleteTexture(texture));
    this.gl.deleteFramebuffer(target.buffer);
  }

  /** Trace the rays of a tile (x, y, width, height; from the lower left corner) of a target. */
  draw(target, view, { stride = 1, corner = [0, 0], tile = null } = {}) {
    const { gl, scene } = this, { program, places } = this.trace;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...(tile || [0, 0, target.width, target.height]));
    gl.useProgram(program);
    ["table", "occupied", "blocks", "cuts", "sky", "seen"].forEach((name, unit) => {
      gl.uniform1i(places[name], unit);
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(name === "table" || name === "cuts" ? gl.TEXTURE_2D : gl.TEXTURE_3D, this.textures[name]);
    });
    const { scale, rotation, translation } = scene.training_from_scene;
    const turned = product(rotation, view.turn);
    const origin = rotation.map((r, i) => scale * dot(r, view.place) + translation[i]);
    gl.uniformMatrix3fv(places.trainingFromCamera, false, columns(turned));
    gl.uniform3fv(places.origin, origin);
    gl.uniform4fv(places.lens, view.lens);
    gl.uniform2f(places.size, view.width, view.height);
    gl.uniform1f(places.stride, stride);
    gl.uniform2f(places.corner, ...corner);
    const tolerance = view.tolerance || scene.tolerance;
    gl.uniform1f(places.deepest, -Math.log(0.1 * tolerance));
    gl.uniform1f(places.negligible, tolerance / 50);
    gl.uniform4fv(places.targets, [0.5, 0.05, 0.95, view.share].map(share => -Math.log1p(-share)));
    gl.uniform3fv(places.background, this.background);
    gl.uniform1fv(places["scales[0]"], scene.field.scales);
    gl.uniform1f(places.skyScale, scene.field.sky ? scene.field.sky.scale : 1);
    gl.uniform1i(places.boxed, view.box ? 1 : 0);
    if (view.box) {
      const back = transposed(rotation).map(r => r.map(v => v / scale));
      gl.uniformMatrix3fv(places.sceneFromTraining, false, columns(back));
      gl.uniform3fv(places.sceneOrigin, back.map(r => -dot(r, translation)));
      gl.uniform3fv(places.boxLow, view.box.slice(0, 3));
      gl.uniform3fv(places.boxHigh, view.box.slice(3));
    }
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** The numbers of a target: three arrays, row by row from the top, four numbers a pixel. */
  read(target) {
    const { gl } = this, { width, height } = target;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    return [0, 1, 2].map(index => {
      const values = new Float32Array(4 * width * height), rows = new Float32Array(values.length);
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + index);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
      for (let y = 0; y < height; y++) {
        rows.set(values.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
      }
      return rows;
    });
  }

  /** What the rays of a whole small picture see, at once. */
  picture(view, stride = 1) {
    const target = this.target(Math.max(1, Math.ceil(view.width / stride)), Math.max(1, Math.ceil(view.height / stride)));
    this.draw(target, view, { stride });
    const values = this.read(target);
    this.release(target);
    return { width: target.width, height: target.height, colour: values[0], ends: values[1], shares: values[2] };
  }

  /** What the ray of one pixel sees. */
  probe(view, x, y) {
    const target = this.target(1, 1);
    this.draw(target, view, { corner: [Math.floor(x), view.height - 1 - Math.floor(y)] });
    const [colour, ends, shares] = this.read(target);
    this.release(target);
    return { rgb: [...colour.slice(0, 3)], opacity: colour[3], mean: ends[0], spread: ends[1], median: ends[2],
      low: shares[0], high: shares[1] };
  }

  /** Show a map of the fine target, of the coarse one where that is not drawn yet. */
  present(fine, coarse, view, look) {
    const { gl, scene } = this, { program, places } = this.show;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, view.width, view.height);
    gl.useProgram(program);
    const names = ["fineColour", "fineEnds", "fineShares", "coarseColour", "coarseEnds", "coarseShares"];
    [...fine.textures, ...coarse.textures].forEach((texture, index) => {
      gl.activeTexture(gl.TEXTURE0 + 6 + index);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(places[names[index]], 6 + index);
    });
    gl.activeTexture(gl.TEXTURE0 + 5);
    gl.bindTexture(gl.TEXTURE_2D, this.textures.colours);
    gl.uniform1i(places.colours, 5);
    gl.uniform4fv(places.lens, view.lens);
    gl.uniform2f(places.size, view.width, view.height);
    gl.uniform2f(places.coarseSize, coarse.width, coarse.height);
    gl.uniform1i(places.map, look.map);
    gl.uniform1i(places.alongAxis, look.axis === "z" ? 1 : 0);
    gl.uniform1f(places.sceneUnits, look.map === 1 ? 1 : 1 / scene.training_from_scene.scale);
    gl.uniform2fv(places.range, look.range);
    gl.uniform1f(places.minOpacity, look.minOpacity);
    gl.uniform1f(places.farthest, scene.march.far);
    gl.uniform3fv(places.gains, look.gains);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
