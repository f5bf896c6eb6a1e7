// What every page does: it takes the file and the camera from its address, and says when the file is on the screen.
const asked = new URLSearchParams(location.search);
const numbers = (name) => asked.get(name).split(",").map(Number);

export const file = asked.get("file");
export const eye = numbers("eye");
export const target = numbers("target");
export const up = numbers("up");
export const fov = Number(asked.get("fov")); // vertical, in degrees
export const turned = asked.get("turned") === "1"; // whether the page turns the file as its viewer's manual says
export const background = 0x202020;

export const loaded = () => { window.state = "loaded"; };
addEventListener("unhandledrejection", (event) => { window.state = `failed: ${event.reason}`; });
addEventListener("error", (event) => { window.state = `failed: ${event.message}`; });
