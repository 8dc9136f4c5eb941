// Mouse, pen and fingers on the frame: one draws, two zoom and move.

// Zoom by a pixel of the wheel; screen pixels between points of a stroke; points after which another stroke goes on.
const [FARTHER, TOO_NEAR, LONGEST] = [1.0015, 0.7, 5000];

export class Pointer {
  #fingers = new Map();
  #draft = null;
  #pinch = null;
  #isMoving = false;

  // `on` has tool(), radius(), mayDraw(), change(draft), finish(draft), hover().
  constructor(canvas, view, on) {
    this.canvas = canvas;
    this.view = view;
    this.on = on;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => this.#up(event));
    canvas.addEventListener("pointerleave", () => this.hover(null));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const way = event.deltaY * (event.deltaMode ? 30 : 1) * (event.ctrlKey ? 5 : 1);
      view.zoom(FARTHER ** -way, event.clientX, event.clientY);
      this.hover(event);
    }, { passive: false });
  }

  // Drops what is being drawn.
  cancel() {
    this.#draft = null;
    this.on.change(null);
  }

  hover(event) {
    const tool = this.on.tool();
    const isBrush = event && event.pointerType !== "touch" && !["box", "hand"].includes(tool);
    const [x, y] = event ? this.view.toFrame(event.clientX, event.clientY) : [0, 0];
    this.view.brush = isBrush ? { x, y, radius: this.on.radius(), tool } : null;
    this.last = event;
    this.view.draw();
  }

  #down(event) {
    event.preventDefault();
    this.canvas.focus({ preventScroll: true });
    try {
      this.canvas.setPointerCapture(event.pointerId);
    } catch { /* the pointer is gone already */ }
    this.#fingers.set(event.pointerId, event);
    if (event.pointerType === "touch" && this.#fingers.size > 1) {
      this.cancel();
      this.#pinch = this.#fingers.size === 2 ? this.#span() : null;
      return;
    }
    this.#isMoving = event.button > 0 || this.on.tool() === "hand";
    if (this.#isMoving || !this.on.mayDraw()) return;
    const point = this.view.toFrame(event.clientX, event.clientY);
    const tool = this.on.tool();
    this.#draft = tool === "box"
      ? { kind: "box", start: point, box: null }
      : { kind: "stroke", tool, radius: this.on.radius(), points: [point.map(rounded)] };
    this.on.change(this.#draft);
  }

  #move(event) {
    const before = this.#fingers.get(event.pointerId);
    if (!before) return this.hover(event);
    this.#fingers.set(event.pointerId, event);
    if (this.#pinch) return this.#pinched();
    if (this.#isMoving) return this.view.move(event.clientX - before.clientX, event.clientY - before.clientY);
    if (!this.#draft) return;
    const steps = event.getCoalescedEvents?.() ?? [];
    for (const step of steps.length ? steps : [event]) this.#extend(this.view.toFrame(step.clientX, step.clientY));
    this.hover(event);
    this.on.change(this.#draft);
  }

  #extend([x, y]) {
    const draft = this.#draft;
    if (draft.kind === "box") {
      const [left, top] = draft.start;
      draft.box = [Math.min(left, x), Math.min(top, y), Math.abs(x - left), Math.abs(y - top)].map(rounded);
      return;
    }
    const [across, down] = draft.points.at(-1);
    if (Math.hypot(x - across, y - down) * this.view.scale > TOO_NEAR) draft.points.push([rounded(x), rounded(y)]);
    if (draft.points.length < LONGEST) return;
    this.on.finish(draft);
    this.#draft = { ...draft, points: [draft.points.at(-1)] };
  }

  #up(event) {
    this.#fingers.delete(event.pointerId);
    if (this.#pinch) {
      this.#pinch = this.#fingers.size === 2 ? this.#span() : null;
      return;
    }
    this.#isMoving = false;
    const draft = this.#draft;
    this.#draft = null;
    if (!draft) return;
    const isKept = event.type === "pointerup" && (draft.points || (draft.box && Math.min(draft.box[2], draft.box[3]) * this.view.scale > 6));
    if (isKept) this.on.finish(draft);
    else this.on.change(null);
  }

  #span() {
    const [one, two] = [...this.#fingers.values()];
    return {
      x: (one.clientX + two.clientX) / 2, y: (one.clientY + two.clientY) / 2,
      wide: Math.max(10, Math.hypot(one.clientX - two.clientX, one.clientY - two.clientY)),
    };
  }

  #pinched() {
    const [before, now] = [this.#pinch, this.#span()];
    this.view.zoom(now.wide / before.wide, now.x, now.y);
    this.view.move(now.x - before.x, now.y - before.y);
    this.#pinch = now;
  }
}

const rounded = (value) => Math.round(value * 100) / 100;
