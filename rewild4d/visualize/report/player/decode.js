// Reads the packed Gaussians; the layout and its twin in Python: rewild4d/visualize/report/layout.py.
const MAGIC = "R4SP", VERSION = 1, HEAD = 10;

const DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;,=>?@^_`{|}~";
const VALUES = Uint8Array.from({ length: 128 }, (_, code) => Math.max(0, DIGITS.indexOf(String.fromCharCode(code))));

// Text in base 85 as Python writes it, with "," for "<"; the last group may be short.
export function bytesOf(text) {
  text = text.trim();
  const spare = (5 - text.length % 5) % 5, groups = (text.length + spare) / 5;
  const view = new DataView(new ArrayBuffer(4 * groups));
  text += "~".repeat(spare);
  for (let group = 0, place = 0; group < groups; group++) {
    let value = 0;
    for (let digit = 0; digit < 5; digit++) value = 85 * value + VALUES[text.charCodeAt(place++)];
    view.setUint32(4 * group, value);
  }
  return new Uint8Array(view.buffer, 0, 4 * groups - spare);
}

export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Clouds: {count, moments, frame, tracks: {name: {moments, components, low, step, codes}}}, codes [moments, k, count].
export function decode(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const magic = String.fromCharCode(...bytes.subarray(0, 4)), version = view.getUint16(4, true);
  if (magic !== MAGIC || version !== VERSION)
    throw new Error(`expected ${MAGIC} of version ${VERSION}, got ${magic} of version ${version}`);
  let place = HEAD + view.getUint32(6, true);
  const { clouds } = JSON.parse(new TextDecoder().decode(bytes.subarray(HEAD, place)));
  return clouds.map(({ count, moments, frame, tracks }) => ({
    count, moments, frame,
    tracks: Object.fromEntries(tracks.map(track => {
      const size = track.moments * track.components * count, wide = track.bits > 8;
      const low = bytes.subarray(place, place + size);
      const high = wide ? bytes.subarray(place + size, place + 2 * size) : null;
      place += wide ? 2 * size : size;
      const largest = 2 ** track.bits - 1;
      return [track.name, {
        moments: track.moments, components: track.components, low: track.low,
        step: track.low.map((from, k) => (track.high[k] - from) / largest),
        codes: summed(low, high, count, track),
      }];
    })),
  }));
}

function summed(low, high, count, { moments, components, bits, order, along }) {
  const codes = new (bits > 8 ? Uint16Array : Uint8Array)(low.length), row = components * count, mask = 2 ** bits - 1;
  for (let start = 0; start < low.length; start += count) {
    let sum = 0;
    for (let i = start; i < start + count; i++) {
      const written = high ? low[i] | (high[i] << 8) : low[i];
      const rest = written & 1 ? -((written + 1) >> 1) : written >> 1;
      sum = along ? sum + rest : rest;
      // Undoing one or two differences over the moments needs the code of one or two moments before.
      const before = i >= row ? codes[i - row] : 0, earlier = i >= 2 * row ? codes[i - 2 * row] : 0;
      codes[i] = (sum + (order === 2 ? 2 * before - earlier : before)) & mask;
    }
  }
  return codes;
}
