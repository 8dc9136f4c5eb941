// The page's player: Gaussians that move, and the film's frames beside them in step.
import * as THREE from "three";
import { ExtSplats, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { bytesOf, decode, inflate } from "./decode.js";
import { Moments } from "./splats.js";
import { Views } from "./views.js";

const $ = id => document.getElementById(id);
const MOST_PIXELS_A_POINT = 2;
const TEXTURE_WIDTH = 2048;  // of the renderer: it takes whole rows

class Player {
  constructor(facts, moments, canvas) {
    this.facts = facts;
    this.moments = moments;
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
    this.renderer.setClearColor(0xffffff, 1);
    this.scene = new THREE.Scene();
    // As rewild4d/rasterizer/CONVENTIONS.md says: what is added to a projected Gaussian, where it ends, order by depth.
    this.spark = new SparkRenderer({
      renderer: this.renderer, autoUpdate: false, preBlurAmount: facts.eps2d, blurAmount: 0, minAlpha: 1 / 255,
      maxStdDev: Math.sqrt(2 * Math.log(255)), sortRadial: false, accumExtSplats: true, maxPixelRadius: 4096,
      clipXY: 3, enableLod: false,
    });
    this.scene.add(this.spark);
    this.moment = 0;
    this.time = facts.times[0];
    this.speed = 1;
    this.playing = false;
    this.inSight = true;
    this.stale = true;
    this.shot = new THREE.PerspectiveCamera();
    this.views = new Views(facts, canvas, () => { this.stale = true; this.turned?.(); });
  }

  async open() {
    const rows = Math.ceil(this.moments.most / TEXTURE_WIDTH) * TEXTURE_WIDTH;
    const extArrays = [new Uint32Array(4 * rows), new Uint32Array(4 * rows)];
    this.splats = new ExtSplats({ extArrays, numSplats: this.moments.most });
    this.mesh = new SplatMesh({ splats: this.splats });
    await this.mesh.initialized;
    this.scene.add(this.mesh);
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    new IntersectionObserver(([entry]) => { this.inSight = entry.isIntersecting; }).observe(this.canvas);
    this.resize();
    await this.show(0);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MOST_PIXELS_A_POINT));
    this.renderer.setSize(width, height, false);
    this.views.free.aspect = width / height;
    this.views.free.updateProjectionMatrix();
    this.stale = true;
  }

  // Shows a moment; ends when its picture is there.
  async show(moment) {
    this.moment = moment;
    this.stale = true;
    while (this.stale || this.drawing) await (this.drawing ?? this.draw());
  }

  draw() {
    this.drawing = this.#draw().finally(() => { this.drawing = null; });
    return this.drawing;
  }

  async #draw() {
    this.stale = false;
    const moment = this.moment;
    this.views.show(moment);
    this.shot.copy(this.views.camera);  // which may move on before the picture is done
    if (moment !== this.written || this.moments.turning) {
      this.moments.fill(this.splats, moment, this.shot.position);
      this.written = moment;
      for (const texture of this.splats.textures) texture.needsUpdate = true;
      this.mesh.updateVersion();
    }
    await this.spark.update({ scene: this.scene, camera: this.shot });  // a picture waits for its order of depth
    this.renderer.render(this.scene, this.shot);
    this.drawn?.(moment);
  }

  tick(now) {
    const seconds = Math.min(0.25, (now - (this.now ?? now)) / 1000), { times, duration } = this.facts;
    this.now = now;
    if (!this.inSight) return;
    this.views.update(seconds);
    if (this.playing) {
      this.time = times[0] + (this.time - times[0] + seconds * this.speed) % (duration - times[0]);
      const moment = Math.max(0, times.findLastIndex(time => time <= this.time));
      if (moment !== this.moment && !this.drawing) return void this.show(moment);
    }
    if (this.stale && !this.drawing) this.draw();
  }

  seek(moment) {
    this.time = this.facts.times[moment];
    return this.show(moment);
  }
}

function connect(player) {
  const { facts } = player, slider = $("time"), film = $("film");
  const press = (id, on) => $(id).setAttribute("aria-pressed", on);
  const play = on => { player.playing = on; $("play").textContent = on ? "Pause" : "Play"; };
  let shown = -1;
  player.turned = () => {
    press("film-camera", player.views.filming);
    press("turntable", player.views.controls.autoRotate);
  };
  player.drawn = moment => {
    player.turned();
    if (moment === shown) return;
    shown = moment;
    if (player.playing) slider.value = moment;
    film.src = `data:image/jpeg;base64,${facts.film[moment]}`;
    $("clock").textContent = `${facts.times[moment].toFixed(2)} s, ${moment + 1} of ${facts.times.length}`;
  };
  slider.max = facts.times.length - 1;
  slider.addEventListener("input", () => { play(false); player.seek(Number(slider.value)); });
  $("play").addEventListener("click", () => play(!player.playing));
  $("speed").addEventListener("change", event => { player.speed = Number(event.target.value); });
  $("film-camera").disabled = facts.cameras.every(camera => camera === null);
  $("film-camera").addEventListener("click", () => {
    player.views.turn(false);
    player.views.filming = facts.cameras[player.moment] !== null;
    player.turned();
    player.show(player.moment);
  });
  $("turntable").addEventListener("click", () => {
    player.views.turn(!player.views.controls.autoRotate);
    player.turned();
    player.show(player.moment);
  });
  if (facts.times.length < 2) for (const id of ["play", "time", "speed"]) $(id).disabled = true;
  return play;
}

async function start() {
  const facts = JSON.parse($("scene").textContent), canvas = $("view");
  canvas.style.aspectRatio = $("film").style.aspectRatio = `${facts.width} / ${facts.height}`;
  $("panels").style.maxWidth = `min(72rem, ${130 * facts.width / facts.height}vh)`;  // the controls stay in sight
  $("film").src = `data:image/jpeg;base64,${facts.film[0]}`;
  const clouds = decode(await inflate(bytesOf($("splats").textContent)));
  const player = new Player(facts, new Moments(clouds), canvas);
  globalThis.rewild4d = { clouds, player };
  const play = connect(player);
  await player.open();
  const loop = now => { player.tick(now); requestAnimationFrame(loop); };
  requestAnimationFrame(loop);
  if (facts.times.length > 1 && !matchMedia("(prefers-reduced-motion: reduce)").matches) play(true);
  document.documentElement.dataset.player = "ready";
}

function fail(error) {
  const needs = "it needs WebGL 2 and WebAssembly";
  $("trouble").textContent = `The player does not run in this browser (${needs}): ${error.message}`;
  $("trouble").hidden = false;
  document.documentElement.dataset.player = "failed";
}

addEventListener("unhandledrejection", event => fail(event.reason));
start();
