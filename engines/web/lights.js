/** Lamps, as the JSON of `beam render --lights` lists them, and from where their shadow maps look. World: z up, metres. */

/** A lamp that breaks its contract; the message names it. */
export class LightError extends Error {}

const FAR = 500, ROOM = 1.06, NEAR = 0.02, WIDEST = 60, FACE_ANGLE = 48, LARGEST_KERNEL = 0.25;
const RADIAN = Math.PI / 180;
const KINDS = {directional: 0, point: 1, spot: 2};
const FIELDS = {
  directional: {direction: null, irradiance: null, angular_diameter: 0.53, casts_shadows: true},
  point: {position: null, intensity: null, radius: 0, casts_shadows: true},
  spot: {position: null, direction: null, intensity: null, inner_angle: 20, outer_angle: 30, radius: 0, casts_shadows: true},
};
const RANGES = {angular_diameter: [0, 90], radius: [0, 1e6], inner_angle: [0, 88.95], outer_angle: [0.1, 89]};

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => a.map((value, k) => value - b[k]);
const scaled = (a, gain) => a.map((value) => value * gain);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

function require(condition, contract, got) {
  if (!condition) throw new LightError(`${contract}, got ${String(JSON.stringify(got)).slice(0, 80)}.`);
}

/** Check lamps and fill in what they leave out. */
export function checkedLights(records) {
  const list = records?.lights ?? records;
  require(Array.isArray(list), "lights must be a list", records);
  return list.map((record, k) => {
    const fields = FIELDS[record?.type], light = {...fields, ...record}, name = `lights[${k}]`;
    require(fields, `${name}.type must be one of ${Object.keys(FIELDS).join(", ")}`, record?.type);
    for (const [field, value] of Object.entries(light)) {
      if (field === "type") continue;
      require(field in fields, `${name} must have attributes of ${Object.keys(fields).join(", ")}`, field);
      if (fields[field] === null) {
        require(Array.isArray(value) && value.length === 3 && value.every(Number.isFinite), `${name}.${field} must be three numbers`, value);
      } else if (field in RANGES) {
        require(typeof value === "number", `${name}.${field} must be a number`, value);
        require(value >= RANGES[field][0] && value <= RANGES[field][1], `${name}.${field} must be in [${RANGES[field]}]`, value);
      } else require(typeof value === "boolean", `${name}.${field} must be true or false`, value);
    }
    const power = light.irradiance ?? light.intensity;
    require(power.every((value) => value >= 0), `${name} must have a power of at least 0`, power);
    if (light.direction) {
      require(Math.hypot(...light.direction) > 1e-12, `${name}.direction must have a length`, light.direction);
      light.direction = unit(light.direction);
    }
    if (light.type === "spot") require(light.inner_angle <= light.outer_angle - 0.05, `${name}.inner_angle must be below outer_angle`, light.inner_angle);
    return light;
  });
}

/** Return a lamp's 16 numbers for the shader. */
export function lampNumbers(light, firstMap, mapCount) {
  const size = light.type === "directional" ? Math.sin(light.angular_diameter * RADIAN / 2) : light.radius;
  const cone = light.type === "spot" ? [Math.cos(light.inner_angle * RADIAN), Math.cos(light.outer_angle * RADIAN)] : [1, 0];
  return [...(light.position ?? [0, 0, 0]), KINDS[light.type], ...(light.direction ?? [0, 0, 0]), size,
    ...(light.irradiance ?? light.intensity), 0, ...cone, firstMap, mapCount];
}

/** Return a square view: axes, focal length, where it stands; up is whichever axis is least along it. */
function viewOf(position, axis, halfAngle, size, radius, front) {
  const forward = unit(axis), least = [0, 1, 2].reduce((best, k) => Math.abs(forward[k]) < Math.abs(forward[best]) ? k : best, 0);
  const right = unit(cross(forward, [0, 1, 2].map((k) => k === least ? 1 : 0))), focal = size / 2 / Math.tan(halfAngle);
  return {position, right, down: cross(forward, right), forward, focal: [focal, focal], center: [size / 2, size / 2], width: size, height: size, radius, front};
}

/** Return the view of a distant light's map: a unit vector to the light, and half the angle that its disc takes up [rad]. */
export function distantView(towards, halfAngle, casters, size) {
  const distance = FAR * casters.radius, position = minus(casters.center, scaled(towards, -distance)), radius = distance * Math.tan(halfAngle);
  return viewOf(position, scaled(towards, -1), Math.asin(ROOM / FAR), size, radius, distance - ROOM * casters.radius);
}

/** Return the views of a lamp's maps: none, one, or the six of a cube; `casters` is the sphere around the subject. */
export function shadowViews(light, casters, size) {
  if (!light.casts_shadows) return [];
  if (light.type === "directional") return [distantView(scaled(light.direction, -1), light.angular_diameter * RADIAN / 2, casters, size)];
  const toCasters = minus(casters.center, light.position), distance = Math.hypot(...toCasters), extent = ROOM * casters.radius;
  const cone = light.type === "spot" ? light.outer_angle * RADIAN : Math.PI;
  let axis = toCasters, half = distance > extent ? Math.asin(extent / distance) : Math.PI;
  if (cone < half) [axis, half] = [light.direction, cone];
  if (half <= WIDEST * RADIAN) return [viewOf(light.position, axis, half, size, light.radius, Math.max(distance - extent, NEAR))];
  return [0, 1, 2].flatMap((k) => [1, -1].map((sign) =>
    viewOf(light.position, [0, 1, 2].map((i) => i === k ? sign : 0), FACE_ANGLE * RADIAN, size, light.radius, NEAR)));
}

/** Return a map's 20 numbers for the shader. */
export const mapNumbers = (view, thickness) => [...view.right, view.radius, ...view.down, view.front, ...view.forward, thickness,
  ...view.position, LARGEST_KERNEL * view.width, ...view.focal, ...view.center];

/** Row of numbers that gives the depth of a place in the container's axes (y up, z back) in a view: a x + b y + c z + d. */
export const depthRow = ({position, forward}) => [forward[0], forward[2], -forward[1], -dot(forward, position)];
