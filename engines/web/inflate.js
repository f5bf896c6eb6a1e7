/**
 * Inflate (RFC 1951) in plain JavaScript. A browser's `DecompressionStream` takes longer: it makes and copies many small pieces.
 *
 * Entries of tables are 4 bits for the length of a code, 2 for how many octets it stands for, and those octets. If they are
 * none: 1 bit for the end of a block, and from the ninth on 16 for a base and 4 for the bits that are added to it.
 */

/** Return the functions that inflate; a worker can run this one: it uses nothing outside of itself. */
export function inflating() {
  const BITS = 10, NEAR = 1 << BITS, FAR = 1 << 15, WRONG = 1 << 31, SPARE = 32; // longer codes than BITS stand behind FAR
  const ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15], LENGTHS = Int32Array.from({length: 19}, (_, s) => s << 8);
  const symbols = new Int32Array(2 * FAR), spans = new Int32Array(2 * FAR), sizes = new Uint8Array(320);
  const must = (condition, contract) => { if (!condition) throw new Error(contract); };
  const based = (base, count, most, bitsOf) => Int32Array.from({length: most}, (_, k) => {
    const bits = bitsOf(k), entry = k < count ? base << 8 | bits << 24 : WRONG;
    base += 1 << bits;
    return entry;
  });
  const distances = based(1, 30, 32, (k) => Math.max(0, (k >> 1) - 1)), lengths = based(3, 28, 31, (k) => Math.max(0, (k >> 2) - 1));
  lengths[28] = 258 << 8;
  const meaning = (octet) => Int32Array.from({length: 288}, (_, s) => (s < 256 ? (octet(s) & 255) << 8 | 16 : s > 256 ? lengths[s - 257] : 64));
  const plain = meaning((s) => s), signed = meaning((s) => s >> 1 ^ -(s & 1));

  /** Fill a table with what the codes of some lengths stand for. */
  function fill(table, lengths, meanings) {
    const counts = new Int32Array(16), next = new Int32Array(17);
    let left = FAR;
    for (const length of lengths) counts[length]++;
    for (let l = 1; l < 16; l++) left -= counts[l] << 15 - l, next[l + 1] = next[l] + counts[l] << 1;
    must(left === 0 || left === FAR || counts[1] === 1 && left === FAR / 2 && meanings !== LENGTHS, "codes must be complete");
    table.fill(left && WRONG, 0, left ? 2 * FAR : NEAR);
    lengths.forEach((length, s) => {
      const isFar = length > BITS, end = isFar ? 2 * FAR : NEAR;
      let at = 0;
      for (let code = length && next[length]++, k = 0; k < length; k++) at = at << 1 | code >> k & 1;
      for (at += isFar && FAR; length && at < end; at += 1 << length) table[at] = meanings[s] | length;
    });
  }

  /** Let an entry stand for all octets, up to three, that its bits tell. */
  function join(table) {
    for (let i = NEAR - 1, e, f; i >= 0; table[i--] = e) {
      e = table[i];
      for (let n = 8; n < 24 && e & 48 && ((f = table[i >> (e & 15)]) & 48) === 16 && (e & 15) + (f & 15) <= BITS; n += 8) e = e + 16 + (f & 15) | (f & 0xff00) << n;
    }
  }

  /** Unpack a block whose tables are filled. */
  function unpacked(from, pos, to, at) {
    for (let bits, e, more; ;) {
      bits = from.getUint32(pos >>> 3, true) >>> (pos & 7), e = symbols[bits & NEAR - 1] || symbols[bits & FAR - 1 | FAR];
      pos = pos + (e & 15) | 0;
      if (e & 48) {
        to.setInt32(at, e >> 8, true), at = at + (e >> 4 & 3) | 0;
        continue;
      }
      if (e & 64) return [pos, at];
      must(e > 0, "codes must be known");
      more = e >> 24;
      const end = at + (e >> 8 & 0xffff) + (bits >>> (e & 15) & (1 << more) - 1) | 0;
      pos = pos + more | 0;
      bits = from.getUint32(pos >>> 3, true) >>> (pos & 7), e = spans[bits & NEAR - 1] || spans[bits & FAR - 1 | FAR];
      must(e > 0, "codes must be known");
      pos = pos + (e & 15) | 0, more = e >> 24;
      let distance = (e >> 8 & 0xffff) + (from.getUint32(pos >>> 3, true) >>> (pos & 7) & (1 << more) - 1) | 0;
      pos = pos + more | 0;
      if (distance < 4) { // words cannot be copied yet
        for (const near = at + 3 * distance | 0; at < near; at = at + 1 | 0) to.setInt8(at, to.getInt8(at - distance | 0));
        distance = 4 * distance | 0;
      }
      for (let i = at, j = at - distance | 0; i < end; i = i + 16 | 0, j = j + 16 | 0) {
        to.setInt32(i, to.getInt32(j, true), true), to.setInt32(i + 4 | 0, to.getInt32(j + 4 | 0, true), true);
        to.setInt32(i + 8 | 0, to.getInt32(j + 8 | 0, true), true), to.setInt32(i + 12 | 0, to.getInt32(j + 12 | 0, true), true);
      }
      at = end;
    }
  }

  /**
   * Unpack what a stream has between two of its bytes, or up to its end.
   * @param {Uint8Array} packed
   * @param {number} start
   * @param {number} end
   * @param {Uint8Array} room At least `SPARE` bytes longer than what comes; more is an error.
   * @param {boolean} isSigned Put 0, -1, 1, -2, 2 … where octets 0, 1, 2, 3, 4 … stand.
   * @returns {number} How many bytes came.
   */
  function inflate(packed, start, end, room, isSigned = false) {
    const from = new DataView(packed.buffer, packed.byteOffset + start, packed.length - start), to = new DataView(room.buffer, room.byteOffset, room.length);
    const take = (count) => { const found = from.getUint32(pos >>> 3, true) >>> (pos & 7) & (1 << count) - 1; pos += count; return found; };
    const octets = isSigned ? signed : plain;
    const most = 8 * (end - start);
    let pos = 0, at = 0, isLast = 0;
    while (!isLast && pos < most) {
      isLast = take(1);
      const kind = take(2), isFixed = kind === 1;
      must(kind < 3, "blocks must be of one of three kinds");
      if (kind === 0) {
        const first = (pos + 7 >>> 3) + 4, size = from.getUint16(first - 4, true);
        for (let k = 0; k < size; k++) to.setInt8(at++, octets[from.getUint8(first + k)] >> 8);
        must((size ^ from.getUint16(first - 2, true)) === 0xffff, "stored blocks must say their size");
        pos = 8 * (first + size);
        continue;
      }
      const count = isFixed ? 288 : 257 + take(5), all = count + (isFixed ? 32 : 1 + take(5));
      if (isFixed) sizes.fill(8).fill(9, 144, 256).fill(7, 256, 280).fill(5, 288);
      else {
        const first = new Uint8Array(19);
        for (let k = 0, last = 4 + take(4); k < last; k++) first[ORDER[k]] = take(3);
        fill(symbols, first, LENGTHS);
        let k = 0;
        while (k < all) {
          const e = symbols[from.getUint32(pos >>> 3, true) >>> (pos & 7) & NEAR - 1], s = e >> 8;
          must(e > 0 && (k || s !== 16), "codes must be known");
          pos += e & 15;
          const [times, size] = s < 16 ? [1, s] : s === 16 ? [3 + take(2), sizes[k - 1]] : [s === 17 ? 3 + take(3) : 11 + take(7), 0];
          sizes.fill(size, k, k += times);
        }
        must(k === all && count < 287 && all - count < 31 && sizes[256], "codes must be as many as they say");
      }
      fill(symbols, sizes.subarray(0, count), octets), join(symbols);
      fill(spans, sizes.subarray(count, all), distances);
      [pos, at] = unpacked(from, pos, to, at);
    }
    must(at <= room.length - SPARE && (isLast ? pos <= most : pos === most), "streams must be as long as they say");
    return at;
  }

  /** Return what a stream has between two of its bytes, or up to its end, if that is not more than `most` bytes. */
  function inflated(packed, start, end, most) {
    const room = new Uint8Array(Math.min(most, 1032 * (end - start)) + SPARE); // deflate packs no closer
    return room.subarray(0, inflate(packed, start, end, room));
  }
  return {inflate, inflated, SPARE};
}
