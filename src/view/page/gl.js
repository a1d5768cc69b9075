// Draws cloth and obstacles with WebGL2: smooth shading, soft shadows, colors by category or by value.

import { CLOTH, COARSE, MAPS, OBSTACLE, category } from "./colors.js";
import { add, cross, lookAt, multiply, orthographic, unit } from "./camera.js";

const SHADOW = 1024;
const PALETTE = 32;

/** How the cloth is colored; the numbers are those of the shader. */
export const MODE = { plain: 0, category: 1, map: 2, height: 3, uniform: 4 };

const VERTEX = `#version 300 es
layout(location = 0) in vec3 a_position;
layout(location = 1) in vec3 a_normal;
layout(location = 2) in float a_value;
layout(location = 3) in uint a_category;
uniform mat4 u_view;
uniform mat4 u_projection;
uniform mat4 u_light;
uniform vec4 u_axis; // the up axis, and the height of zero
out vec3 v_position;
out vec3 v_normal;
out vec3 v_light;
out float v_value;
out float v_height;
flat out uint v_category;
void main() {
  vec4 at = u_view * vec4(a_position, 1.0);
  v_position = at.xyz;
  v_normal = mat3(u_view) * a_normal;
  v_light = (u_light * vec4(a_position, 1.0)).xyz * 0.5 + 0.5;
  v_value = a_value;
  v_height = dot(a_position, u_axis.xyz) - u_axis.w;
  v_category = a_category;
  gl_Position = u_projection * at;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DShadow;
in vec3 v_position;
in vec3 v_normal;
in vec3 v_light;
in float v_value;
in float v_height;
flat in uint v_category;
uniform int u_mode;
uniform int u_ground;
uniform int u_shadows;
uniform vec3 u_front;
uniform vec3 u_back;
uniform vec3 u_palette[${PALETTE}];
uniform vec3 u_map[5];
uniform vec2 u_range; // value of the first stop, 1 / (last - first)
uniform vec3 u_key;  // toward the light, in view space
uniform vec3 u_sky;  // up, in view space
uniform sampler2DShadow u_depth;
out vec4 o_color;

vec3 mapped(float value) {
  float t = clamp((value - u_range.x) * u_range.y, 0.0, 1.0) * 4.0;
  int i = min(int(t), 3);
  return mix(u_map[i], u_map[i + 1], t - float(i));
}

float lit() {
  if (u_shadows == 0) return 1.0;
  vec3 at = v_light;
  if (any(lessThan(at, vec3(0.0))) || any(greaterThan(at, vec3(1.0)))) return 1.0;
  if (u_shadows == 1) return texture(u_depth, at);
  float sum = 0.0;
  const float step = 1.6 / ${SHADOW}.0;
  for (int i = 0; i < 4; i++) {
    vec2 offset = vec2(float(i & 1) - 0.5, float(i >> 1) - 0.5) * step;
    sum += texture(u_depth, vec3(at.xy + offset, at.z));
  }
  return sum * 0.25;
}

void main() {
  if (u_ground == 1) {
    // v_value: distance from the middle of the ground over its radius.
    float fade = 1.0 - smoothstep(0.25, 1.0, v_value);
    o_color = vec4(0.03, 0.04, 0.06, (1.0 - lit()) * 0.38 * fade);
    return;
  }
  vec3 n = normalize(v_normal);
  bool front = gl_FrontFacing;
  if (u_mode >= 0 && !front) n = -n;
  vec3 base = front ? u_front : u_back;
  if (u_mode == 1) base = u_palette[int(v_category % ${PALETTE}u)];
  if (u_mode == 2) base = mapped(v_value);
  if (u_mode == 3) base = mapped(v_height);
  // What is behind a color by category or value stays readable.
  if (u_mode >= 1 && !front) base *= 0.86;
  base *= base; // a gamma of 2 is near enough to that of the screen, and cheap without a GPU
  float light_reaches = lit();
  vec3 eye = normalize(-v_position);
  float key = dot(n, u_key);
  float direct = max(key, 0.0) * light_reaches;
  float wrap = 0.5 + 0.5 * key;
  float sky = 0.5 + 0.5 * dot(n, u_sky);
  float head = max(dot(n, eye), 0.0);
  vec3 light = vec3(1.0, 0.97, 0.92) * (direct * 0.78 + wrap * 0.10)
             + vec3(0.62, 0.72, 0.88) * sky * 0.20
             + vec3(0.5, 0.46, 0.42) * (1.0 - sky) * 0.09
             + vec3(1.0) * head * 0.16;
  vec3 halfway = normalize(u_key + eye);
  float shine = max(dot(n, halfway), 0.0);
  shine *= shine; shine *= shine; shine *= shine; shine *= shine; shine *= shine;
  shine *= 0.10 * light_reaches;
  float rim = (1.0 - head) * (1.0 - head) * (1.0 - head) * 0.10;
  vec3 color = base * light + shine + rim * vec3(0.55, 0.65, 0.8) * (0.3 + base);
  color = color / (color * 0.18 + 0.93);
  o_color = vec4(sqrt(color), 1.0);
}`;

const DEPTH_VERTEX = `#version 300 es
layout(location = 0) in vec3 a_position;
uniform mat4 u_light;
void main() { gl_Position = u_light * vec4(a_position, 1.0); }`;
const DEPTH_FRAGMENT = `#version 300 es
void main() {}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
out vec4 o_color;
uniform vec4 u_color;
void main() { o_color = u_color; }`;
const LINE_VERTEX = `#version 300 es
layout(location = 0) in vec3 a_position;
uniform mat4 u_view;
uniform mat4 u_projection;
void main() {
  vec4 at = u_view * vec4(a_position, 1.0);
  at.xyz *= 0.9993; // lines lie on the cloth, not in it
  gl_Position = u_projection * at;
}`;

/** Whether WebGL is done by the processor here. */
function isSoftware(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  return { name, software: /swiftshader|llvmpipe|software|basic render/i.test(name) };
}

export class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    const probe = document.createElement("canvas").getContext("webgl2");
    if (!probe) throw new Error("this browser has no WebGL2");
    Object.assign(this, isSoftware(probe));
    probe.getExtension("WEBGL_lose_context")?.loseContext();
    const gl = canvas.getContext("webgl2", { antialias: !this.software, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    this.main = this.program(VERTEX, FRAGMENT);
    this.depth = this.program(DEPTH_VERTEX, DEPTH_FRAGMENT);
    this.line = this.program(LINE_VERTEX, LINE_FRAGMENT);
    this.ground = this.makeGround();
    this.shadows = [this.makeShadow(), this.makeShadow()];
    gl.enable(gl.DEPTH_TEST);
    // What obstacles and the ground have in place of a category must be a whole number, too.
    gl.vertexAttribI4ui(3, 0, 0, 0, 0);
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  makeShadow() {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SHADOW, SHADOW);
    for (const [name, value] of [
      [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE], [gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL],
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, name, value);
    const frameBuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frameBuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
    gl.drawBuffers([gl.NONE]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { texture, frameBuffer, seen: null };
  }

  makeGround() {
    const surface = new Surface(this.gl);
    surface.value(new Float32Array([0, ...Array(33).fill(1)]));
    return surface;
  }

  surface() {
    return new Surface(this.gl);
  }

  /** Makes the canvas as large as its place; `scale`: pixels per pixel of the page. */
  resize(scale) {
    const width = Math.max(1, Math.round(this.canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * scale));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
  }

  /** Draws views side by side; see `view` for what a view is. */
  draw(views, camera, options) {
    const { gl, canvas } = this;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...options.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const width = Math.floor(canvas.width / Math.max(1, views.length));
    views.forEach((view, i) => this.view(view, camera, options, i, [i * width, 0, width, canvas.height]));
  }

  /** A view: cloth and obstacle surfaces, `mode`, `map`, `range`, colors, bounds `box` of what casts shadows. */
  view(view, camera, options, number, [x, y, width, height]) {
    if (!view.cloth) return;
    const { gl } = this;
    const up = camera.up;
    const [ahead, side] = camera.level;
    const toLight = unit(add(add(up.map((v) => v * 1.15), side, -0.55), ahead, 0.75));
    const [low, high] = view.box;
    const middle = low.map((v, i) => (v + high[i]) / 2);
    const radius = Math.max(1e-6, Math.hypot(...low.map((v, i) => high[i] - v)) / 2);
    const across = Math.abs(toLight[0]) > 0.9 ? [0, 0, 1] : [1, 0, 0];
    const lightView = lookAt(add(middle, toLight, 2 * radius), middle, unit(cross(toLight, across)));
    const light = multiply(orthographic(radius * 1.02, radius * 0.5, radius * 3.6), lightView);
    if (options.shadows) this.drawShadow(view, number, light);

    gl.viewport(x, y, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, y, width, height);
    const { view: look, projection } = camera.matrices(width / height);
    const turned = (v) => [0, 1, 2].map((r) => look[r] * v[0] + look[4 + r] * v[1] + look[8 + r] * v[2]);
    const { program, at } = this.main;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.u_view, false, look);
    gl.uniformMatrix4fv(at.u_projection, false, projection);
    gl.uniformMatrix4fv(at.u_light, false, light);
    gl.uniform3fv(at.u_key, turned(toLight));
    gl.uniform3fv(at.u_sky, turned(up));
    gl.uniform1i(at.u_shadows, !options.shadows ? 0 : this.software ? 1 : 4);
    gl.uniform4f(at.u_axis, ...up, 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.shadows[number].texture);
    gl.uniform1i(at.u_depth, 0);
    gl.uniform1i(at.u_ground, 0);

    if (view.obstacle) {
      gl.uniform1i(at.u_mode, -1);
      gl.uniform3fv(at.u_front, OBSTACLE);
      gl.uniform3fv(at.u_back, OBSTACLE);
      view.obstacle.draw(gl.TRIANGLES);
    }
    this.cloth(view, at);
    if (options.wire) this.drawWire(view, look, projection);
    if (options.shadows && !view.obstacle) this.drawGround(camera, view, at, program);
    gl.disable(gl.SCISSOR_TEST);
  }

  cloth(view, at) {
    const { gl } = this;
    const mode = view.coarse && view.mode === MODE.plain ? MODE.uniform : view.mode;
    gl.uniform1i(at.u_mode, mode);
    const [front, back] = view.colors || (view.coarse ? [COARSE, COARSE.map((c) => c * 0.8)] : CLOTH);
    gl.uniform3fv(at.u_front, front);
    gl.uniform3fv(at.u_back, back);
    if (mode === MODE.category) {
      const palette = new Float32Array(3 * PALETTE);
      for (let i = 0; i < PALETTE; i++) palette.set(category(i), 3 * i);
      gl.uniform3fv(at.u_palette, palette);
    }
    if (mode === MODE.map || mode === MODE.height) {
      gl.uniform3fv(at.u_map, new Float32Array(MAPS[view.map].flat()));
      const [from, to] = view.range;
      gl.uniform2f(at.u_range, from, 1 / Math.max(1e-12, to - from));
    }
    view.cloth.draw(gl.TRIANGLES);
  }

  /** What the light sees. It stays until the view shows something else, however the camera turns. */
  drawShadow(view, number, light) {
    const { gl } = this;
    const shadow = this.shadows[number];
    const seen = [view.frame, view.cloth, view.cloth.count, view.obstacle, view.obstacle?.shown(), light.join()];
    if (shadow.seen && shadow.seen.every((one, i) => one === seen[i])) return;
    shadow.seen = seen;
    gl.bindFramebuffer(gl.FRAMEBUFFER, shadow.frameBuffer);
    gl.viewport(0, 0, SHADOW, SHADOW);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.depth.program);
    gl.uniformMatrix4fv(this.depth.at.u_light, false, light);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(2.5, 6);
    view.cloth.draw(gl.TRIANGLES);
    if (view.obstacle) view.obstacle.draw(gl.TRIANGLES);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  drawWire(view, look, projection) {
    const { gl, line } = this;
    gl.useProgram(line.program);
    gl.uniformMatrix4fv(line.at.u_view, false, look);
    gl.uniformMatrix4fv(line.at.u_projection, false, projection);
    gl.uniform4f(line.at.u_color, 0.05, 0.06, 0.09, 1);
    view.cloth.drawEdges();
  }

  /** A disc below a scene without obstacles, which shows its shadow. */
  drawGround(camera, view, at, program) {
    const { gl } = this;
    const [low, high] = view.box;
    const axis = camera.upAxis === "z" ? 2 : 1;
    const middle = low.map((v, i) => (v + high[i]) / 2);
    const radius = Math.hypot(...low.map((v, i) => high[i] - v)) * 0.9;
    middle[axis] = low[axis] - 0.02 * radius;
    const [ahead, side] = camera.level;
    const points = [...middle];
    for (let i = 0; i <= 32; i++) {
      const angle = (i / 32) * 2 * Math.PI;
      points.push(...add(add(middle, ahead, radius * Math.cos(angle)), side, radius * Math.sin(angle)));
    }
    this.ground.positions(new Float32Array(points));
    gl.useProgram(program);
    gl.uniform1i(at.u_ground, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    this.ground.draw(gl.TRIANGLE_FAN);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.uniform1i(at.u_ground, 0);
  }
}

/** Vertices, and optionally triangles, on the device. */
export class Surface {
  constructor(gl) {
    this.gl = gl;
    this.array = gl.createVertexArray();
    this.buffers = {};
    this.count = 0;
    this.indexed = false;
  }

  fill(name, target, data, usage) {
    const { gl } = this;
    gl.bindVertexArray(this.array);
    const known = this.buffers[name];
    if (known && known.bytes === data.byteLength) {
      gl.bindBuffer(target, known.buffer);
      gl.bufferSubData(target, 0, data);
      return false;
    }
    if (known) gl.deleteBuffer(known.buffer);
    const buffer = gl.createBuffer();
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, data, usage);
    this.buffers[name] = { buffer, bytes: data.byteLength };
    return true;
  }

  attribute(name, location, size, type, data, { stride = 0, normalized = false, integer = false } = {}) {
    const { gl } = this;
    if (!this.fill(name, gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW)) return;
    gl.enableVertexAttribArray(location);
    if (integer) gl.vertexAttribIPointer(location, size, type, stride, 0);
    else gl.vertexAttribPointer(location, size, type, normalized, stride, 0);
  }

  positions(data) {
    if (!this.indexed) this.count = data.length / 3;
    this.attribute("positions", 0, 3, this.gl.FLOAT, data);
  }

  normals(data) {
    this.attribute("normals", 1, 3, this.gl.SHORT, data, { stride: 8, normalized: true });
  }

  value(data) {
    this.attribute("value", 2, 1, this.gl.FLOAT, data);
  }

  category(data) {
    this.attribute("category", 3, 1, this.gl.UNSIGNED_SHORT, data, { integer: true });
  }

  triangles(data) {
    this.indexed = true;
    this.fill("index", this.gl.ELEMENT_ARRAY_BUFFER, data, this.gl.STATIC_DRAW);
    this.count = data.length;
    this.edges = null;
    this.corners = data;
  }

  /** Draws only these ranges [from, to) of the vertices. */
  only(ranges) {
    this.ranges = ranges;
  }

  /** What tells apart which vertices are drawn. */
  shown() {
    return JSON.stringify(this.ranges || this.count);
  }

  draw(kind) {
    const { gl } = this;
    gl.bindVertexArray(this.array);
    if (this.indexed) gl.drawElements(kind, this.count, gl.UNSIGNED_INT, 0);
    else for (const [from, to] of this.ranges || [[0, this.count]]) gl.drawArrays(kind, from, to - from);
  }

  drawEdges() {
    const { gl } = this;
    if (!this.edges && this.corners) {
      // Every edge once, as far as its triangles agree on the direction; borders once anyway.
      const lines = new Uint32Array(2 * this.corners.length);
      let n = 0;
      for (let t = 0; t < this.corners.length; t += 3) {
        for (let k = 0; k < 3; k++) {
          lines[n++] = this.corners[t + k];
          lines[n++] = this.corners[t + ((k + 1) % 3)];
        }
      }
      this.lineArray = gl.createVertexArray();
      gl.bindVertexArray(this.lineArray);
      this.edges = gl.createBuffer();
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.edges);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, lines, gl.STATIC_DRAW);
      this.edgeCount = n;
    }
    gl.bindVertexArray(this.lineArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers.positions.buffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.drawElements(gl.LINES, this.edgeCount, gl.UNSIGNED_INT, 0);
  }

  free() {
    const { gl } = this;
    Object.values(this.buffers).forEach(({ buffer }) => gl.deleteBuffer(buffer));
    gl.deleteVertexArray(this.array);
  }
}
