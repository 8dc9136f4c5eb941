// Talks with the editor: its state is the only one, and what is drawn waits here until the editor has it.

const QUEUE = `queue:${location.pathname}`;

export class Client extends EventTarget {
  state = null;
  queue = JSON.parse(sessionStorage.getItem(QUEUE) || "[]"); // kept over a reload
  isOffline = false;
  #sending = null;

  async start() {
    this.about = await this.#fetch("about");
    this.#take(await this.#fetch("state"));
    this.flush();
    this.#poll();
  }

  // Hands a drawing over; it is sent again until the editor has answered.
  draw(drawing) {
    this.queue.push({ ...drawing, id: crypto.randomUUID() });
    this.#keep();
    this.flush();
  }

  // Asks for what only holds for the state that is shown; returns the frame to look at, if any.
  async decide(kind, more = {}) {
    await this.flush();
    const needsVersion = !["save", "cancel"].includes(kind);
    const { status, answer } = await this.#post({ kind, ...(needsVersion && { version: this.state.version }), ...more });
    if (status !== 200) {
      this.#say("refused", answer.error);
      return { ok: false };
    }
    return { ok: true, look: answer.look };
  }

  // Sends what waits, in its order.
  flush() {
    this.#sending ??= this.#send().finally(() => (this.#sending = null));
    return this.#sending;
  }

  async #send() {
    while (this.queue.length) {
      const drawing = this.queue[0];
      const { status, answer } = await this.#post(drawing);
      if (status === 423) { // the animal is being followed
        await pause(400);
        continue;
      }
      this.queue.shift();
      this.#keep();
      this.#say("drawn", { drawing, version: this.state.frames[drawing.place]?.[0] ?? 0 });
      if (status !== 200) this.#say("refused", answer.error);
    }
  }

  async #post(request) {
    for (;;) {
      try {
        const reply = await fetch("do", {
          method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(request),
        });
        const answer = await reply.json();
        this.#setOffline(false);
        if (answer.state) this.#take(answer.state);
        return { status: reply.status, answer };
      } catch {
        this.#setOffline(true);
        if (request.kind === "done") return { status: 200, answer: {} };
        await pause(1000);
      }
    }
  }

  async #poll() {
    for (;;) {
      await pause(this.state.job ? 250 : 700);
      try {
        const state = await this.#fetch(`state?seen=${this.state.version}`);
        this.#setOffline(false);
        if (state.frames) this.#take(state);
      } catch {
        this.#setOffline(true);
      }
    }
  }

  async #fetch(path) {
    const reply = await fetch(path, { cache: "no-store" });
    if (!reply.ok) throw new Error(`${path}: ${reply.status}`);
    return reply.json();
  }

  #take(state) {
    if (this.state && state.version < this.state.version) return; // an older answer came later
    this.state = state;
    this.#say("state", state);
  }

  #keep() {
    try {
      sessionStorage.setItem(QUEUE, JSON.stringify(this.queue));
    } catch { /* no room: it waits in this page alone */ }
  }

  #setOffline(isOffline) {
    if (this.isOffline === isOffline) return;
    this.isOffline = isOffline;
    this.#say("offline", isOffline);
  }

  #say(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }
}

export const pause = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));
