/** Lamps that are placed by hand: a handle over the picture and a row of controls each. */
import {element} from "./elements.js";
import {add, dot, length} from "./orbit.js";

const MOST_LAMPS = 16, SPOT_CORE = 0.7, STEP = 0.02;

const toLinear = (v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const toDisplay = (v) => v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055;
const linearOf = (hex) => [1, 3, 5].map((k) => toLinear(parseInt(hex.slice(k, k + 2), 16) / 255));
const hexOf = (rgb) => `#${rgb.map((v) => Math.round(255 * toDisplay(v)).toString(16).padStart(2, "0")).join("")}`;
const rounded = (value) => Number(value.toPrecision(2));

/** Return a new lamp that shines on the subject with an irradiance of about π: the first to its left front, others around. */
export function newLamp(kind, {center, extent}, others = 0) {
  const [s, c] = [Math.sin(1.3 * others), Math.cos(1.3 * others)], isSun = kind === "directional";
  const offset = [-0.35 * c + 0.3 * s, -0.35 * s - 0.3 * c, 0.25].map((share) => share * extent);
  return {kind, position: add(center, offset), target: [...center], color: "#ffffff", power: rounded(Math.PI * (isSun ? 1 : dot(offset, offset))),
    size: isSun ? 0.53 : rounded(0.03 * extent), cone: 60, shadows: true};
}

/** Return the lamp of a light as `beam render --lights` reads it. */
export function fromLight(light, {center, extent}) {
  const isSun = light.type === "directional", given = isSun ? light.irradiance : light.intensity, power = Math.max(...given, 1e-9);
  const place = light.position ?? add(center, light.direction, -0.5 * extent / length(light.direction));
  const reach = Math.max(length(add(center, place, -1)), 0.1 * extent);
  const target = light.direction ? add(place, light.direction, reach / length(light.direction)) : [...center];
  return {kind: light.type, position: [...place], target, color: hexOf(given.map((v) => v / power)), power, cone: light.outer_angle ?? 30,
    core: (light.inner_angle ?? 20) / (light.outer_angle ?? 30), size: (isSun ? light.angular_diameter ?? 0.53 : light.radius ?? 0), shadows: light.casts_shadows ?? true};
}

/** Return a lamp as `beam render --lights` and the core read it. */
export function toLight(lamp) {
  const power = linearOf(lamp.color).map((v) => v * lamp.power), direction = add(lamp.target, lamp.position, -1), casts_shadows = lamp.shadows;
  if (lamp.kind === "directional") return {type: lamp.kind, direction, irradiance: power, angular_diameter: lamp.size, casts_shadows};
  const light = {type: lamp.kind, position: lamp.position, intensity: power, radius: lamp.size, casts_shadows};
  return lamp.kind === "spot" ? {...light, direction, inner_angle: (lamp.core ?? SPOT_CORE) * lamp.cone, outer_angle: lamp.cone} : light;
}

/** The lamps of a page. */
export class Lamps {
  constructor(overlay, changed) {
    Object.assign(this, {overlay, changed, lamps: [], count: 0, list: element("div", {className: "lamps"})});
  }

  place(box) { this.box = box; }
  lights() { return this.lamps.map(({lamp}) => toLight(lamp)); }

  set(lamps) {
    for (const entry of [...this.lamps]) this.remove(entry);
    for (const lamp of lamps) this.insert(lamp);
  }

  add(kind) { if (this.box && this.lamps.length < MOST_LAMPS) this.insert(newLamp(kind, this.box, this.lamps.length)); }

  insert(lamp) {
    const entry = {lamp, number: ++this.count};
    const name = `${lamp.kind[0].toUpperCase()}${lamp.kind.slice(1)} ${entry.number}`;
    entry.ray = this.shape("line", {class: "ray"});
    entry.handles = [["position", name], ...(lamp.kind === "point" ? [] : [["target", `Target of ${name}`]])]
      .map(([field, label]) => this.handle(entry, field, label));
    entry.row = this.controls(entry, name);
    this.list.prepend(entry.row);
    this.lamps.push(entry);
    this.changed();
  }

  remove(entry) {
    this.lamps.splice(this.lamps.indexOf(entry), 1);
    for (const part of [entry.row, entry.ray, ...entry.handles.map(({circle}) => circle)]) part.remove();
    this.changed();
  }

  shape(name, attributes) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    this.overlay.append(made);
    return made;
  }

  /** Make the handle of a place: dragged in the plane of the picture, by wheel or Page keys nearer and farther. */
  handle(entry, field, label) {
    const circle = this.shape("circle", {r: field === "position" ? 11 : 7, class: field, tabindex: 0, role: "slider", "aria-label": label,
      "aria-valuenow": 0, "aria-valuetext": "arrow keys move it, Page Up and Page Down take it nearer and farther"});
    let before = null;
    const move = (x, y, depth = 1) => this.move(entry, field, x, y, depth);
    circle.addEventListener("pointerdown", (event) => { before = [event.clientX, event.clientY]; circle.setPointerCapture(event.pointerId); event.preventDefault(); circle.focus(); });
    circle.addEventListener("pointermove", (event) => {
      if (!before) return;
      move(event.clientX - before[0], event.clientY - before[1]);
      before = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) circle.addEventListener(name, () => { before = null; });
    circle.addEventListener("wheel", (event) => { event.preventDefault(); move(0, 0, Math.exp(0.001 * event.deltaY)); }, {passive: false});
    circle.addEventListener("keydown", (event) => {
      const steps = {ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12], PageUp: [0, 0, 1 - STEP], PageDown: [0, 0, 1 + STEP]};
      if (event.key in steps) { event.preventDefault(); move(...steps[event.key]); }
      if (event.key === "Delete") this.remove(entry);
    });
    return {circle, field};
  }

  move({lamp}, field, x, y, depth) {
    const {camera} = this, [right, down, forward] = [0, 3, 6].map((k) => camera.worldToCamera.slice(k, k + 3));
    const away = add(lamp[field], camera.position, -1), distance = Math.max(dot(away, forward), 1e-3);
    const shift = add(add(right.map((v) => v * x * distance / camera.focal[0]), down, y * distance / camera.focal[1]), away, depth - 1);
    if (field === "position" && lamp.kind === "directional") lamp.target = add(lamp.target, shift, 0);
    lamp[field] = add(lamp[field], shift);
    this.changed();
  }

  /** Put the handles where a camera sees the lamps. */
  show(camera) {
    this.camera = camera;
    const see = (place) => {
      const away = add(place, camera.position, -1), [x, y, z] = [0, 3, 6].map((k) => dot(camera.worldToCamera.slice(k, k + 3), away));
      return z > 1e-3 ? [camera.center[0] + camera.focal[0] * x / z, camera.center[1] + camera.focal[1] * y / z] : null;
    };
    for (const {lamp, handles, ray} of this.lamps) {
      const seen = handles.map(({field}) => see(lamp[field]));
      handles.forEach(({circle}, k) => {
        circle.style.display = seen[k] ? "" : "none";
        if (seen[k]) circle.setAttribute("cx", seen[k][0]), circle.setAttribute("cy", seen[k][1]);
        circle.style.setProperty("--light", lamp.color);
      });
      ray.style.display = seen[0] && seen[1] ? "" : "none";
      if (seen[0] && seen[1]) ["x1", "y1", "x2", "y2"].forEach((name, k) => ray.setAttribute(name, seen.flat()[k]));
    }
  }

  controls(entry, name) {
    const {lamp} = entry, isSun = lamp.kind === "directional";
    const number = (label, field, max, step) => {
      const made = element("input", {type: "number", min: 0, max, step, value: lamp[field], oninput: () => {
        const value = made.valueAsNumber;
        if (value >= (field === "cone" ? 1 : 0) && value <= max) lamp[field] = value, this.changed();
      }});
      return element("label", {}, label, made);
    };
    const color = element("input", {type: "color", value: lamp.color, oninput: () => { lamp.color = color.value; this.changed(); }});
    const shadows = element("input", {type: "checkbox", checked: lamp.shadows, onchange: () => { lamp.shadows = shadows.checked; this.changed(); }});
    return element("fieldset", {}, element("legend", {textContent: name}), element("label", {}, "Colour", color),
      number(isSun ? "Irradiance [W/m²]" : "Intensity [W/sr]", "power", 1e6, "any"), number(isSun ? "Angular size [°]" : "Radius [m]", "size", isSun ? 90 : 100, "any"),
      lamp.kind === "spot" ? number("Cone [°]", "cone", 89, 1) : "", element("label", {}, "Casts shadows", shadows),
      element("button", {className: "word", textContent: "Remove", onclick: () => this.remove(entry)}));
  }
}
