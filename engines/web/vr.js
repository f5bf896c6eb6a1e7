/**
 * Playback in a headset by WebXR: the core draws what each eye sees.
 * The subject stands before the viewer in its true size. Sticks turn it and bring it nearer; the trigger pauses.
 */
import {Relight} from "./relight.js";
import {add} from "./orbit.js";

/** Return whether this browser has a headset to play in. */
export async function hasVr() {
  return Boolean(await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false));
}

/** Play in the headset until its session ends; call it from a click. */
export async function enterVr(player) {
  const session = await navigator.xr.requestSession("immersive-vr", {optionalFeatures: ["local-floor"]});
  try {
    const {relight, canvas} = await coreFor(player);
    const space = await session.requestReferenceSpace("local-floor").catch(() => session.requestReferenceSpace("local"));
    const gl = canvas.getContext("webgl2");
    await gl.makeXRCompatible();
    const layer = new XRWebGLLayer(session, gl, {antialias: false, alpha: false, depth: false});
    await session.updateRenderState({baseLayer: layer});
    player.vr = new Headset(player, session, space, layer, relight);
  } catch (error) {
    await session.end();
    throw error;
  }
}

/** Return a core that draws by WebGL 2, which headsets take: the page's own, or another one with the same contents. */
async function coreFor(player) {
  if (player.relight.backend === "webgl2") return player;
  const canvas = document.createElement("canvas"), relight = await Relight.create(canvas, {backend: "webgl2"});
  await relight.open(player.take);
  const {environment, environmentShadows, rotation, exposure, viewTransform, lights, channel} = player.relight;
  return {relight: Object.assign(relight, {environment, environmentShadows, rotation, exposure, viewTransform, lights, channel}), canvas};
}

class Headset {
  constructor(player, session, space, layer, relight) {
    const {low, center, extent} = player.box;
    Object.assign(this, {player, session, space, layer, relight, turn: 0, base: [center[0], center[1], low[2]], away: Math.max(1, extent)});
    session.addEventListener("select", () => player.change({playing: !player.state.playing}));
    session.addEventListener("end", () => this.end());
    session.requestAnimationFrame((time, frame) => this.tick(time, frame));
  }

  tick(time, frame) {
    const {player, relight, session} = this, passed = Math.min((time - (this.last ?? time)) / 1000, 0.25);
    session.requestAnimationFrame((next, following) => this.tick(next, following));
    this.last = time;
    this.steer(passed);
    if (player.state.playing) player.advance(passed);
    relight.time = player.shownTime;
    relight.rotation = player.rotation;
    const pose = frame.getViewerPose(this.space);
    for (const view of pose?.views ?? []) this.drawEye(view, this.layer.getViewport(view));
  }

  steer(seconds) {
    for (const {gamepad} of this.session.inputSources) {
      const [x, y] = gamepad?.axes.slice(-2) ?? [];
      if (Math.abs(x) > 0.15) this.turn += 1.5 * x * seconds;
      if (Math.abs(y) > 0.15) this.away = Math.max(0.3, this.away + y * seconds);
    }
  }

  drawEye(view, port) {
    if (!port.width || !port.height) return; // a headset of one eye
    const target = {framebuffer: this.layer.framebuffer, x: port.x, y: port.y, width: port.width, height: port.height};
    this.relight.draw({...eye(view, port.width, port.height, this), name: view.eye, target});
  }

  end() {
    if (this.relight !== this.player.relight) this.relight.dispose();
    this.player.vr = null;
    this.player.wake();
  }
}

/**
 * Return the camera of an eye in the take's world. A headset's axes are x right, y up, z back; the subject's base stands
 * `away` metres before its origin, turned about the vertical.
 */
export function eye({transform: {matrix: m}, projectionMatrix: p}, width, height, {turn, away, base}) {
  const [s, c] = [Math.sin(turn), Math.cos(turn)];
  const toWorld = ([x, y, z]) => [c * x - s * z, -s * x - c * z, y]; // z up, then turned back
  const [right, up, back] = [0, 4, 8].map((k) => toWorld([m[k], m[k + 1], m[k + 2]]));
  const position = add(toWorld([m[12], m[13], m[14] + away]), base);
  return {position, worldToCamera: [...right, ...up.map((v) => -v), ...back.map((v) => -v)], width, height,
    focal: [0.5 * width * p[0], 0.5 * height * p[5]], center: [0.5 * width * (1 - p[8]), 0.5 * height * (1 + p[9])]};
}
