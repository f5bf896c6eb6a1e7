/** Takes that a server packs while they are played: `beam view` serves them, and docs/delivery.md describes them. */
import {DeliveryError, Take} from "./b4d.js";

/** Open a take of a server that says in words what is wrong, and what a segment is like once it is made. */
export async function openLive(url) {
  const take = await Take.open(url, (name, start, size) => range(name === null ? url : new URL(name, url), start, size));
  take.tracks = async (entry, ...others) => {
    const said = entry.described && await (await asked(new URL(entry.described, url))).json();
    return Take.prototype.tracks.call(take, {...entry, ...said}, ...others);
  };
  return take;
}

async function asked(url, headers = {}) {
  const answer = await fetch(url, {headers}).catch((error) => { throw new DeliveryError(`The server cannot be reached: ${error.message}`); });
  if (!answer.ok) throw new DeliveryError(await answer.text());
  return answer;
}

async function range(url, start, size) {
  const answer = await asked(url, {Range: `bytes=${start}-${start + size - 1}`});
  return new Uint8Array(await answer.arrayBuffer());
}
