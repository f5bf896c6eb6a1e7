/** Stills that a server draws: what takes its renderers seconds, and what a take does not hold. `beam view` serves them. */
import {download, element} from "./elements.js";

/** A page's stills: their controls, and the picture that lies over the canvas until something changes. */
export class Stills {
  constructor(player, {kinds, grounds, samples, longest}) {
    const choice = (pairs) => element("select", {}, ...pairs.map(([value, textContent]) => element("option", {value, textContent})));
    Object.assign(this, {player, longest, kind: choice(Object.entries(kinds)), ground: choice(grounds.map((name) => [name, name])),
      size: choice([[1, "full"], [0.5, "half"], [0.25, "quarter"]]), samples: element("input", {type: "number", min: 1, max: 65536, step: 1, value: samples}),
      image: element("img", {className: "still", hidden: true, alt: "Still"}), legend: element("img", {className: "legend", hidden: true, alt: "What its colours mean"})});
    this.size.value = 0.5;
    this.button = element("button", {className: "word", textContent: "Draw still", onclick: () => this.isDrawing ? this.drop() : this.draw()});
    this.exrButton = element("button", {className: "word", textContent: "Save EXR", disabled: true, onclick: () => this.saveExr()});
    this.said = element("p", {className: "hint", role: "status"});
    const label = (text, control) => element("label", {}, text, control), isLit = () => ["path traced", "deferred"].includes(this.kind.value);
    const ground = label("Ground", this.ground), paths = label("Samples", this.samples);
    const fit = () => { ground.hidden = grounds.length < 2 || !isLit(); paths.hidden = this.kind.value !== "path traced"; };
    this.kind.addEventListener("change", fit);
    fit();
    this.controls = [label("Shows", this.kind), label("Size", this.size), paths, ground, element("div", {className: "row"}, this.button, this.exrButton), this.legend, this.said];
  }

  /** Return what the server is asked for: what the page shows now. */
  asked() {
    const {player} = this, {state, root} = player, scale = Number(this.size.value) * Math.min(devicePixelRatio || 1, 2);
    const fit = Math.min(scale, this.longest / Math.max(root.clientWidth, root.clientHeight));
    const camera = player.camera(...[root.clientWidth, root.clientHeight].map((side) => Math.max(1, Math.floor(side * fit))));
    return {kind: this.kind.value, frame: player.frame, camera, environment: state.environment, rotation: player.rotation, lights: player.lamps.lights(),
      ground: this.ground.value, samples: this.samples.valueAsNumber || 1, exposure: state.exposure, transform: state.transform,
      background: state.behind && state.environment !== "none" ? "environment" : state.background};
  }

  /** Ask for a still, and show it as it gets better. */
  async draw() {
    this.player.change({playing: false});
    const going = this.going = new AbortController(), {signal} = going;
    this.button.textContent = "Stop";
    this.player.busy(true);
    this.said.textContent = "The server draws …";
    try {
      const answer = await fetch("stills", {method: "POST", body: JSON.stringify(this.asked()), signal});
      if (!answer.ok) throw new Error(await answer.text());
      await eachLine(answer.body, (line) => signal.aborted || this.show(line));
    } catch (error) {
      if (!signal.aborted) this.player.say(`The still cannot be drawn: ${error.message}`);
      if (!signal.aborted) this.said.textContent = "";
    }
    if (this.going === going) this.rest();
  }

  show({png, legend, samples, of, exr, error}) {
    if (error) throw new Error(error);
    this.image.src = `data:image/png;base64,${png}`;
    this.image.hidden = false;
    this.legend.hidden = !legend;
    if (legend) this.legend.src = `data:image/png;base64,${legend}`;
    this.said.textContent = of > 1 ? `${samples} of ${of} samples` : "Done";
    this.exr = exr;
    this.exrButton.disabled = !exr;
  }

  get isDrawing() { return Boolean(this.going); }
  get isShown() { return !this.image.hidden; }

  rest() {
    this.going = null;
    this.button.textContent = "Draw still";
    this.player.busy(!this.player.isLit);
  }

  /** Take the still away, and ask for no more of it: something has changed. */
  drop() {
    this.going?.abort();
    if (this.isDrawing) this.rest();
    for (const part of [this.image, this.legend]) part.hidden = true;
    this.said.textContent = "";
    this.exrButton.disabled = true;
  }

  async savePng() { download("beam.png", await (await fetch(this.image.src)).blob()); }

  async saveExr() {
    const answer = await fetch(this.exr).catch((error) => ({statusText: error.message}));
    if (answer.ok) download("beam.exr", await answer.blob());
    else this.player.say(answer.status === 404 ? "The server holds the newest still only: draw this one again." : `The still cannot be saved: ${answer.statusText}`);
  }
}

/** Hand over each line of JSON of a stream as it comes. */
async function eachLine(stream, take) {
  const reader = stream.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (let part; !(part = await reader.read()).done;) {
    const lines = (rest + part.value).split("\n");
    rest = lines.pop();
    for (const line of lines) take(JSON.parse(line));
  }
  if (rest) throw new Error("the answer was cut short");
}
