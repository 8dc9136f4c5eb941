// Joins the page's parts: what is shown, what buttons and keys do.

import { Client, pause } from "./client.js";
import { listen } from "./keys.js";
import { Pictures } from "./pictures.js";
import { Pointer } from "./pointer.js";
import { Strip } from "./strip.js";
import { View } from "./view.js";

const $ = (id) => document.getElementById(id);
const [PLAYED, SMALLEST, LARGEST] = [12, 1, 120]; // frames a second; radii of brushes, pixels of the screen at fit
const client = new Client();
let pictures, view, strip, pointer;
let names = [];
let place = 0;
let tool = "box";
let isPlaying = false;
let lastNotice = null;
let isLackingRead = false;
const sent = []; // drawings, until the pictures show them

await client.start();
begin();

function begin() {
  const { title, size } = client.about;
  names = client.about.names.map((name) => name.replace(/^0+(?=\d)/, ""));
  $("title").textContent = document.title = title;
  pictures = new Pictures(size);
  view = new View($("canvas"), size);
  strip = new Strip($("strip"), names, size, pictures, (chosen) => show(chosen));
  pointer = new Pointer($("canvas"), view, {
    tool: () => tool, radius, mayDraw, change: showDrafts,
    finish: (draft) => {
      const { start, ...drawing } = draft;
      client.draw({ ...drawing, place });
      showDrafts();
    },
  });
  client.addEventListener("state", () => showState());
  client.addEventListener("drawn", ({ detail }) => {
    sent.push({ ...detail.drawing, version: detail.version });
    show(place);
  });
  client.addEventListener("refused", ({ detail }) => notice("bad", detail));
  client.addEventListener("offline", showOffline);
  addEventListener("beforeunload", (event) => client.queue.length && client.isOffline && event.preventDefault());
  lastNotice = client.state.notice[0];
  restore();
  wire();
  chooseTool(tool);
  showState();
  show(place);
}

// What this tab looks at; the work itself is kept by the editor.
function restore() {
  const kept = JSON.parse(sessionStorage.getItem("looks") || "{}");
  const told = Object.keys(client.state.boxes).map(Number);
  place = Math.min(names.length - 1, kept.place ?? told[0] ?? 0);
  $("size").value = kept.size ?? 45;
  $("opacity").value = kept.opacity ?? 45;
  tool = kept.tool ?? (client.state.frames.some(([, , mask]) => mask) ? "animal" : "box");
}

function keep() {
  sessionStorage.setItem("looks", JSON.stringify({ place, tool, size: $("size").value, opacity: $("opacity").value }));
}

async function show(chosen) {
  const isNew = chosen !== place;
  place = Math.max(0, Math.min(names.length - 1, chosen));
  if (isNew) keep();
  strip.show(client.state, place);
  $("frame-is").textContent = names[place];
  showBadge();
  const [version, marks, mask] = client.state.frames[place];
  const wanted = place;
  try {
    const [frame, layers] = await Promise.all([
      pictures.frame(place), pictures.layers(place, version, mask !== "", marks === "strokes"),
    ]);
    if (wanted !== place || layers.version < client.state.frames[place][0]) return;
    Object.assign(view, { frame, layers, box: client.state.boxes[place] ?? null });
    for (let i = sent.length - 1; i >= 0; i--) if (sent[i].place !== place || sent[i].version <= version) sent.splice(i, 1);
    showDrafts(pointer.draft);
    document.body.dataset.version = client.state.version; // of the state that is on the screen
  } catch { /* the connection is lost, which is told elsewhere; or the mask changed meanwhile */ }
}

function showDrafts(draft) {
  pointer.draft = draft;
  const waiting = [...sent, ...client.queue].filter((drawing) => drawing.place === place);
  view.drafts = draft && (draft.points || draft.box) ? [...waiting, draft] : waiting;
  showOffline();
  document.body.dataset.waiting = sent.length + client.queue.length;
  view.draw();
}

function showState() {
  const { state } = client;
  const isBusy = state.job !== null;
  $("undo").disabled = isBusy || !state.undo;
  $("redo").disabled = isBusy || !state.redo;
  $("undo").title = state.undo ? `Undo: ${state.undo} (ctrl+z)` : "Nothing to undo";
  $("redo").title = state.redo ? `Redo: ${state.redo} (ctrl+shift+z)` : "Nothing to redo";
  for (const id of ["track", "onwards", "save", "done", "fix", "clear"]) $(id).disabled = isBusy;
  $("saved").textContent = state.saved ? "saved" : "not saved";
  $("saved").classList.toggle("bad", !state.saved);
  $("lacking").hidden = !state.lacking || isLackingRead;
  $("lacking-text").textContent = state.lacking;
  $("job").hidden = !isBusy;
  if (isBusy) showJob(state.job);
  const [number, kind, text] = state.notice;
  if (number !== lastNotice) {
    lastNotice = number;
    notice(kind, text);
  }
  show(place);
}

function showJob({ done, share, total, left, stopping }) {
  $("job-bar").value = share;
  const rest = left === null ? "" : left < 90 ? `, ${Math.ceil(left)} s left` : `, ${Math.ceil(left / 60)} min left`;
  $("job-text").textContent = stopping ? "Stopping after this stretch" : `Following: ${done} of ${total} masks${rest}`;
  $("cancel").disabled = stopping;
}

function showBadge() {
  const [, marks, mask] = client.state.frames[place];
  const said = [`frame ${names[place]}`];
  if (!mask) said.push("no mask yet");
  if (mask === "empty") said.push("no animal in the mask");
  if (marks === "true") said.push("true mask");
  $("badge").replaceChildren(...said.map((text) => Object.assign(document.createElement("span"), { textContent: text })));
  $("fix").setAttribute("aria-pressed", marks === "true");
}

function showOffline() {
  $("offline").hidden = !client.isOffline;
  const waiting = client.queue.length;
  $("offline").textContent = "The editor does not answer: it has ended, or the connection is lost. " +
    (waiting ? `${waiting} ${waiting > 1 ? "drawings wait" : "drawing waits"} here until it is back.` : "");
}

let hiding = 0;
function notice(kind, text) {
  clearTimeout(hiding);
  const [said, command] = kind === "saved" ? text.split(" Next: ") : [text];
  $("notice").className = `message ${kind}`;
  $("notice").hidden = !text;
  $("notice-text").textContent = command ? `${said} Next:` : said;
  $("notice-code").hidden = $("notice-copy").hidden = !command;
  $("notice-code").textContent = command ?? "";
  if (kind !== "saved") hiding = setTimeout(() => ($("notice").hidden = true), kind === "bad" ? 15000 : 6000);
}

function mayDraw() {
  if (client.state.job) notice("bad", "The animal is being followed; wait for it, or cancel it, then draw.");
  return !client.state.job && !isPlaying;
}

// Radius in pixels of the frame: the slider's in pixels of the whole frame on the screen, finer at its lower end.
function radius() {
  const share = $("size").value / 100;
  return Math.max(0.5, (SMALLEST + (LARGEST - SMALLEST) * share ** 2) * Math.max(view.width, view.height) / 1280 / 2);
}

function chooseTool(chosen) {
  tool = chosen;
  for (const button of document.querySelectorAll("[data-tool]")) {
    button.setAttribute("aria-checked", button.dataset.tool === tool);
    button.tabIndex = button.dataset.tool === tool ? 0 : -1;
  }
  $("canvas").style.cursor = tool === "hand" ? "grab" : tool === "box" ? "crosshair" : "none";
  showOptions();
}

function showOptions() {
  view.opacity = $("opacity").value / 100;
  $("opacity-is").textContent = `${$("opacity").value} %`;
  $("size-is").textContent = `${Math.round(2 * radius())} px`;
  pointer.hover(pointer.last ?? null);
  keep();
}

async function decide(kind, more) {
  const { ok, look } = await client.decide(kind, more);
  if (ok && look !== undefined && look !== null) show(look);
  return ok;
}

async function track(first) {
  stop();
  await decide("track", { place: first });
}

async function done() {
  await client.flush();
  if (!client.state.saved) {
    const box = $("done-box");
    box.returnValue = "back";
    box.showModal();
    await new Promise((closed) => box.addEventListener("close", closed, { once: true }));
    if (!["save", "end"].includes(box.returnValue)) return;
    if (box.returnValue === "save" && !(await decide("save"))) return;
  }
  const saved = client.state.saved;
  const [, kind, text] = client.state.notice;
  if (!(await decide("done"))) return;
  $("ended").hidden = false;
  if (saved && kind === "saved") $("ended-text").textContent = text;
}

async function play() {
  if (isPlaying) return stop();
  isPlaying = true;
  $("play-shape").setAttribute("d", "M7 5h4v14H7zM13 5h4v14h-4z");
  while (isPlaying) {
    const began = performance.now();
    const next = (place + 1) % names.length;
    const [version, marks, mask] = client.state.frames[next];
    await Promise.all([pictures.frame(next), pictures.layers(next, version, mask !== "", marks === "strokes")]).catch(() => stop());
    await pause(Math.max(0, 1000 / PLAYED - (performance.now() - began)));
    if (isPlaying) await show(next);
  }
}

function stop() {
  isPlaying = false;
  $("play-shape").setAttribute("d", "M8 5v14l11-7z");
}

// The next frame in a direction that carries a box or marks.
function told(way) {
  const { frames, boxes } = client.state;
  for (let at = place + way; at >= 0 && at < names.length; at += way) if (frames[at][1] || boxes[at]) return at;
  return place;
}

function resize(way) {
  $("size").value = Number($("size").value) + 5 * way;
  showOptions();
}

function go(chosen) {
  stop();
  show(chosen);
}

function wire() {
  const actions = {
    undo: () => decide("undo"), redo: () => decide("redo"), track: () => track(null), onwards: () => track(place),
    save: () => decide("save"), done, cancel: () => decide("cancel"), help: () => $("help-box").showModal(),
    fix: () => decide("fix", { place }), clear: () => decide("clear", { place }), before: () => go(place - 1),
    after: () => go(place + 1), play, fit: () => view.fit(), closer: () => view.zoom(1.5), farther: () => view.zoom(1 / 1.5),
    "lacking-close": () => ($("lacking").hidden = isLackingRead = true),
    "notice-close": () => ($("notice").hidden = true),
    "notice-copy": () => navigator.clipboard.writeText($("notice-code").textContent),
  };
  for (const [id, action] of Object.entries(actions)) $(id).addEventListener("click", action);
  for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => chooseTool(button.dataset.tool));
  for (const id of ["size", "opacity"]) $(id).addEventListener("input", showOptions);
  addEventListener("click", (event) => event.detail && event.target.closest("button")?.blur()); // keys stay the page's
  listen({
    actions, chooseTool, resize, cancel: () => pointer.cancel(), step: (count) => go(place + count),
    first: () => go(0), last: () => go(names.length - 1), told: (way) => go(told(way)),
    press: (id) => $(id).disabled || actions[id](),
  });
}
