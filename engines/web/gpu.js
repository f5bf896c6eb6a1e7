/**
 * One way to draw on WebGPU and on WebGL2: passes that read textures and blend into textures.
 *
 * Shaders are written once, in a part of GLSL that `toWgsl` turns into WGSL line by line: one declaration a line, braces
 * around every branch, no `?:`, no `out`. `fetch(texture, cell, 0)` and `fetchLayer(texture, cell, layer, 0)` read texels,
 * `u` holds the uniforms, all of them vec4 or arrays of vec4. `pixel` is the middle of a pixel; row 0 comes first in
 * every texture, on both. A vertex shader sets `position`, whose y points down, and varyings v0 …; a fragment shader sets out0 ….
 */

/** A machine cannot draw, or a shader is refused; the message says what. */
export class GpuError extends Error {}

const TYPES = {float: "f32", int: "i32", uint: "u32", bool: "bool", vec2: "vec2f", vec3: "vec3f", vec4: "vec4f"};
Object.assign(TYPES, {ivec2: "vec2i", ivec4: "vec4i", mat3: "mat3x3f"});
const TYPE = `(${Object.keys(TYPES).join("|")}|[A-Z]\\w*)`;
const wgslType = (name) => TYPES[name] ?? name;
const BUILT_IN = {fetch: "textureLoad", fetchLayer: "textureLoad", inversesqrt: "inverseSqrt"};

/** Return a shader of the dialect as WGSL. */
export function toWgsl(source) {
  const parameters = (list) => list.split(", ").filter(Boolean).map((each) => {
    const [type, name] = each.split(" ");
    return `${name}: ${wgslType(type)}`;
  }).join(", ");
  return source
    .replace(new RegExp(`^const ${TYPE} (\\w+) =`, "gm"), (_, type, name) => `const ${name}: ${wgslType(type)} =`)
    .replace(new RegExp(`^(void|${TYPE}) (\\w+)\\(([^)]*)\\) \\{`, "gm"),
      (_, type, _type, name, list) => `fn ${name}(${parameters(list)})${type === "void" ? "" : ` -> ${wgslType(type)}`} {`)
    .replace(new RegExp(`for \\(${TYPE} (\\w+) =`, "g"), (_, type, name) => `for (var ${name}: ${wgslType(type)} =`)
    .replace(new RegExp(`^(\\s+)${TYPE} (\\w+)( =|;)`, "gm"), (_, space, type, name, rest) => `${space}var ${name}: ${wgslType(type)}${rest}`)
    .replace(/\b(fetch|fetchLayer|inversesqrt|vec[234]|ivec[24]|mat3|float|int|uint)\(/g, (_, name) => `${BUILT_IN[name] ?? TYPES[name]}(`);
}

/** Where each uniform starts, in floats, and how many there are. */
function layoutOf(uniforms) {
  const starts = {};
  let size = 0;
  for (const [name, length = 1] of uniforms) {
    starts[name] = size;
    size += 4 * length;
  }
  return {starts, values: new Float32Array(Math.max(size, 4))};
}

/** Put uniforms, arrays of numbers by name, where shaders find them. */
function pack({starts, values}, given) {
  values.fill(0);
  for (const [name, numbers] of Object.entries(given)) values.set(numbers, starts[name]);
  return values;
}

const FULLSCREEN = `void vertexMain() {
  position = vec4(float((vertexIndex % 2) * 4) - 1.0, float((vertexIndex / 2) * 4) - 1.0, 0.0, 1.0);
}
`;
/** Blending by name: source and destination factors. */
const BLENDS = {over: ["ONE", "ONE_MINUS_SRC_ALPHA"], times: ["DST_COLOR", "ZERO"], plus: ["ONE", "ONE"]};
const numbered = (count, line) => Array.from({length: count}, (_, k) => line(k)).join("\n");

/** WebGL2 with float targets. */
export class WebGL2 {
  static create(canvas, context) {
    const gl = context ?? (canvas ?? new OffscreenCanvas(1, 1)).getContext("webgl2", {alpha: true, premultipliedAlpha: true, antialias: false});
    if (!gl) throw new GpuError("this browser must offer WebGL2, got none. Update it, or turn on graphics acceleration.");
    const missing = ["EXT_color_buffer_float", "EXT_float_blend"].filter((name) => !gl.getExtension(name));
    if (missing.includes("EXT_color_buffer_float")) {
      throw new GpuError(`WebGL2 must draw into float textures, got no ${missing}. Use another device.`);
    }
    return Object.assign(new WebGL2(), {gl, canvas, name: "webgl2", blendFormat: missing.length ? "rgba16float" : "rgba32float",
      framebuffers: [gl.createFramebuffer(), gl.createFramebuffer()], vertices: gl.createVertexArray(), made: new Set()});
  }

  texture({width, height, layers = 0, format}) {
    const gl = this.gl, target = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, handle = gl.createTexture();
    gl.bindTexture(target, handle);
    const inner = {rgba8unorm: gl.RGBA8, rgba32float: gl.RGBA32F, rgba16float: gl.RGBA16F, r32float: gl.R32F, r8sint: gl.R8I}[format];
    if (layers) gl.texStorage3D(target, 1, inner, width, height, layers);
    else gl.texStorage2D(target, 1, inner, width, height);
    for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(target, gl[`TEXTURE_${name}`], gl.NEAREST);
    for (const name of ["WRAP_S", "WRAP_T"]) gl.texParameteri(target, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
    const texture = {handle, target, width, height, layers, format};
    this.made.add(texture);
    return texture;
  }

  write(texture, data, {layer = 0, y = 0, width = texture.width, height = texture.height} = {}) {
    const gl = this.gl;
    const [order, type] = {rgba32float: [gl.RGBA, gl.FLOAT], r32float: [gl.RED, gl.FLOAT], r8sint: [gl.RED_INTEGER, gl.BYTE]}[texture.format];
    gl.bindTexture(texture.target, texture.handle);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
    for (const [name, value] of [["UNPACK_ALIGNMENT", 1], ["UNPACK_ROW_LENGTH", 0], ["UNPACK_SKIP_ROWS", 0], ["UNPACK_SKIP_PIXELS", 0],
      ["UNPACK_FLIP_Y_WEBGL", false], ["UNPACK_PREMULTIPLY_ALPHA_WEBGL", false]]) gl.pixelStorei(gl[name], value);
    if (texture.layers) gl.texSubImage3D(texture.target, 0, 0, y, layer, width, height, 1, order, type, data);
    else gl.texSubImage2D(texture.target, 0, 0, y, width, height, order, type, data);
  }

  destroy(texture) {
    if (texture && this.made.delete(texture)) this.gl.deleteTexture(texture.handle);
  }

  program({name, uniforms = [], textures = [], varyings = 0, outputs = ["canvas"], blend = null, vertex = FULLSCREEN, fragment, shading}) {
    const gl = this.gl;
    const samplers = {float2d: "sampler2D", array: "sampler2DArray", ints: "isampler2DArray"};
    const lead = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp sampler2DArray; precision highp isampler2DArray;
#define fetch texelFetch
#define fetchLayer(t, p, l, z) texelFetch(t, ivec3(p, l), z)
layout(std140) uniform Uniforms {\n${uniforms.map(([n, l]) => `vec4 ${n}${l ? `[${l}]` : ""};`).join("\n") || "vec4 none;"}\n} u;
${textures.map(([n, kind]) => `uniform highp ${samplers[kind]} ${n};`).join("\n")}\n`;
    const compiled = [
      [gl.VERTEX_SHADER, `${lead}int vertexIndex; int instanceIndex; vec4 position;\n${numbered(varyings, (k) => `flat out vec4 v${k};`)}\n${vertex}
void main() { vertexIndex = gl_VertexID; instanceIndex = gl_InstanceID; vertexMain(); gl_Position = position; }`],
      [gl.FRAGMENT_SHADER, `${lead}vec2 pixel;\n${numbered(varyings, (k) => `flat in vec4 v${k};`)}
${outputs.map((_, k) => `layout(location = ${k}) out vec4 out${k};`).join("\n")}\n${fragment.replace("#shading\n", shading?.glsl ?? "")}
void main() { pixel = gl_FragCoord.xy; fragmentMain(); }`],
    ].map(([kind, text]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      return [shader, text];
    });
    const handle = gl.createProgram();
    for (const [shader] of compiled) gl.attachShader(handle, shader);
    gl.linkProgram(handle);
    if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = compiled.map(([shader]) => gl.getShaderInfoLog(shader)).concat(gl.getProgramInfoLog(handle)).join("\n");
      throw new GpuError(`the shader ${name} must compile, got ${logs}`);
    }
    for (const [shader] of compiled) gl.deleteShader(shader);
    gl.useProgram(handle);
    textures.forEach(([each], unit) => gl.uniform1i(gl.getUniformLocation(handle, each), unit));
    const block = gl.getUniformBlockIndex(handle, "Uniforms");
    if (block !== gl.INVALID_INDEX) gl.uniformBlockBinding(handle, block, 0);
    return {handle, textures, blend, layout: layoutOf(uniforms), buffer: gl.createBuffer()};
  }

  /** Run a pass: `targets` are textures, or [texture, layer]; none for the canvas, or for `target`: a
   *  framebuffer and where in it. `clear` is a colour, or null to keep. */
  draw(program, {targets = [], uniforms = {}, textures = {}, instances = 0, clear = null, target = null}) {
    const gl = this.gl, pairs = targets.map((each) => Array.isArray(each) ? each : [each, 0]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, pairs.length ? this.framebuffers[0] : target?.framebuffer ?? null);
    pairs.forEach(([texture, layer], k) => {
      if (texture.layers) gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, texture.handle, 0, layer);
      else gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture.handle, 0);
    });
    for (let k = Math.max(pairs.length, 1); pairs.length && k < 4; k++) {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, null, 0);
    }
    if (pairs.length) gl.drawBuffers(pairs.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    const {width, height, x = 0, y = 0} = pairs[0]?.[0] ?? target ?? this.gl.canvas;
    gl.viewport(x, y, width, height);
    for (const name of ["DEPTH_TEST", "STENCIL_TEST", "CULL_FACE", "SCISSOR_TEST", "BLEND", "DITHER"]) gl.disable(gl[name]);
    gl.colorMask(true, true, true, true);
    if (clear) {
      if (pairs.length) pairs.forEach((_, k) => gl.clearBufferfv(gl.COLOR, k, clear));
      else gl.clearBufferfv(gl.COLOR, 0, clear);
    }
    if (program.blend) {
      gl.enable(gl.BLEND);
      gl.blendEquation(gl.FUNC_ADD);
      gl.blendFunc(...BLENDS[program.blend].map((factor) => gl[factor]));
    }
    gl.useProgram(program.handle);
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.UNIFORM_BUFFER, program.buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, pack(program.layout, uniforms), gl.DYNAMIC_DRAW);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, program.buffer);
    program.textures.forEach(([name], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(textures[name].target, textures[name].handle);
      gl.bindSampler(unit, null);
    });
    if (instances) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, instances);
    else if (instances === 0) gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }

  /** Return a texture's RGBA numbers, row by row from the first: floats, or bytes of an 8-bit one. */
  async read(texture, layer = 0) {
    const gl = this.gl, {width, height} = texture, isBytes = texture.format === "rgba8unorm";
    const content = new (isBytes ? Uint8Array : Float32Array)(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffers[1]);
    if (texture.layers) gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, texture.handle, 0, layer);
    else gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture.handle, 0);
    gl.readPixels(0, 0, width, height, gl.RGBA, isBytes ? gl.UNSIGNED_BYTE : gl.FLOAT, content);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return content;
  }

  onLost(call) {
    this.watch = (event) => { event.preventDefault(); call("the WebGL context was lost"); };
    this.gl.canvas.addEventListener("webglcontextlost", this.watch);
  }

  get maxTextureSide() {
    return this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
  }

  dispose() {
    this.gl.canvas.removeEventListener("webglcontextlost", this.watch);
    for (const texture of [...this.made]) this.destroy(texture);
    for (const framebuffer of this.framebuffers) this.gl.deleteFramebuffer(framebuffer);
    this.gl.deleteVertexArray(this.vertices);
  }
}

/** WebGPU. */
export class WebGPU {
  static async create(canvas, device = null) {
    let features = device?.features;
    if (!device) {
      const adapter = await globalThis.navigator?.gpu?.requestAdapter({powerPreference: "high-performance"});
      if (!adapter) throw new GpuError("this browser must offer WebGPU, got no adapter. Use WebGL2.");
      const wanted = ["float32-blendable"].filter((name) => adapter.features.has(name));
      const limit = adapter.limits.maxColorAttachmentBytesPerSample;
      device = await adapter.requestDevice({requiredFeatures: wanted, requiredLimits: {maxColorAttachmentBytesPerSample: limit,
        maxTextureDimension2D: adapter.limits.maxTextureDimension2D, maxBufferSize: adapter.limits.maxBufferSize}});
      features = device.features;
    }
    const gpu = Object.assign(new WebGPU(), {device, canvas, name: "webgpu", made: new Set(),
      blendFormat: features.has("float32-blendable") && device.limits.maxColorAttachmentBytesPerSample >= 64 ? "rgba32float" : "rgba16float"});
    gpu.context = canvas?.getContext("webgpu");
    if (canvas && !gpu.context) throw new GpuError("the canvas must be free for WebGPU, got one with another context. Make a new one.");
    gpu.format = canvas ? navigator.gpu.getPreferredCanvasFormat() : "rgba8unorm";
    gpu.context?.configure({device, format: gpu.format, alphaMode: "premultiplied"});
    return gpu;
  }

  texture({width, height, layers = 0, format}) {
    const usage = GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST | GPUTextureUsage.COPY_SRC
      | (format === "r8sint" ? 0 : GPUTextureUsage.RENDER_ATTACHMENT);
    const handle = this.device.createTexture({size: [width, height, layers || 1], format, usage});
    const texture = {handle, width, height, layers, format, view: handle.createView({dimension: layers ? "2d-array" : "2d"})};
    this.made.add(texture);
    return texture;
  }

  write(texture, data, {layer = 0, y = 0, width = texture.width, height = texture.height} = {}) {
    const bytes = {rgba32float: 16, r32float: 4, r8sint: 1}[texture.format];
    this.device.queue.writeTexture({texture: texture.handle, origin: [0, y, layer]}, data, {bytesPerRow: bytes * width}, [width, height, 1]);
  }

  destroy(texture) {
    if (texture && this.made.delete(texture)) texture.handle.destroy();
  }

  program({name, uniforms = [], textures = [], varyings = 0, outputs = ["canvas"], blend = null, vertex = FULLSCREEN, fragment, shading}) {
    const device = this.device, kinds = {float2d: "texture_2d<f32>", array: "texture_2d_array<f32>", ints: "texture_2d_array<i32>"};
    const lead = `struct Uniforms {\n${uniforms.map(([n, l]) => `${n}: ${l ? `array<vec4f, ${l}>` : "vec4f"},`).join("\n") || "none: vec4f,"}\n}
@group(0) @binding(0) var<uniform> u: Uniforms;
${textures.map(([n, kind], k) => `@group(0) @binding(${k + 1}) var ${n}: ${kinds[kind]};`).join("\n")}
struct Varyings { @builtin(position) position: vec4f,\n${numbered(varyings, (k) => `@location(${k}) @interpolate(flat) v${k}: vec4f,`)}\n}
${numbered(varyings, (k) => `var<private> v${k}: vec4f;`)}\n`;
    const text = [`${lead}var<private> vertexIndex: i32;\nvar<private> instanceIndex: i32;\nvar<private> position: vec4f;\n${toWgsl(vertex)}
@vertex fn main(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Varyings {
vertexIndex = i32(vertex); instanceIndex = i32(instance); vertexMain(); position.y = -position.y;
return Varyings(position${Array.from({length: varyings}, (_, k) => `, v${k}`).join("")}); }`,
    `${lead}var<private> pixel: vec2f;\n${numbered(outputs.length, (k) => `var<private> out${k}: vec4f;`)}
struct Outputs {\n${outputs.map((_, k) => `@location(${k}) out${k}: vec4f,`).join("\n")}\n}
${toWgsl(fragment).replace("#shading\n", shading?.wgsl ?? "")}
@fragment fn main(given: Varyings) -> Outputs {
pixel = given.position.xy; ${Array.from({length: varyings}, (_, k) => `v${k} = given.v${k};`).join(" ")} fragmentMain();
return Outputs(${outputs.map((_, k) => `out${k}`).join(", ")}); }`];
    const visibility = GPUShaderStage.VERTEX | GPUShaderStage.FRAGMENT;
    const group = device.createBindGroupLayout({entries: [{binding: 0, visibility, buffer: {}}, ...textures.map(([, kind], k) => ({
      binding: k + 1, visibility,
      texture: {sampleType: kind === "ints" ? "sint" : "unfilterable-float", viewDimension: kind === "float2d" ? "2d" : "2d-array"}}))]});
    const [first, second] = text.map((code) => device.createShaderModule({code, label: name}));
    const factors = blend && BLENDS[blend].map((factor) => ({ONE: "one", ZERO: "zero", DST_COLOR: "dst", ONE_MINUS_SRC_ALPHA: "one-minus-src-alpha"})[factor]);
    const part = blend && {srcFactor: factors[0], dstFactor: factors[1]};
    const handle = device.createRenderPipeline({
      label: name, layout: device.createPipelineLayout({bindGroupLayouts: [group]}),
      vertex: {module: first}, primitive: {topology: vertex === FULLSCREEN ? "triangle-list" : "triangle-strip"},
      fragment: {module: second, targets: outputs.map((format) => ({
        format: format === "canvas" ? this.format : format,
        blend: blend ? {color: part, alpha: blend === "times" ? {srcFactor: "dst-alpha", dstFactor: "zero"} : part} : undefined}))}});
    const layout = layoutOf(uniforms);
    const buffer = device.createBuffer({size: layout.values.byteLength, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST});
    return {handle, group, textures, layout, buffer};
  }

  draw(program, {targets = [], uniforms = {}, textures = {}, instances = 0, clear = null}) {
    const device = this.device;
    device.queue.writeBuffer(program.buffer, 0, pack(program.layout, uniforms));
    const bind = device.createBindGroup({layout: program.group, entries: [
      {binding: 0, resource: {buffer: program.buffer}},
      ...program.textures.map(([name], k) => ({binding: k + 1, resource: textures[name].view}))]});
    const views = targets.length ? targets.map((each) => {
      const [texture, layer] = Array.isArray(each) ? each : [each, 0];
      return texture.layers ? texture.handle.createView({dimension: "2d", baseArrayLayer: layer, arrayLayerCount: 1}) : texture.view;
    }) : [this.context.getCurrentTexture().createView()];
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({colorAttachments: views.map((view) => ({
      view, loadOp: clear ? "clear" : "load", storeOp: "store", clearValue: clear ?? undefined}))});
    pass.setPipeline(program.handle);
    pass.setBindGroup(0, bind);
    if (instances) pass.draw(4, instances);
    else if (instances === 0) pass.draw(3);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  async read(texture, layer = 0) {
    const {width, height} = texture, isBytes = texture.format === "rgba8unorm", stride = Math.ceil(width * (isBytes ? 4 : 16) / 256) * 256;
    const buffer = this.device.createBuffer({size: stride * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ});
    const encoder = this.device.createCommandEncoder();
    encoder.copyTextureToBuffer({texture: texture.handle, origin: [0, 0, layer]}, {buffer, bytesPerRow: stride}, [width, height, 1]);
    this.device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const Numbers = isBytes ? Uint8Array : Float32Array, from = new Numbers(buffer.getMappedRange()), content = new Numbers(4 * width * height);
    const step = stride / Numbers.BYTES_PER_ELEMENT;
    for (let y = 0; y < height; y++) content.set(from.subarray(y * step, y * step + 4 * width), 4 * width * y);
    buffer.destroy();
    return content;
  }

  onLost(call, complain) {
    this.device.addEventListener("uncapturederror", ({error}) => complain(`the GPU refuses a command: ${error.message}`));
    this.device.lost.then(({message, reason}) => { if (!this.isDisposed) call(`the WebGPU device was lost: ${message || reason}`); });
  }

  get maxTextureSide() {
    return this.device.limits.maxTextureDimension2D;
  }

  dispose() {
    this.isDisposed = true;
    for (const texture of [...this.made]) this.destroy(texture);
  }
}
