// What keys do. Nothing while a dialog is open, and letters nothing while a slider has what is typed.

const TOOLS = { b: "box", a: "animal", s: "surroundings", e: "eraser", h: "hand" };

export function listen({ chooseTool, resize, cancel, step, first, last, told, press }) {
  const plain = {
    " ": () => press("play"), Home: first, End: last, ",": () => told(-1), ".": () => told(1),
    "[": () => resize(-1), "]": () => resize(1), p: () => press("track"), P: () => press("onwards"), f: () => press("fix"),
    Delete: () => press("clear"), Backspace: () => press("clear"), "?": () => press("help"), Escape: cancel,
    0: () => press("fit"), "+": () => press("closer"), "=": () => press("closer"), "-": () => press("farther"),
  };
  addEventListener("keydown", (event) => {
    if (event.isComposing || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.key === " " && event.target instanceof HTMLButtonElement) return; // it presses the button
    const isSlider = event.target instanceof HTMLInputElement;
    const key = event.key.length === 1 && (event.ctrlKey || event.metaKey) ? event.key.toLowerCase() : event.key;
    const action = event.ctrlKey || event.metaKey ? withControl(key, event.shiftKey) : arrow(key, event.shiftKey, isSlider);
    if (!action) return;
    event.preventDefault();
    action();
  });

  function withControl(key, isShifted) {
    return { z: () => press(isShifted ? "redo" : "undo"), y: () => press("redo"), s: () => press("save") }[key];
  }

  function arrow(key, isShifted, isSlider) {
    const way = { ArrowLeft: -1, ArrowRight: 1 }[key];
    if (way) return isSlider ? null : () => step(way * (isShifted ? 10 : 1));
    const tool = TOOLS[key];
    return tool ? () => chooseTool(tool) : plain[key];
  }
}
