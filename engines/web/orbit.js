/** The camera that a mouse, fingers and keys move around a subject; z is up, and azimuth 0 looks along +y. */

const FIELD_OF_VIEW = 35 * Math.PI / 180, ELEVATION = 5 * Math.PI / 180, MARGIN = 1.1, STEEPEST = 1.55;

export const add = (a, b, share = 1) => a.map((value, k) => value + share * b[k]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(...a);

/** Return the box of a take's first frame without strays, in the z-up world [m]. */
export function boundsOf(take) {
  const {positions} = take.still, count = take.manifest.count, low = [], high = [];
  for (const from of [0, 2, 1]) { // x right, y up, z back: the world's y is -z, and its z is y
    const values = positions.slice(from * count, (from + 1) * count).sort(), sign = from === 2 ? -1 : 1;
    const ends = [0.005, 0.995].map((share) => sign * (values[Math.round(share * (count - 1))] ?? sign * (share - 0.5)));
    low.push(Math.min(...ends)), high.push(Math.max(...ends));
  }
  return boxOf(low, high);
}

/** Return a box by its corners [m], with its middle and its diagonal. */
export function boxOf(low, high) {
  const center = low.map((value, k) => 0.5 * (value + high[k]));
  return {low, high, center, extent: Math.max(length(add(high, low, -1)), 1e-3)};
}

/** A camera on a sphere around a target. */
export class Orbit {
  constructor(canvas, moved) {
    Object.assign(this, {canvas, moved, azimuth: 0, elevation: ELEVATION, target: [0, 0, 0], distance: 3, fingers: new Map()});
    canvas.addEventListener("pointerdown", (event) => this.touch(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.fingers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(0.0012 * event.deltaY)); }, {passive: false});
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  /** Look at a box from the front, so that it fills what is free of the page. */
  frame(box, {width, height}) {
    Object.assign(this, {azimuth: 0, elevation: ELEVATION, target: box.center, isFramed: true});
    const up = Math.tan(0.5 * FIELD_OF_VIEW) * height / this.canvas.clientHeight / MARGIN, {right, down, forward} = this.axes();
    let distance = 1e-3;
    for (let corner = 0; corner < 8; corner++) {
      const place = add([0, 1, 2].map((k) => (corner >> k & 1 ? box.high : box.low)[k]), box.center, -1);
      const across = Math.max(Math.abs(dot(place, right)) / (up * width / height), Math.abs(dot(place, down)) / up);
      distance = Math.max(distance, across - dot(place, forward));
    }
    Object.assign(this, {distance, size: box.extent});
    this.moved(false);
  }

  /** Go on from where a camera of a path looks from. */
  adopt({position, worldToCamera}) {
    const forward = worldToCamera.slice(6), distance = Math.max(dot(add(this.target, position, -1), forward), 0.1);
    Object.assign(this, {azimuth: Math.atan2(-forward[0], forward[1]), elevation: Math.asin(Math.max(-1, Math.min(1, -forward[2]))), distance,
      target: add(position, forward, distance)});
  }

  axes() {
    const [s, c, t, u] = [Math.sin(this.azimuth), Math.cos(this.azimuth), Math.sin(this.elevation), Math.cos(this.elevation)];
    const forward = [-s * u, c * u, -t], right = [c, s, 0];
    return {right, down: cross(forward, right), forward};
  }

  /** Return the camera for a picture whose free part, of a page as large as the canvas, has the target in its middle. */
  camera(width, height, free, pose) {
    if (pose) return this.posed(pose, width, height);
    const {right, down, forward} = this.axes(), focal = 0.5 * height / Math.tan(0.5 * FIELD_OF_VIEW);
    const share = [free.width / this.canvas.clientWidth, free.height / this.canvas.clientHeight];
    return {position: add(this.target, forward, -this.distance), worldToCamera: [...right, ...down, ...forward], focal: [focal, focal],
      center: [0.5 * share[0] * width, 0.5 * share[1] * height], width, height};
  }

  /** Return the camera of a stage's path: position, the rows of its rotation, and the vertical field of view [degree]. */
  posed({position, worldToCamera, fov}, width, height) {
    const focal = 0.5 * height / Math.tan(fov * Math.PI / 360);
    return {position, worldToCamera, focal: [focal, focal], center: [0.5 * width, 0.5 * height], width, height};
  }

  touch(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  drag(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before[0], event.clientY - before[1]], others = [...this.fingers].filter(([id]) => id !== event.pointerId);
    if (others.length) {
      const [, [ox, oy]] = others[0], gap = (a, b) => Math.hypot(a - ox, b - oy);
      this.pan(0.5 * x, 0.5 * y);
      this.zoom(gap(...before) / Math.max(gap(event.clientX, event.clientY), 1));
    } else if (event.buttons & 6 || event.shiftKey) this.pan(x, y);
    else this.turn(-0.008 * x, 0.008 * y);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  key(event) {
    const step = 0.1, moves = {ArrowLeft: () => this.turn(step, 0), ArrowRight: () => this.turn(-step, 0), ArrowUp: () => this.turn(0, step),
      ArrowDown: () => this.turn(0, -step), "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1 / 0.9)};
    if (!(event.key in moves)) return;
    event.preventDefault();
    moves[event.key]();
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.max(-STEEPEST, Math.min(STEEPEST, this.elevation + elevation));
    this.byHand();
  }

  pan(x, y) {
    const {right, down} = this.axes(), share = 2 * this.distance * Math.tan(0.5 * FIELD_OF_VIEW) / this.canvas.clientHeight;
    this.target = add(add(this.target, right, -share * x), down, -share * y);
    this.byHand();
  }

  zoom(factor) {
    this.distance = Math.max(0.02 * (this.size ?? 1), Math.min(50 * (this.size ?? 1), this.distance * factor));
    this.byHand();
  }

  byHand() {
    this.isFramed = false;
    this.moved(true);
  }
}
