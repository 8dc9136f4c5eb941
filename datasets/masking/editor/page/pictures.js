// Frames, thumbnails, masks and strokes, decoded and kept for a while.

const [MEMORY, FEWEST] = [200e6, 8]; // bytes of frames that are kept, and the same of layers; but so many at least
const TINT = "#3ba0ff";

export class Pictures {
  #kept = { frame: new Map(), layers: new Map(), thumb: new Map() };

  // `size`: width and height of the frames.
  constructor([width, height]) {
    this.most = Math.max(FEWEST, Math.floor(MEMORY / (4 * width * height)));
  }

  frame(place) {
    return this.#get("frame", place, () => decoded(`frame/${place}`));
  }

  thumb(place) {
    return this.#get("thumb", place, () => decoded(`thumb/${place}`));
  }

  // The mask in its colour and the strokes of a frame, as they were in a version.
  layers(place, version, hasMask, hasMarks) {
    return this.#get("layers", `${place}:${version}`, async () => {
      const [mask, marks] = await Promise.all([
        hasMask ? decoded(`mask/${place}?v=${version}`).then(tinted) : null,
        hasMarks ? decoded(`marks/${place}?v=${version}`) : null,
      ]);
      return { place, version, mask, marks };
    });
  }

  #get(kind, key, make) {
    const kept = this.#kept[kind];
    let found = kept.get(key);
    if (found) kept.delete(key); // put it at the end: it was used last
    else {
      found = make();
      found.catch(() => kept.delete(key));
    }
    kept.set(key, found);
    if (kind !== "thumb" && kept.size > this.most) kept.delete(kept.keys().next().value);
    return found;
  }
}

async function decoded(address) {
  const reply = await fetch(address);
  if (!reply.ok) throw new Error(`${address}: ${reply.status}`);
  return createImageBitmap(await reply.blob());
}

// A grey mask as a picture that is coloured inside and transparent outside.
function tinted(grey) {
  const canvas = new OffscreenCanvas(grey.width, grey.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(grey, 0, 0);
  const pixels = context.getImageData(0, 0, grey.width, grey.height);
  const values = new Uint32Array(pixels.data.buffer);
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(TINT.slice(at, at + 2), 16));
  const color = 0xff000000 | (blue << 16) | (green << 8) | red;
  for (let i = 0; i < values.length; i++) values[i] = (values[i] & 255) > 127 ? color : 0;
  context.putImageData(pixels, 0, 0);
  return canvas;
}
