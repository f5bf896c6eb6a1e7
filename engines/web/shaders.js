/**
 * The passes of the renderer, in the dialect of gpu.js.
 *
 * Frames are evaluated into textures of Gaussians (evaluate), drawn back to front as splats (gbuffer), and lit pixel by
 * pixel (deferred). Projection, cut-offs and depth are those of kernels/raster/{project,splat_rows}.py, which derive them.
 * A median depth cannot be blended: it is found by a search over the order of splats (bins, pick, median).
 */

/** Gaussians in a row of the textures that hold them. */
export const ROW = 1024;
/** Most planes that a frame may be a sum of. */
export const TERMS = 512;
/** Most lamps, most shadow maps of all lamps, and most regions of an environment that cast shadows. */
export const LAMPS = 16, MAPS = 24, REGIONS = 32;
/** To find the median, splats are divided into this many bins, the right bin into as many again, and so often. */
export const BINS = 16, SEARCHES = 3;

/** The same for captured colour: coefficients of spherical harmonics. */
export const RADIANCE = Object.fromEntries(Array.from({length: 25}, (_, k) => [`radiance_${k}`, 3 * k]));

/** Components of a Gaussian as the evaluation numbers them. */
export const ORDER = {positions: 0, orientations: 3, turns: 6, scales: 9, opacities: 12, base_color: 13, roughness: 16};
Object.assign(ORDER, {ambient_occlusion: 17, normals: 18});
export const COMPONENTS = 21;

const CELL = `
ivec2 cellOf(int index) {
  return ivec2(index % ${ROW}, index / ${ROW});
}
`;

const EVALUATE = `${CELL}
float component(int c, ivec2 cell) {
  vec4 head = u.heads[c];
  float value = head.x;
  for (int k = int(head.y); k < int(head.y + head.z); k++) {
    vec4 term = u.terms[k];
    ivec2 place = ivec2(cell.x, cell.y + int(term.y));
    int layer = int(term.z);
    if (term.x < 0.5) {
      value += term.w * fetchLayer(still, place, layer, 0).x;
    } else if (term.x < 1.5) {
      value += term.w * fetchLayer(summed, place, layer, 0).x;
    } else {
      value += term.w * float(fetchLayer(plain, place, layer, 0).x);
    }
  }
  return value;
}
vec3 vectorAt(int c, ivec2 cell) {
  return vec3(component(c, cell), component(c + 1, cell), component(c + 2, cell));
}
vec4 quaternionOf(vec3 parameters) {
  float square = dot(parameters, parameters);
  return vec4(2.0 * parameters, 1.0 - square) / (1.0 + square);
}
vec4 turnedBy(vec4 turn, vec4 q) {
  return vec4(turn.w * q.xyz + q.w * turn.xyz + cross(turn.xyz, q.xyz), turn.w * q.w - dot(turn.xyz, q.xyz));
}
vec3 toWorld(vec3 v) {
  return vec3(v.x, -v.z, v.y);
}
`;

const EVALUATION = {
  uniforms: [["heads", COMPONENTS], ["terms", TERMS]],
  textures: [["still", "array"], ["summed", "array"], ["plain", "ints"]],
};

/** Writes centre and opacity, and the orientation; in the world, z up. */
export const geometry = {
  name: "geometry", ...EVALUATION, outputs: Array(2).fill("rgba32float"),
  fragment: `${EVALUATE}
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  out0 = vec4(toWorld(vectorAt(${ORDER.positions}, cell)), clamp(component(${ORDER.opacities}, cell), 0.0, 1.0));
  vec4 q = turnedBy(quaternionOf(vectorAt(${ORDER.turns}, cell)), quaternionOf(vectorAt(${ORDER.orientations}, cell)));
  out1 = turnedBy(vec4(0.70710678, 0.0, 0.0, 0.70710678), q);
}
`,
};

/** Writes standard deviations and roughness, base colour and ambient occlusion. */
export const materials = {
  name: "materials", ...EVALUATION, outputs: Array(2).fill("rgba32float"),
  fragment: `${EVALUATE}
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec3 logarithms = vectorAt(${ORDER.scales}, cell);
  out0 = vec4(exp(min(logarithms, vec3(20.0))) * step(vec3(-29.0), logarithms), clamp(component(${ORDER.roughness}, cell), 0.0, 1.0));
  vec3 color = clamp(vectorAt(${ORDER.base_color}, cell), vec3(0.0), vec3(1.0));
  out1 = vec4(color, clamp(component(${ORDER.ambient_occlusion}, cell), 0.0, 1.0));
}
`,
};

/** Writes the normal. */
export const normals = {
  name: "normals", ...EVALUATION, outputs: ["rgba32float"],
  fragment: `${EVALUATE}
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec3 normal = vectorAt(${ORDER.normals}, cell);
  normal = normal / max(length(normal), 1.0e-12);
  vec4 turn = quaternionOf(vectorAt(${ORDER.turns}, cell));
  vec3 middle = 2.0 * cross(turn.xyz, normal);
  out0 = vec4(toWorld(normal + turn.w * middle + cross(turn.xyz, middle)), 0.0);
}
`,
};

/** Real spherical harmonics of a unit vector x, y, z, of degree 0 to 4. */
const HARMONICS = ["0.28209479177387814", "-0.4886025119029199 * y", "0.4886025119029199 * z", "-0.4886025119029199 * x",
  "1.0925484305920792 * x * y", "-1.0925484305920792 * y * z", "0.31539156525252005 * (2.0 * zz - xx - yy)", "-1.0925484305920792 * x * z",
  "0.5462742152960396 * (xx - yy)", "-0.5900435899266435 * y * (3.0 * xx - yy)", "2.890611442640554 * x * y * z",
  "-0.4570457994644658 * y * (4.0 * zz - xx - yy)", "0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)",
  "-0.4570457994644658 * x * (4.0 * zz - xx - yy)", "1.445305721320277 * z * (xx - yy)", "-0.5900435899266435 * x * (xx - 3.0 * yy)",
  "2.5033429417967046 * x * y * (xx - yy)", "-1.7701307697799304 * y * z * (3.0 * xx - yy)", "0.9461746957575601 * x * y * (7.0 * zz - 1.0)",
  "-0.6690465435572892 * y * z * (7.0 * zz - 3.0)", "0.10578554691520431 * (35.0 * zz * zz - 30.0 * zz + 3.0)",
  "-0.6690465435572892 * x * z * (7.0 * zz - 3.0)", "0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0)",
  "-1.7701307697799304 * x * z * (xx - 3.0 * yy)", "0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))"];

/** Writes the captured colour towards a camera; harmonics are in the container's axes. */
export const captured = {
  name: "captured", uniforms: [["heads", 75], ["terms", TERMS], ["eye"]], textures: [...EVALUATION.textures, ["positions", "float2d"]],
  outputs: ["rgba32float"],
  fragment: `${EVALUATE}
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec3 way = normalize(fetch(positions, cell, 0).xyz - u.eye.xyz);
  float x = way.x;
  float y = way.z;
  float z = -way.y;
  float xx = x * x;
  float yy = y * y;
  float zz = z * z;
  vec3 color = vec3(0.5);
${HARMONICS.map((basis, k) => `  if (int(u.eye.w) > ${k}) {\n    color += (${basis}) * vectorAt(${3 * k}, cell);\n  }`).join("\n")}
  out0 = vec4(max(color, vec3(0.0)), 0.0);
}
`,
};

const LOG_CUT = "5.541263545158426";

/** A Gaussian becomes a parallelogram around the ellipse where its alpha is 1/255; instances come back to front. */
const SPLAT = (materialsToo, arrivingToo = false) => `${CELL}
void vertexMain() {
  position = vec4(2.0, 2.0, 0.0, 1.0);
  v0 = vec4(0.0);
  v1 = vec4(0.0);
  v2 = vec4(0.0);
  ${materialsToo ? "v3 = vec4(0.0);\n  v4 = vec4(0.0);" : ""}
  ${arrivingToo ? "v5 = vec4(0.0);" : ""}
  int rank = int(u.image.w) - 1 - instanceIndex;
  int index = int(fetch(order, cellOf(rank), 0).x);
  ivec2 cell = cellOf(index);
  vec4 place = fetch(positions, cell, 0);
  vec4 q = fetch(orientations, cell, 0);
  vec4 sizes = fetch(scales, cell, 0);
  vec3 s = sizes.xyz;
  vec3 away = place.xyz - u.eye.xyz;
  vec3 p = vec3(dot(u.right.xyz, away), dot(u.down.xyz, away), dot(u.forward.xyz, away));
  float z = p.z;
  if (!(z > u.filters.y) || !(dot(q, q) > 0.0)) {
    return;
  }
  vec2 focal = u.lens.xy;
  vec2 center = u.lens.zw;
  vec2 tangent = p.xy / z;
  vec2 margin = 0.15 * u.image.xy / focal;
  vec2 j = clamp(tangent, -center / focal - margin, (u.image.xy - center) / focal + margin);
  q = normalize(q);
  vec3 columnX = vec3(1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z), 2.0 * (q.x * q.z - q.w * q.y));
  vec3 columnY = vec3(2.0 * (q.x * q.y - q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + q.w * q.x));
  vec3 columnZ = vec3(2.0 * (q.x * q.z + q.w * q.y), 2.0 * (q.y * q.z - q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y));
  vec3 right = vec3(dot(u.right.xyz, columnX), dot(u.right.xyz, columnY), dot(u.right.xyz, columnZ));
  vec3 down = vec3(dot(u.down.xyz, columnX), dot(u.down.xyz, columnY), dot(u.down.xyz, columnZ));
  vec3 forward = vec3(dot(u.forward.xyz, columnX), dot(u.forward.xyz, columnY), dot(u.forward.xyz, columnZ));
  vec3 t0 = (focal.x / z) * (right * s - j.x * forward * s);
  vec3 t1 = (focal.y / z) * (down * s - j.y * forward * s);
  float sharpXx = dot(t0, t0);
  float xy = dot(t0, t1);
  float sharpYy = dot(t1, t1);
  vec3 crossed = cross(t0, t1);
  float sharpDet = dot(crossed, crossed);
  float lowPass = u.filters.x;
  float det = sharpDet + lowPass * (sharpXx + sharpYy) + lowPass * lowPass;
  float xx = sharpXx + lowPass;
  float kept = 1.0;
  if (u.filters.z > 0.5) {
    kept = sharpDet / det;
  }
  float opacity = place.w;
  if (!(opacity * opacity * kept > 1.5378700499807768e-5) || !(det > 0.0)) {
    return;
  }
  float logOpacity = log(opacity) + 0.5 * log(kept);
  vec3 thick = max(s, vec3(1.0e-12));
  vec3 inverse = min(thick.x, min(thick.y, thick.z)) / thick;
  vec3 a = inverse * (right * tangent.x + down * tangent.y + forward);
  vec3 b0 = inverse * right / focal.x;
  vec3 b1 = inverse * down / focal.y;
  float aa = dot(a, a);
  vec2 middle = focal * tangent + center;
  v0 = vec4(middle, logOpacity, z);
  v1 = vec4(inversesqrt(xx), xy / xx, sqrt(xx / det), 3.0 * max(s.x, max(s.y, s.z)));
  v2 = vec4(dot(a, b0) / aa, dot(a, b1) / aa, float(rank), sizes.w);
  ${materialsToo ? "v3 = fetch(colors, cell, 0);\n  v4 = fetch(normals, cell, 0);" : ""}
  ${arrivingToo ? "v5 = fetch(arriving, cell, 0);" : ""}
  float reach = sqrt(2.0 * (${LOG_CUT} + logOpacity)) * 1.0001 + 1.0e-3;
  vec2 e = reach * vec2(float(vertexIndex % 2) * 2.0 - 1.0, float(vertexIndex / 2) * 2.0 - 1.0);
  float dx = e.x / v1.x;
  vec2 corner = middle + vec2(dx, e.y / v1.z + v1.y * dx);
  position = vec4(2.0 * corner / u.image.xy - 1.0, 0.0, 1.0);
}
`;

/** Alpha of a splat at the pixel, 0 below the cut; its depth there: that of the tangent plane of its largest response. */
const SEEN = `
float alphaHere() {
  vec2 offset = pixel - v0.xy;
  vec2 e = vec2(offset.x * v1.x, (offset.y - v1.y * offset.x) * v1.z);
  float logAlpha = v0.z - 0.5 * dot(e, e);
  float alpha = 0.0;
  if (logAlpha >= -${LOG_CUT}) {
    alpha = min(exp(logAlpha), 0.99);
  }
  return alpha;
}
float depthHere() {
  float facing = 1.0 + dot(v2.xy, pixel - v0.xy);
  float far = v0.w + v1.w;
  float depth = far;
  if (facing > 0.0) {
    depth = min(v0.w / facing, far);
  }
  return max(depth, max(v0.w - v1.w, u.filters.y));
}
`;

const VIEW = ["right", "down", "forward", "eye", "lens", "image", "filters"].map((name) => [name]);
const CLOUD = ["order", "positions", "orientations", "scales"].map((name) => [name, "float2d"]);

/**
 * Sums of materials and depth: colour; normal; roughness, occlusion, depth; alpha in each. With what arrives of the
 * environment: that too, and its share instead of occlusion.
 */
export const gbuffer = (format, arriving = false) => ({
  name: "gbuffer", uniforms: VIEW, textures: [...CLOUD, ...["colors", "normals", ...(arriving ? ["arriving"] : [])].map((name) => [name, "float2d"])],
  varyings: arriving ? 6 : 5, outputs: Array(arriving ? 4 : 3).fill(format), blend: "over", vertex: SPLAT(true, arriving),
  fragment: `${SEEN}
void fragmentMain() {
  float alpha = alphaHere();
  if (alpha <= 0.0) {
    discard;
  }
  out0 = vec4(v3.xyz * alpha, alpha);
  out1 = vec4(v4.xyz * alpha, alpha);
  out2 = vec4(vec3(v2.w, ${arriving ? "v5" : "v3"}.w, depthHere()) * alpha, alpha);
  ${arriving ? "out3 = vec4(v5.xyz * alpha, alpha);" : ""}
}
`,
});

/** Sums of depth and alpha alone, for shadow maps. */
export const depths = (format) => ({
  name: "depths", uniforms: VIEW, textures: CLOUD, varyings: 3, outputs: [format], blend: "over", vertex: SPLAT(false),
  fragment: `${SEEN}
void fragmentMain() {
  float alpha = alphaHere();
  if (alpha <= 0.0) {
    discard;
  }
  out0 = vec4(0.0, 0.0, depthHere() * alpha, alpha);
}
`,
});

const RANK = `
int rankHere() {
  return int(v2.z + 0.5);
}
vec4 through(int bin, int first, float share) {
  vec4 found = vec4(1.0);
  for (int k = 0; k < 4; k++) {
    if (first + k == bin) {
      found[k] = share;
    }
  }
  return found;
}
`;

/** Whether a splat is in the range of ranks that was picked for this pixel; sizes are those of the range and of its bins. */
const PICKED = `
int localRank(float start) {
  int local = rankHere() - int(start);
  if (start < 0.0 || local >= int(u.sizes.x)) {
    return -1;
  }
  return local;
}
`;

/** What passes each bin of a range of splats, a product that needs no order; the first range is all of them. */
export const bins = (first) => ({
  name: first ? "bins" : "fine bins", uniforms: [...VIEW, ["sizes"]], textures: [...CLOUD, ...(first ? [] : [["picked", "float2d"]])],
  varyings: 3, outputs: Array(4).fill("rgba16float"), blend: "times", vertex: SPLAT(false),
  fragment: `${SEEN}${RANK}${PICKED}
void fragmentMain() {
  float alpha = alphaHere();
  int local = localRank(${first ? "0.0" : "fetch(picked, ivec2(pixel), 0).x"});
  if (alpha <= 0.0 || local < 0) {
    discard;
  }
  int bin = local / int(u.sizes.y);
  out0 = through(bin, 0, 1.0 - alpha);
  out1 = through(bin, 4, 1.0 - alpha);
  out2 = through(bin, 8, 1.0 - alpha);
  out3 = through(bin, 12, 1.0 - alpha);
}
`,
});

/** The last bin with something in it before which more than half of the light passes: its first rank, what passes before. */
export const pick = (first) => ({
  name: "pick", uniforms: [["sizes"]], textures: [["passing", "array"], ...(first ? [] : [["picked", "float2d"]])], outputs: ["rgba32float"],
  fragment: `
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec4 range = ${first ? "vec4(0.0, 1.0, 0.0, 0.0)" : "fetch(picked, cell, 0)"};
  float passes = range.y;
  vec4 found = vec4(-1.0, passes, 0.0, 0.0);
  for (int bin = 0; bin < ${BINS}; bin++) {
    vec4 shares = fetchLayer(passing, cell, bin / 4, 0);
    float share = shares[bin % 4];
    if (passes > 0.5 && share < 1.0) {
      found = vec4(range.x + float(bin) * u.sizes.y, passes, 0.0, 0.0);
    }
    passes = passes * share;
  }
  out0 = found;
}
`,
});

/** Depth of the picked bin's splats, which are few: sums weighted by alpha. */
export const median = (format) => ({
  name: "median", uniforms: [...VIEW, ["sizes"]], textures: [...CLOUD, ["picked", "float2d"]], varyings: 3, outputs: [format],
  blend: "plus", vertex: SPLAT(false),
  fragment: `${SEEN}${RANK}${PICKED}
void fragmentMain() {
  float alpha = alphaHere();
  if (alpha <= 0.0 || localRank(fetch(picked, ivec2(pixel), 0).x) < 0) {
    discard;
  }
  out0 = vec4(depthHere() * alpha, alpha, 0.0, 0.0);
}
`,
});

/** A shadow map's texel: alpha, median depth, mean depth, depth of meshes. */
export const texels = {
  name: "texels", uniforms: [["meshes"]], textures: [["sums", "float2d"], ["medians", "float2d"], ["behindOf", "float2d"]], outputs: ["rgba32float"],
  fragment: `
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec4 seen = fetch(sums, cell, 0);
  vec4 middle = fetch(medians, cell, 0);
  float behind = fetch(behindOf, min(cell, ivec2(int(u.meshes.x) - 1)), 0).x;
  if (!(behind > 0.0)) {
    behind = 3.0e38;
  }
  out0 = vec4(min(seen.w, 1.0), middle.x / max(middle.y, 1.0e-12), seen.z / max(seen.w, 1.0e-12), behind);
}
`,
};

/** What the functions of engines/shading fetch. */
const HOOKS = `
ShadowView shadowView(int map) {
  ShadowView view;
  vec4 a = u.maps[map * 5];
  vec4 b = u.maps[map * 5 + 1];
  vec4 c = u.maps[map * 5 + 2];
  vec4 d = u.maps[map * 5 + 3];
  vec4 e = u.maps[map * 5 + 4];
  view.right = a.xyz;
  view.down = b.xyz;
  view.forward = c.xyz;
  view.position = d.xyz;
  view.focal = e.xy;
  view.center = e.zw;
  view.size = 2.0 * e.zw;
  view.radius = a.w;
  view.front = b.w;
  view.thickness = c.w;
  view.largestKernel = d.w;
  return view;
}
vec4 shadowTexel(int map, ivec2 cell) {
  return fetchLayer(shadows, cell, map, 0);
}
int environmentRows(int level) {
  return int(u.levels[level + 1].x);
}
vec3 environmentTexel(int level, ivec2 cell) {
  return fetch(environment, ivec2(cell.x, cell.y + int(u.levels[level + 1].y)), 0).xyz;
}
vec2 albedoTexel(ivec2 cell) {
  return fetch(albedo, cell, 0).xy;
}
`;

const NO_REGIONS = `
int regionCount() {
  return 0;
}
Region regionAt(int k) {
  Region region;
  region.map = k;
  return region;
}
`;

/** What arrives of the environment at each Gaussian, shadows of its regions taken into account, and its share. */
export const arrive = (shading) => ({
  name: "arrive",
  uniforms: [["turn"], ["counts"], ["levels", 14], ["regions", 3 * REGIONS], ["maps", 5 * REGIONS]],
  textures: [["positions", "float2d"], ["colors", "float2d"], ["normals", "float2d"], ["environment", "float2d"], ["albedo", "float2d"],
    ["shadows", "array"]],
  outputs: ["rgba32float"], shading,
  fragment: `#shading
${HOOKS}
int regionCount() {
  return int(u.counts.x);
}
Region regionAt(int k) {
  Region region;
  region.red = u.regions[3 * k];
  region.green = u.regions[3 * k + 1];
  region.blue = u.regions[3 * k + 2];
  region.map = k;
  return region;
}
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec4 place = fetch(positions, cell, 0);
  vec4 look = fetch(colors, cell, 0);
  vec4 normal = fetch(normals, cell, 0);
  out0 = arrivingLight(place.xyz, normal.xyz, look.w, randomTurn(uint(cell.y * ${ROW} + cell.x)), u.turn.xy);
}
`,
});

const CAMERA = [["right"], ["down"], ["forward"], ["eye"], ["lens"], ["image"]];

/** Radiance multiplied by alpha, and alpha; the texture has the rows of the image, top first. */
export const deferred = (shading) => ({
  name: "deferred",
  uniforms: [...CAMERA, ["turn"], ["counts"], ["levels", 14], ["lamps", 4 * LAMPS], ["maps", 5 * MAPS]],
  textures: [...["sums0", "sums1", "sums2", "sums3", "medians", "environment", "albedo"].map((name) => [name, "float2d"]), ["shadows", "array"]],
  outputs: ["rgba32float"], shading,
  fragment: `#shading
${HOOKS}${NO_REGIONS}
Lamp lampAt(int k) {
  Lamp lamp;
  vec4 a = u.lamps[4 * k];
  vec4 b = u.lamps[4 * k + 1];
  vec4 c = u.lamps[4 * k + 2];
  vec4 d = u.lamps[4 * k + 3];
  lamp.position = a.xyz;
  lamp.direction = b.xyz;
  lamp.power = c.xyz;
  lamp.cone = d.xy;
  lamp.size = b.w;
  lamp.kind = int(a.w);
  lamp.firstMap = int(d.z);
  lamp.mapCount = int(d.w);
  return lamp;
}
void fragmentMain() {
  ivec2 cell = ivec2(pixel);
  vec4 color = fetch(sums0, cell, 0);
  vec4 rest = fetch(sums2, cell, 0);
  vec3 normal = fetch(sums1, cell, 0).xyz;
  float alpha = color.w;
  out0 = vec4(0.0);
  if (alpha > 0.0) {
    vec3 ray = pixelRay(pixel, u.lens.xy, u.lens.zw, u.right.xyz, u.down.xyz, u.forward.xyz);
    float depth = rest.z / alpha;
    if (u.counts.x > 0.5) {
      vec4 middle = fetch(medians, cell, 0);
      depth = min(depth, middle.x / max(middle.y, 1.0e-12));
    }
    Surface surface = surfaceOfSums(color.xyz, rest.x, rest.y, normal, alpha, u.eye.xyz, ray, depth);
    vec3 radiance = vec3(0.0);
    if (u.counts.z > 0.5) {
      radiance = shadowedRadiance(surface, fetch(sums3, cell, 0).xyz / alpha, u.turn.xy) * u.turn.z;
    } else {
      radiance = environmentRadiance(surface, u.turn.xy) * u.turn.z;
    }
    vec2 turn = randomTurn(uint(cell.y) * uint(u.image.x) + uint(cell.x));
    for (int k = 0; k < int(u.counts.x); k++) {
      radiance += lampRadiance(surface, lampAt(k), turn);
    }
    float coverage = min(alpha, 1.0);
    out0 = vec4(radiance * coverage, coverage);
  }
  if (u.counts.y > 0.5) {
    vec3 ray = pixelRay(pixel, u.lens.xy, u.lens.zw, u.right.xyz, u.down.xyz, u.forward.xyz);
    out0 = vec4(out0.xyz + (1.0 - out0.w) * u.turn.z * levelRadiance(0, unturned(normalize(ray), u.turn.xy)), 1.0);
  }
}
`,
});

/** Names of what can be shown, in the order of their numbers. */
export const CHANNELS = ["relit", "base_color", "roughness", "ambient_occlusion", "normals", "depth", "alpha", "radiance"];

/** The picture on the canvas: exposure, view transform, background; or a channel of the G-buffer. */
export const display = (shading, flip) => ({
  name: "display",
  uniforms: [["image"], ["tone"], ["background"], ["range"]],
  textures: [["lit", "float2d"], ["sums0", "float2d"], ["sums1", "float2d"], ["sums2", "float2d"]], shading,
  fragment: `#shading
vec3 channelColor(int channel, ivec2 cell, float alpha) {
  vec4 rest = fetch(sums2, cell, 0);
  vec3 normal = fetch(sums1, cell, 0).xyz;
  vec3 color = linearToSrgb(clamp(fetch(sums0, cell, 0).xyz / alpha, vec3(0.0), vec3(1.0)));
  if (channel == 2) {
    color = vec3(rest.x / alpha);
  }
  if (channel == 3) {
    color = vec3(rest.y / alpha);
  }
  if (channel == 4) {
    color = 0.5 + 0.5 * normal / max(length(normal), 1.0e-12);
  }
  if (channel == 5) {
    color = vec3(clamp((u.range.y - rest.z / alpha) / max(u.range.y - u.range.x, 1.0e-6), 0.0, 1.0));
  }
  if (channel == 6) {
    color = vec3(1.0);
  }
  if (channel == 7 && u.tone.w > 0.5) {
    color = clamp(fetch(sums0, cell, 0).xyz / alpha, vec3(0.0), vec3(1.0));
  }
  return color;
}
void fragmentMain() {
  vec2 place = pixel - u.image.zw;
  ${flip ? "place.y = u.image.y - place.y;" : ""}
  ivec2 cell = ivec2(place);
  vec4 shown = fetch(lit, cell, 0);
  int channel = int(u.tone.z);
  int mode = int(u.background.w);
  float alpha = shown.w;
  vec3 color = vec3(0.0);
  if (channel > 0) {
    if (alpha > 0.0) {
      color = channelColor(channel, cell, alpha);
    }
    float floorOf = 0.0;
    if (mode > 0) {
      floorOf = 1.0;
    }
    out0 = vec4(color * alpha + u.background.xyz * ((1.0 - alpha) * floorOf), max(alpha, floorOf));
  } else {
    if (alpha > 0.0) {
      color = displayLinear(shown.xyz / alpha, u.tone.x, int(u.tone.y));
    }
    if (mode == 1) {
      vec3 behind = pow((u.background.xyz + 0.055) / 1.055, vec3(2.4));
      behind = mix(behind, u.background.xyz / 12.92, step(u.background.xyz, vec3(0.04045)));
      out0 = vec4(linearToSrgb(alpha * color + (1.0 - alpha) * behind), 1.0);
    } else {
      out0 = vec4(linearToSrgb(color) * alpha, alpha);
    }
  }
}
`,
});
