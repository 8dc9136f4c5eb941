// The film as a strip: thumbnails, and for each frame its mask, box and marks.

const COLORS = {
  mask: "#3ba0ff", none: "#3a3f4a", box: "#ffd23c", animal: "#3cdc3c", other: "#ff4d4d", true: "#ffffff",
  dim: "#a3a9b6", now: "#ffffff", ground: "#131519",
};

const FOOT = 50; // pixels below the thumbnails: masks, marks, numbers

export class Strip {
  place = 0;
  #canvas;
  #thumbs = new Map();
  #asked = 0;

  // `names` are the film's own numbers; `choose(place)` is called while a pointer moves along.
  constructor(canvas, names, size, pictures, choose) {
    this.#canvas = canvas;
    this.names = names;
    this.shape = size[0] / size[1];
    this.pictures = pictures;
    canvas.setAttribute("aria-valuemin", 0);
    canvas.setAttribute("aria-valuemax", names.length - 1);
    let isDown = false;
    const pick = (event) => choose(this.#at(event.clientX));
    canvas.addEventListener("pointerdown", (event) => {
      isDown = true;
      canvas.setPointerCapture(event.pointerId);
      pick(event);
    });
    canvas.addEventListener("pointermove", (event) => isDown && pick(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => (isDown = false));
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
  }

  show(state, place) {
    this.state = state;
    this.place = place;
    this.#canvas.setAttribute("aria-valuenow", place);
    this.#canvas.setAttribute("aria-valuetext", `frame ${this.names[place]}`);
    this.draw();
  }

  draw() {
    this.#asked ||= requestAnimationFrame(() => {
      this.#asked = 0;
      this.#draw();
    });
  }

  #at(x) {
    const at = this.#canvas.getBoundingClientRect();
    return Math.max(0, Math.min(this.names.length - 1, Math.floor(((x - at.left) / at.width) * this.names.length)));
  }

  #resize() {
    this.ratio = Math.min(2, devicePixelRatio || 1);
    this.wide = this.#canvas.clientWidth;
    this.high = this.#canvas.clientHeight;
    this.#canvas.width = Math.max(1, this.wide * this.ratio);
    this.#canvas.height = Math.max(1, this.high * this.ratio);
    const thumbHigh = this.high - FOOT;
    this.count = Math.max(1, Math.min(this.names.length, Math.round(this.wide / (thumbHigh * this.shape))));
    for (let i = 0; i < this.count; i++) this.#load(Math.floor(((i + 0.5) * this.names.length) / this.count));
    this.draw();
  }

  #load(place) {
    if (this.#thumbs.has(place)) return;
    this.#thumbs.set(place, null);
    this.pictures.thumb(place).then((thumb) => {
      this.#thumbs.set(place, thumb);
      this.draw();
    }, () => this.#thumbs.delete(place));
  }

  #draw() {
    const context = this.#canvas.getContext("2d");
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.fillStyle = COLORS.ground;
    context.fillRect(0, 0, this.wide, this.high);
    const high = this.high - FOOT;
    this.#drawThumbs(context, high);
    if (!this.state) return;
    const step = this.wide / this.names.length;
    this.state.frames.forEach(([, marks, mask], place) => {
      const left = place * step;
      this.#drawMask(context, mask, left, step, high + 3);
      const middle = left + step / 2;
      if (this.state.boxes[place]) square(context, middle, high + 21);
      if (marks) dot(context, marks, middle, high + (this.state.boxes[place] ? 30 : 22));
    });
    this.#drawNames(context, step);
    this.#drawNow(context, step);
  }

  #drawThumbs(context, high) {
    const wide = this.wide / this.count;
    for (let i = 0; i < this.count; i++) {
      const thumb = this.#thumbs.get(Math.floor(((i + 0.5) * this.names.length) / this.count));
      if (!thumb) continue;
      const share = Math.min(1, wide / high / this.shape); // cut at the sides where the place is narrower
      context.drawImage(thumb, (thumb.width * (1 - share)) / 2, 0, thumb.width * share, thumb.height, i * wide, 0, wide + 0.5, high);
    }
  }

  #drawMask(context, mask, left, step, top) {
    const gap = step > 5 ? 1 : 0;
    context.fillStyle = mask ? COLORS.mask : COLORS.none;
    context.fillRect(left, top, step - gap + 0.3, 10);
    if (mask !== "empty") return;
    context.fillStyle = COLORS.ground;
    context.fillRect(left + gap, top + 2, step - 2 * gap + 0.3, 6);
  }

  #drawNames(context, step) {
    context.fillStyle = COLORS.dim;
    context.font = "10px system-ui, sans-serif";
    context.textBaseline = "bottom";
    const every = Math.max(1, Math.ceil(70 / step));
    for (let place = 0; place < this.names.length; place += every) {
      const middle = (place + 0.5) * step;
      if (Math.abs(place - this.place) * step > 34) this.#name(context, place, middle, this.high - 1);
    }
  }

  #drawNow(context, step) {
    const middle = (this.place + 0.5) * step;
    context.fillStyle = COLORS.now;
    context.fillRect(middle - 1, 0, 2, this.high - 13);
    context.font = "600 11px system-ui, sans-serif";
    this.#name(context, this.place, middle, this.high);
  }

  #name(context, place, middle, bottom) {
    const half = context.measureText(this.names[place]).width / 2;
    context.fillText(this.names[place], Math.max(0, Math.min(this.wide - 2 * half, middle - half)), bottom);
  }
}

function square(context, middle, top) {
  context.fillStyle = COLORS.box;
  context.fillRect(middle - 3.5, top - 4, 7, 7);
}

function dot(context, marks, middle, top) {
  context.save();
  context.translate(middle, top);
  if (marks === "true") {
    context.rotate(Math.PI / 4);
    context.fillStyle = COLORS.true;
    context.fillRect(-3.5, -3.5, 7, 7);
  } else {
    for (const [color, from] of [[COLORS.animal, 0.5], [COLORS.other, 1.5]]) {
      context.fillStyle = color;
      context.beginPath();
      context.arc(0, 0, 4.5, from * Math.PI, (from + 1) * Math.PI);
      context.fill();
    }
  }
  context.restore();
}
