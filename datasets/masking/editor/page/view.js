// Draws a frame with its layers, at any zoom.

const COLORS = { animal: "#3cdc3c", surroundings: "#ff4d4d", eraser: "#ffffff", box: "#ffd23c" };
const [CLOSEST, EDGE] = [32, 1.5]; // screen pixels of a pixel of the frame; thickness of the mask's edge

export class View {
  opacity = 0.45;
  frame = null;
  layers = null;
  box = null;
  drafts = []; // strokes and boxes that the editor does not show yet
  brush = null; // {x, y, radius}: the circle under the pointer
  #canvas;
  #edges = new OffscreenCanvas(1, 1);
  #isFitted = true;
  #asked = 0;

  constructor(canvas, size) {
    this.#canvas = canvas;
    [this.width, this.height] = size;
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
  }

  // A point of the page in pixels of the frame.
  toFrame(x, y) {
    const at = this.#canvas.getBoundingClientRect();
    return [(x - at.left - this.x) / this.scale, (y - at.top - this.y) / this.scale];
  }

  fit() {
    const [wide, high] = [this.#canvas.clientWidth, this.#canvas.clientHeight];
    this.scale = Math.min(wide / this.width, high / this.height);
    this.x = (wide - this.width * this.scale) / 2;
    this.y = (high - this.height * this.scale) / 2;
    this.#isFitted = true;
    this.draw();
  }

  // Zooms so that a point of the page (the middle without one) stays where it is.
  zoom(factor, x, y) {
    const at = this.#canvas.getBoundingClientRect();
    const [across, down] = [x === undefined ? at.width / 2 : x - at.left, y === undefined ? at.height / 2 : y - at.top];
    const least = Math.min(at.width / this.width, at.height / this.height) / 2;
    const scale = Math.min(CLOSEST, Math.max(least, this.scale * factor));
    this.x = across - ((across - this.x) * scale) / this.scale;
    this.y = down - ((down - this.y) * scale) / this.scale;
    this.scale = scale;
    this.#isFitted = false;
    this.#hold();
  }

  move(across, down) {
    this.x += across;
    this.y += down;
    this.#isFitted = false;
    this.#hold();
  }

  // Draws before the browser shows the next picture.
  draw() {
    this.#asked ||= requestAnimationFrame(() => {
      this.#asked = 0;
      this.#draw();
    });
  }

  // Keeps some of the frame in sight.
  #hold() {
    const [wide, high, margin] = [this.#canvas.clientWidth, this.#canvas.clientHeight, 60];
    this.x = Math.min(wide - margin, Math.max(margin - this.width * this.scale, this.x));
    this.y = Math.min(high - margin, Math.max(margin - this.height * this.scale, this.y));
    this.draw();
  }

  #resize() {
    this.ratio = Math.min(2, devicePixelRatio || 1);
    this.#canvas.width = Math.max(1, Math.round(this.#canvas.clientWidth * this.ratio));
    this.#canvas.height = Math.max(1, Math.round(this.#canvas.clientHeight * this.ratio));
    if (this.#isFitted) this.fit();
    else this.#hold();
  }

  #draw() {
    document.body.dataset.scale = this.scale;
    const context = this.#canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, this.#canvas.width, this.#canvas.height);
    if (!this.frame) return;
    const place = [this.x, this.y, this.width * this.scale, this.height * this.scale].map((value) => value * this.ratio);
    context.imageSmoothingEnabled = this.scale * this.ratio < 4;
    context.drawImage(this.frame, ...place);
    if (this.layers?.mask) {
      context.globalAlpha = this.opacity;
      context.drawImage(this.layers.mask, ...place);
      context.globalAlpha = this.opacity && 1;
      context.drawImage(this.#edge(this.layers.mask, place), 0, 0);
    }
    context.globalAlpha = 0.75;
    if (this.layers?.marks) context.drawImage(this.layers.marks, ...place);
    context.setTransform(this.scale * this.ratio, 0, 0, this.scale * this.ratio, place[0], place[1]);
    for (const draft of this.drafts) if (draft.points) line(context, draft);
    context.globalAlpha = 1;
    const drawnBox = this.drafts.findLast((draft) => draft.kind === "box");
    const box = drawnBox ? drawnBox.box : this.box;
    if (box) frameOf(context, box, this.scale);
    if (this.brush) circle(context, this.brush, this.scale);
  }

  // The mask's edge, as thin at any zoom.
  #edge(mask, place) {
    const { width, height } = this.#canvas;
    if (this.#edges.width !== width || this.#edges.height !== height) this.#edges = new OffscreenCanvas(width, height);
    const context = this.#edges.getContext("2d");
    const thick = EDGE * this.ratio;
    context.globalCompositeOperation = "source-over";
    context.clearRect(0, 0, width, height);
    context.imageSmoothingEnabled = false;
    for (let i = 0; i < 8; i++) {
      const [across, down] = [Math.cos((i * Math.PI) / 4) * thick, Math.sin((i * Math.PI) / 4) * thick];
      context.drawImage(mask, place[0] + across, place[1] + down, place[2], place[3]);
    }
    context.globalCompositeOperation = "destination-out";
    context.drawImage(mask, ...place);
    context.globalCompositeOperation = "source-in";
    context.fillStyle = "#d8efff";
    context.fillRect(0, 0, width, height);
    return this.#edges;
  }
}

function line(context, { tool, radius, points }) {
  context.strokeStyle = COLORS[tool];
  context.lineWidth = Math.max(1, 2 * radius);
  context.lineCap = context.lineJoin = "round";
  context.beginPath();
  context.moveTo(...points[0]);
  for (const point of points) context.lineTo(...point);
  context.stroke();
}

function frameOf(context, box, scale) {
  for (const [color, thick] of [["#000a", 4], [COLORS.box, 2]]) {
    context.strokeStyle = color;
    context.lineWidth = thick / scale;
    context.strokeRect(...box);
  }
}

function circle(context, { x, y, radius, tool }, scale) {
  for (const [color, thick] of [["#000a", 3], [COLORS[tool] ?? "#fff", 1.5]]) {
    context.strokeStyle = color;
    context.lineWidth = thick / scale;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.stroke();
  }
}
