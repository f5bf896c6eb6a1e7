/** Relightable takes of Gaussians in a browser: see docs/engines/web.md of beam-warp. three.js has a module of its own, `three.js`. */

export {DeliveryError, Take} from "./b4d.js";
export {Environment, EnvironmentError} from "./environment.js";
export {GpuError} from "./gpu.js";
export {LightError} from "./lights.js";
export {Relight, RelightError} from "./relight.js";
