/**
 * The player page: orbit, time, light, lamps that are dragged, channels, pictures, VR. It draws by the core, `relight.js`.
 * `beam-convert ASSET page.html --player` writes a page with this module, its styles, environments and a take.
 */
import {Take} from "./b4d.js";
import {download, element} from "./elements.js";
import {Environment} from "./environment.js";
import {Lamps, fromLight} from "./lamps.js";
import {Orbit, boundsOf, boxOf} from "./orbit.js";
import {Relight} from "./relight.js";
import {enterVr, hasVr} from "./vr.js";

const CHANNELS = {relit: "lit", base_color: "base colour", roughness: "roughness", ambient_occlusion: "ambient occlusion",
  normals: "normals", depth: "depth", alpha: "alpha", radiance: "captured colour"};
const SHADOW_REGIONS = {0: "by occlusion", 8: "by 8 maps", 16: "by 16 maps", 32: "by 32 maps"};
const TRANSFORMS = ["standard", "aces", "agx", "neutral"];
const NONE = "none", SCALES = [1, 0.75, 0.5, 0.35, 0.25], SHADOWS = [1024, 1024, 512, 256, 256], SLOW = 80, FAST = 24, STILL = 200;
const ASK_FOR_FILE = "Choose the .b4d file here, or serve the folder: python3 -m http.server";

/** Return the function that reads ranges of a take that a page holds as base64. */
function rangesOfText(text) {
  return async (name, start, size) => {
    const first = Math.floor(start / 3), bytes = bytesOf(text.slice(4 * first, 4 * Math.ceil((start + size) / 3)));
    return bytes.subarray(start - 3 * first, start - 3 * first + size);
  };
}

/** Return the bytes of base64, by a loop: `Uint8Array.from` would take 0.2 s for a segment. */
function bytesOf(base64) {
  const packed = atob(base64), bytes = new Uint8Array(packed.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = packed.charCodeAt(i);
  return bytes;
}

/**
 * Start the player in an element; `settings` is what `converters/player.py` writes. A page of `beam view` hands over the modules
 * `live.js` and `stills.js`, which other pages need not hold.
 */
export async function start(root, settings, {live, stills} = {}) {
  const player = new Player(root, settings, {live, stills});
  globalThis.player = player;
  await player.begin();
  return player;
}

/** A page's state, its controls, and the loop that draws. */
export class Player {
  constructor(root, settings, {live, stills} = {}) {
    const {view = {}} = settings;
    Object.assign(this, {root, settings, shadows: SHADOWS, scale: 0, lastMove: 0, environments: new Map()});
    this.state = {playing: false, time: 0, rate: 1, loop: true, channel: "relit", environment: null, environmentShadows: 0, rotation: 0,
      exposure: 0, behind: false, transform: "standard", background: "#212121", path: Boolean(view.cameras), ...view.state};
    this.canvas = element("canvas", {tabIndex: 0, ariaLabel: "The take. Drag or use the arrow keys to orbit."});
    this.overlay = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    this.overlay.classList.add("handles");
    this.message = element("div", {className: "message", role: "alert", hidden: true});
    this.status = element("p", {className: "status"});
    this.orbit = new Orbit(this.canvas, (isByHand) => this.moved(isByHand));
    this.lamps = new Lamps(this.overlay, () => this.lightsChanged());
    this.stills = settings.stills ? new stills.Stills(this, settings.stills) : null;
    this.openTake = live?.openLive ?? Take.open;
    root.replaceChildren(this.canvas, this.stills?.image ?? "", this.overlay, this.header(), this.panel(), this.transport(), this.message);
    this.bindPage();
  }

  async begin() {
    const name = this.state.environment ?? Object.keys(this.offered())[0];
    this.light(name).catch(() => {}); // blurred meanwhile; whoever chooses it says what is wrong
    try {
      await this.makeCore();
    } catch (error) {
      return this.say(`This page needs WebGPU or WebGL 2, and this browser offers neither (${error.message}).`, true);
    }
    const light = this.choose(name);
    await this.open(this.source());
    await light;
    this.isLit = true;
    this.busy(false);
    this.wake();
    this.vrButton.hidden = !(await hasVr());
  }

  async makeCore(backend = this.settings.backend) {
    this.relight = await Relight.create(this.canvas, backend ? {backend} : {});
    this.relight.environment = await Environment.constant([0.5, 0.5, 0.5]); // until the first one has been blurred
    const on = (name, act) => this.relight.addEventListener(name, ({detail}) => act(detail));
    on("lost", ({message}) => this.say(`The graphics device was lost, and the picture stands still (${message}).`, true, "Start again",
      () => location.reload()));
    on("restored", () => { this.hush(); this.wake(); });
    on("stalled", ({segment, message}) => this.stall(this.take?.manifest.segments[segment], message));
    on("resumed", () => { this.hush(); this.wake(); });
    on("sorted", () => this.wake());
    on("error", ({message}) => this.say(message));
  }

  /** Return how the page's own take is read. */
  source() {
    const {url, element: id} = this.settings.take;
    return id ? {url: "take.b4d", read: rangesOfText(document.getElementById(id).textContent)} : {...this.settings.take, url: new URL(url, location).href};
  }

  /** Open a file that was chosen, or what `source` returns. */
  async open(source, name) {
    this.busy(true);
    try {
      const take = await (source instanceof Blob ? Take.from(source) : this.openTake(source.url, source.read));
      await this.relight.open(take);
      this.take = take;
      this.settled = null;
      this.parts = source.frames ? source : null;
      this.part = 0;
      if (this.stillGroup) this.stillGroup.hidden = Boolean(name);
      if (name) document.title = this.title.textContent = name;
      const box = name ? null : this.settings.view?.box;  // of a stage's assets, without its ground
      this.box = box ? boxOf(...box) : boundsOf(take);
      this.relight.casters = box ? {center: this.box.center, radius: 0.5 * this.box.extent} : null;
      this.lamps.place(this.box);
      if (!name) this.lamps.set((this.settings.view?.lights ?? []).map((light) => fromLight(light, this.box)));
      this.orbit.frame(this.box, this.free());
      this.fitControls();
      this.hush();
      this.change({time: 0, playing: this.state.playing || (this.frames > 1 && !matchMedia("(prefers-reduced-motion: reduce)").matches)});
    } catch (error) {
      const isFile = location.protocol === "file:" && source.url && !source.read;
      const why = isFile ? "this page was opened from a file, and browsers do not let such pages read others" : error.message;
      this.say(`The take cannot be shown: ${why.replace(/\.$/, "")}.${isFile ? ` ${ASK_FOR_FILE}` : ""}`, true, "Open a file",
        () => this.picker.click());
    }
    this.busy(!this.isLit);
  }

  get isReady() { return Boolean(this.take && this.isLit); }
  get frames() { return (this.parts ?? this.take?.manifest)?.frames ?? 1; }
  get frameRate() { return (this.parts ?? this.take?.manifest)?.rate || 30; }
  get length() { return this.frames / this.frameRate; }
  get shownTime() { return Math.min(this.state.time, (this.frames - 1) / this.frameRate); }
  get frame() { return Math.min(this.frames - 1, Math.floor(this.state.time * this.frameRate + 1e-6)); }

  /** Change the state; controls and picture follow. */
  change(values) {
    Object.assign(this.state, values);
    this.stills?.drop();
    const {state, relight} = this;
    for (const [name, show] of Object.entries(this.shown)) if (name in values) show(state[name]);
    if ("time" in values || "playing" in values) this.showTime();
    if ("background" in values) this.root.style.setProperty("--behind", state.background);
    if (relight) Object.assign(relight, {rotation: this.rotation, exposure: state.exposure, viewTransform: state.transform,
      environmentShadows: state.environmentShadows, channel: state.channel, background: state.behind ? "environment" : null});
    this.wake();
  }

  /** Rotation of the environment now: a stage may turn it over time. */
  get rotation() { return this.state.rotation + (this.settings.view?.degreesPerSecond ?? 0) * this.state.time; }

  offered() { return {...Object.fromEntries((this.settings.environments ?? []).map((each) => [each.name, each])),
    ...Object.fromEntries(this.environments), [NONE]: null}; }

  /** Return an environment; it is made ready when it is first asked for. */
  async light(name) {
    const given = this.offered()[name];
    if (!given) return Environment.constant([0, 0, 0]);
    if (!(given.hdr || given.url)) return given;
    const made = Environment.load(given.url ?? bytesOf(given.hdr));
    this.environments.set(name, made);
    made.catch(() => this.environments.delete(name));
    return made;
  }

  /** Take another environment. */
  async choose(name) {
    this.wanted = name;
    this.busy(true);
    try {
      const light = await this.light(name);
      if (this.wanted !== name) return;
      this.relight.environment = light;
      this.change({environment: name});
    } catch (error) {
      this.say(`The environment ${name} cannot be shown: ${error.message}`);
    }
    this.busy(!this.isLit);
  }

  lightsChanged() {
    if (this.relight) this.relight.lights = this.lamps.lights();
    this.moved();
  }

  moved(isByHand = false) {
    this.lastMove = now();
    this.stills?.drop();
    if (this.state.path && isByHand) {
      this.orbit.adopt(this.settings.view.cameras[this.frame]);
      this.change({path: false});
    }
    this.wake();
  }

  wake(isChanged = true) {
    this.isChanged ||= isChanged;
    this.pending ??= requestAnimationFrame((now) => { this.pending = null; this.tick(now); });
  }

  /** Draw if anything changed: coarse where the device is slow and something moves, then finer, then in full. */
  async tick(now) {
    if (!this.take || this.vr || this.isDrawing) return;
    const passed = Math.min((now - (this.lastTick ?? now)) / 1000, 1), rest = this.state.playing ? 0 : now - this.lastMove;
    if (this.state.playing) this.advance(passed);
    const step = rest < STILL ? this.scale : rest < 5 * STILL ? Math.max(this.scale - 2, 0) : 0, isDue = this.isChanged || this.state.playing;
    [this.lastTick, this.isChanged] = [rest < STILL ? now : null, false];
    if (isDue || step !== this.drawn) {
      const milliseconds = await this.timed(SCALES[step], this.shadows[step]);
      if (step === this.scale && isDue) this.adapt(milliseconds);
      this.drawn = step;
      this.tell(milliseconds);
    }
    if (rest < STILL || step || this.isChanged) this.wake(false);
  }

  /** Draw, and return how long the device took [ms]; no other picture is begun meanwhile. */
  async timed(scale, shadows) {
    this.isDrawing = true;
    try {
      this.draw(scale, shadows);
      return await finished(this.relight.gpu);
    } catch (error) {
      this.say(`This cannot be drawn: ${error.message}`);
      return 0;
    } finally {
      this.isDrawing = false;
    }
  }

  advance(seconds) {
    let time = this.state.time + seconds * this.state.rate;
    if (time >= this.length && !this.state.loop) return this.change({time: this.length - 1 / this.frameRate, playing: false});
    this.state.time = time % this.length;
    this.showTime();
  }

  /** Lower the resolution where pictures are late, and raise it where they are early. */
  adapt(milliseconds) {
    this.pace = 0.7 * (this.pace ?? milliseconds) + 0.3 * milliseconds;
    const step = this.pace > SLOW ? 1 : this.pace < FAST ? -1 : 0, scale = Math.max(0, Math.min(SCALES.length - 1, this.scale + step));
    if (scale !== this.scale && now() - (this.lastStep ?? 0) > 500) [this.scale, this.lastStep, this.pace] = [scale, now(), null];
  }

  draw(scale = 1, shadows = this.shadows[0]) {
    const size = scale * Math.min(devicePixelRatio || 1, 2), width = Math.round(this.root.clientWidth * size);
    const height = Math.round(this.root.clientHeight * size);
    if (!width || !height) return;
    Object.assign(this.relight, {time: this.parts ? 0 : this.shownTime, shadowMapSize: shadows});
    if (this.settings.view?.degreesPerSecond) this.relight.rotation = this.rotation;
    const camera = this.camera(width, height);
    if (this.parts) this.follow(camera);
    this.relight.draw(camera);
    this.lamps.show(this.camera(this.root.clientWidth, this.root.clientHeight));
    this.settle();
  }

  /** Return the camera of now: the path's, or the one that is moved by hand. */
  camera(width, height) {
    return this.orbit.camera(width, height, this.free(), this.state.path && this.settings.view.cameras[this.frame]);
  }

  /** Go to the take of the moment, where every frame is a take; the last one is held until then. */
  async follow(camera) {
    const {frame, parts} = this;
    if (this.isFollowing || this.part === frame) return;
    this.isFollowing = true;
    try {
      const take = await this.openTake(parts.url.replace(/0(?=\.b4d$)/, frame));
      if (this.parts !== parts) return;
      await this.relight.open(take);
      this.take = take;
      await this.relight.render(camera);
    } catch (error) {
      this.stall({first: frame, frames: 1}, error.message);
    } finally {
      [this.isFollowing, this.part] = [false, frame];
      this.wake();
    }
  }

  /** Draw again once the segment of the moment is here. */
  async settle() {
    const key = this.relight.time;
    if (this.settled === key) return;
    this.settled = key;
    await this.relight.ready();
    if (this.settled === key) this.wake();
  }

  /** Return the part of the page that no panel covers, from its left upper corner. */
  free() {
    const {clientWidth: width} = this.root, panel = this.side.getBoundingClientRect(), {top: height} = this.bar.getBoundingClientRect();
    if (this.side.hidden) return {width, height};
    return panel.width < 0.8 * width ? {width: panel.left, height} : {width, height: panel.top};
  }

  stall({first, frames}, message) {
    const which = frames > 1 ? `Frames ${first + 1} to ${first + frames}` : `Frame ${first + 1}`;
    this.say(`${which} cannot be read; the last frame is held (${message.replace(/\.$/, "")}).`);
  }

  say(text, isFatal = false, word = "", act = null) {
    const close = element("button", {textContent: word || "Close", onclick: () => { this.hush(); act?.(); }});
    this.message.replaceChildren(element("p", {textContent: text}), ...(isFatal && !word ? [] : [close]));
    this.message.classList.toggle("fatal", isFatal);
    this.message.hidden = false;
  }

  hush() { this.message.hidden = true; }
  busy(is) { this.root.classList.toggle("busy", is); }

  tell(milliseconds) {
    const words = [`${this.take.manifest.count.toLocaleString("en")} Gaussians`, this.relight.backend === "webgpu" ? "WebGPU" : "WebGL 2"];
    if (this.state.playing) words.push(`${milliseconds < 10 ? milliseconds.toFixed(1) : Math.round(milliseconds)} ms`);
    if (!this.state.playing || now() - (this.lastWords ?? 0) > 500) [this.status.textContent, this.lastWords] = [words.join(" · "), now()];
  }

  // the page

  header() {
    this.title = element("h1", {textContent: this.settings.title ?? "beam"});
    return element("header", {}, this.title, this.status);
  }

  transport() {
    this.playButton = element("button", {className: "play", ariaLabel: "Play", onclick: () => this.change({playing: !this.state.playing})});
    this.clock = element("output", {className: "clock"});
    this.slider = element("input", {type: "range", min: 0, step: 1, ariaLabel: "Frame",
      oninput: () => this.change({time: this.slider.value / this.frameRate})});
    const rate = element("select", {ariaLabel: "Rate", onchange: () => this.change({rate: Number(rate.value)})},
      ...[0.1, 0.25, 0.5, 1, 2].map((value) => element("option", {value, textContent: `${value}×`, selected: value === 1})));
    const loop = element("button", {className: "loop", ariaLabel: "Loop", ariaPressed: "true", onclick: () => this.change({loop: !this.state.loop})});
    this.shown.loop = (on) => { loop.ariaPressed = String(on); };
    this.shown.playing = (on) => { this.playButton.ariaLabel = on ? "Pause" : "Play"; this.playButton.classList.toggle("on", on); };
    this.shown.rate = (value) => { rate.value = value; };
    this.timeControls = [this.playButton, this.slider, this.clock, rate, loop];
    this.vrButton = element("button", {className: "word", textContent: "Enter VR", hidden: true, onclick: () => this.enterVr()});
    const full = element("button", {className: "full", ariaLabel: "Full screen", hidden: !document.fullscreenEnabled,
      onclick: () => document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()});
    const more = element("button", {className: "more", ariaLabel: "Controls", ariaExpanded: String(!this.side.hidden), onclick: () => {
      this.side.hidden = !this.side.hidden;
      more.ariaExpanded = String(!this.side.hidden);
      this.resized();
    }});
    return this.bar = element("nav", {ariaLabel: "Time"}, ...this.timeControls, element("span", {className: "gap"}), this.vrButton, full, more);
  }

  panel() {
    this.shown = {};
    this.picker = element("input", {type: "file", accept: ".b4d,.hdr", hidden: true, onchange: () => this.takeFiles(this.picker.files)});
    const kind = element("select", {ariaLabel: "New light"}, ...["point", "spot", "directional"].map((name) => element("option", {textContent: name})));
    const add = element("button", {className: "word", textContent: "Add light", onclick: () => this.lamps.add(kind.value)});
    this.side = element("aside", {ariaLabel: "Controls", hidden: innerWidth < 700},
      group("Picture", true, this.channel = this.select("Channel", "channel", CHANNELS), this.color("Background", "background"),
        this.settings.view?.cameras ? this.check("Camera path", "path") : "",
        element("button", {className: "word", textContent: "Frame subject", onclick: () => this.frameSubject()})),
      group("Light", true, this.environmentSelect(), this.check("Show it behind", "behind"), this.select("Its shadows", "environmentShadows", SHADOW_REGIONS),
        this.range("Rotation", "rotation", -180, 180, 1, "°"), this.range("Exposure", "exposure", -6, 6, 0.1, " stops"), this.select("View transform", "transform", TRANSFORMS)),
      group("Lamps", true, element("div", {className: "row"}, kind, add), this.lamps.list),
      this.stillGroup = this.stills ? group("Stills", false, ...this.stills.controls) : "",
      group("Files", false, element("div", {className: "row"}, element("button", {className: "word", textContent: "Save PNG", onclick: () => this.savePng()}),
        element("button", {className: "word", textContent: "Save lights", onclick: () => this.saveLights()}),
        element("button", {className: "word", textContent: "Open …", onclick: () => this.picker.click()})), this.picker,
        element("p", {className: "hint", textContent: "A .b4d take or an .hdr environment; it can also be dropped on the page."})));
    return this.side;
  }

  select(label, name, choices) {
    const pairs = Array.isArray(choices) ? choices.map((each) => [each, each]) : Object.entries(choices);
    const isNumber = typeof this.state[name] === "number";
    const made = element("select", {onchange: () => this.change({[name]: isNumber ? Number(made.value) : made.value})},
      ...pairs.map(([value, textContent]) => element("option", {value, textContent})));
    made.value = this.state[name];
    this.shown[name] = (value) => { made.value = value; };
    return element("label", {}, label, made);
  }

  environmentSelect() {
    const fill = () => made.replaceChildren(...Object.keys(this.offered()).map((name) => element("option", {textContent: name})));
    const made = element("select", {onchange: () => this.choose(made.value)});
    fill();
    this.shown.environment = (name) => { fill(); made.value = name; };
    return element("label", {}, "Environment", made);
  }

  range(label, name, min, max, step, unit) {
    const value = element("b", {ariaHidden: "true"}), made = element("input", {type: "range", min, max, step, oninput: () => this.change({[name]: Number(made.value)}),
      ondblclick: () => this.change({[name]: 0})});
    this.shown[name] = (number) => { made.value = number; made.ariaValueText = value.textContent = `${number}${unit}`; };
    this.shown[name](this.state[name]);
    return element("label", {}, element("span", {}, label, value), made);
  }

  color(label, name) {
    const made = element("input", {type: "color", value: this.state[name], oninput: () => this.change({[name]: made.value})});
    this.shown[name] = (value) => { made.value = value; };
    return element("label", {}, label, made);
  }

  check(label, name) {
    const made = element("input", {type: "checkbox", checked: this.state[name], onchange: () => this.change({[name]: made.checked})});
    this.shown[name] = (value) => { made.checked = value; };
    return element("label", {}, label, made);
  }

  /** Offer what the take has. */
  fitControls() {
    const has = (name) => name === "relit" ? "base_color" in this.take.still : name === "radiance" ? "radiance_0" in this.take.still
      : ["depth", "alpha"].includes(name) || name in this.take.still;
    for (const option of this.channel.querySelectorAll("option")) option.disabled = option.hidden = !has(option.value);
    if (!has(this.state.channel)) this.change({channel: has("radiance") ? "radiance" : "alpha"});
    for (const control of this.timeControls) control.hidden = this.frames < 2;
    this.slider.max = this.frames - 1;
  }

  showTime() {
    this.slider.value = this.frame;
    this.clock.textContent = `${this.frame + 1} / ${this.frames}`;
    this.slider.ariaValueText = `frame ${this.frame + 1} of ${this.frames}`;
  }

  frameSubject() {
    if (this.box) this.orbit.frame(this.box, this.free());
    this.change({path: false});
  }

  bindPage() {
    const keys = {" ": () => this.change({playing: !this.state.playing}), f: () => this.frameSubject(), ",": () => this.step(-1), ".": () => this.step(1),
      Escape: () => this.message.classList.contains("fatal") || this.hush()};
    addEventListener("keydown", (event) => {
      const isTyping = event.target.matches?.("input, select, button, summary, [role=slider]") && event.key !== "Escape";
      if (isTyping || event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
      event.preventDefault();
      keys[event.key]();
    });
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => { event.preventDefault(); this.takeFiles(event.dataTransfer.files); });
    new ResizeObserver(() => this.resized()).observe(this.root);
    this.change({background: this.state.background});
  }

  resized() {
    if (this.orbit.isFramed && this.box) this.orbit.frame(this.box, this.free());
    this.moved();
  }

  step(frames) {
    this.change({playing: false, time: ((this.frame + frames + this.frames) % this.frames) / this.frameRate});
  }

  /** Open files that were chosen or dropped: a take, environments. */
  async takeFiles(files) {
    for (const file of files) {
      if (file.name.endsWith(".b4d")) await this.open(file, file.name.slice(0, -4));
      else await this.addEnvironment(file);
    }
  }

  async addEnvironment(file) {
    try {
      this.environments.set(file.name, await Environment.load(new Uint8Array(await file.arrayBuffer())));
      await this.choose(file.name);
    } catch (error) {
      this.say(`${file.name} must be a .b4d take or an .hdr environment that can be read: ${error.message}`);
    }
  }

  /** Save what is shown, in the page's full size. */
  async savePng() {
    if (this.stills?.isShown) return this.stills.savePng();
    await this.relight.ready();
    this.draw();
    const {width, height} = this.canvas, copy = element("canvas", {width, height}), brush = copy.getContext("2d");
    brush.fillStyle = this.state.background;
    brush.fillRect(0, 0, width, height);
    brush.drawImage(this.canvas, 0, 0);
    copy.toBlob((blob) => download("beam.png", blob));
  }

  saveLights() {
    download("lights.json", new Blob([JSON.stringify({lights: this.lamps.lights()}, null, 2)], {type: "application/json"}));
  }

  async enterVr() {
    try {
      await enterVr(this);
    } catch (error) {
      this.say(`The headset cannot be used: ${error.message}`);
    }
  }
}

const now = () => performance.now();

/** Wait until the graphics device is done with what it was given; returns how long that took [ms]. */
async function finished({device, gl}) {
  const began = now();
  if (device) await device.queue.onSubmittedWorkDone();
  else {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (fence && gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.UNSIGNALED) await new Promise((go) => setTimeout(go, 2));
    gl.deleteSync(fence);
  }
  return now() - began;
}

const group = (name, open, ...children) => element("details", {open}, element("summary", {textContent: name}), ...children);
