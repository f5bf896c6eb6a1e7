/**
 * Segments of a take, as they are wanted: fetched, unpacked in a worker, and kept on the GPU within a bound.
 *
 * What is wanted comes first. What follows it is read ahead, one at a time, once it is here. What is not wanted any more is
 * not fetched to its end, or not unpacked: a seek waits for one block at most that is being unpacked.
 */

import {unpacking} from "./b4d.js";
import {inWorker} from "./environment.js";
import {inflating} from "./inflate.js";

const RETRY_MS = 2000, MOST_LOADING = 3;

export class Segments {
  #here = new Map(); #loading = new Map(); #failed = new Map(); #aborts = new Map(); #worker; #isEnded = false;
  /** Numbers of the segment that is asked for, and of the one whose frame is shown. */
  wanted = 0; shown = null;
  /** How long the last segment took to be fetched, unpacked, and brought to the GPU [ms]. */
  timings = {};

  /**
   * Make room for a take.
   * @param {Take} take
   * @param {{most: number, store: Function, free: Function, tell: Function}} owner `store(number, entry, tracks)` resolves to
   *     a segment, which has `bytes` on the GPU; `free(segment)` gives it back; `most` is how many bytes are kept;
   *     `tell(type, detail)` says what has stalled, and what has resumed.
   * @param {{ask: Function, end: Function}} [worker] What unpacks blocks.
   */
  constructor(take, owner, worker = inWorker(unpacking, inflating)) {
    this.#worker = worker;
    Object.assign(this, {take, ...owner, count: take.manifest.segments.length});
  }

  has(number) {
    return this.#here.has(number);
  }

  get(number) {
    return this.#here.get(number);
  }

  /** Bytes that are kept on the GPU. */
  get bytes() {
    return [...this.#here.values()].reduce((sum, {bytes}) => sum + bytes, 0);
  }

  /** Whether a segment could not be read a moment ago. */
  hasFailed(number) {
    return performance.now() - (this.#failed.get(number)?.since ?? -Infinity) < RETRY_MS;
  }

  /** How many segments after the wanted one are read ahead; the first one follows the last. */
  get ahead() {
    const largest = Math.max(0, ...[...this.#here.values()].map(({bytes}) => bytes));
    return Math.min(4 * largest <= this.most ? 2 : 1, this.count - 1);
  }

  #after(number) {
    return (number - this.wanted + this.count) % this.count;
  }

  #isWanted(number) {
    return !this.#isEnded && this.#after(number) <= this.ahead;
  }

  /** Ask for a segment, and, once it is here, for those that follow. */
  want(number) {
    this.wanted = number;
    for (const [loading, abort] of this.#aborts) if (!this.#isWanted(loading)) abort.abort();
    this.load(number);
    this.#complain();
    for (let k = 1; k <= this.ahead && !this.#loading.size; k++) this.load((number + k) % this.count);
  }

  /** Say that the wanted segment cannot be read; of one that was only read ahead nothing is said yet. */
  #complain() {
    const failure = this.#failed.get(this.wanted);
    if (!failure || failure.isSaid) return;
    failure.isSaid = true;
    this.tell("stalled", failure.detail);
  }

  /** Fetch a segment unless it is here; resolves to it, or to null if it cannot be read, is not wanted any more, or has to wait. */
  load(number) {
    if (this.#here.has(number)) return Promise.resolve(this.#here.get(number));
    if (this.#isEnded || this.hasFailed(number)) return Promise.resolve(null);
    if (!this.#loading.has(number)) {
      if (this.#loading.size >= MOST_LOADING) return Promise.race(this.#loading.values()).then(() => null);
      this.#loading.set(number, this.#fetch(number).finally(() => {
        this.#loading.delete(number);
        this.#aborts.delete(number);
        if (!this.#isEnded) this.want(this.wanted);
      }));
    }
    return this.#loading.get(number);
  }

  async #fetch(number) {
    const entry = this.take.manifest.segments[number], times = [performance.now()], abort = new AbortController();
    this.#aborts.set(number, abort);
    try {
      const tracks = await this.take.tracks(entry, entry.frames, async (block) => {
        times.push(performance.now());
        if (!this.#isWanted(number)) abort.abort();
        return abort.signal.aborted ? {tracks: {}} : this.#worker.ask(block);
      }, abort.signal);
      times.push(performance.now());
      if (abort.signal.aborted) return null;
      const segment = await this.store(number, entry, tracks);
      times.push(performance.now());
      if (this.#isEnded) return this.free(segment), null;
      this.timings = Object.fromEntries(["fetch", "unpack", "upload"].map((name, k) => [name, times[k + 1] - times[k]]));
      this.#here.set(number, segment);
      if (this.#failed.get(number)?.isSaid) this.tell("resumed", {segment: number});
      this.#failed.delete(number);
      this.#forget();
      return segment;
    } catch (error) {
      if (abort.signal.aborted) return null;
      this.#failed.set(number, {since: performance.now(), isSaid: false, detail: {segment: number, file: entry.file, error, message: error.message}});
      this.#complain();
      return null;
    }
  }

  /** Give back the segments farthest from what is wanted, what is behind sooner, until the rest is within the bound. */
  #forget() {
    const distance = ({number}) => Math.min(this.#after(number), 1.5 * (this.count - this.#after(number)));
    for (const segment of [...this.#here.values()].sort((a, b) => distance(b) - distance(a))) {
      if (this.bytes <= this.most) return;
      if (segment.number === this.shown || this.#after(segment.number) <= this.ahead) continue;
      this.#here.delete(segment.number);
      this.free(segment);
    }
  }

  /** Return the place nearest to a frame in the segments that are here, or in those before it; and how far it is [frame]; or null. */
  nearest(frame, isBefore = false) {
    let best = null;
    for (const {number, entry: {first, frames}} of this.#here.values()) {
      if (isBefore && first > frame) continue;
      const local = frame < first ? 0 : Math.min(frame - first, frames - 1), distance = Math.abs(first + local - frame);
      if (!best || distance < best.distance) best = {number, local, share: 0, distance};
    }
    return best;
  }

  /** Give everything back. */
  end() {
    this.#isEnded = true;
    for (const abort of this.#aborts.values()) abort.abort();
    this.#worker.end();
    for (const segment of this.#here.values()) this.free(segment);
    this.#here.clear();
  }
}
