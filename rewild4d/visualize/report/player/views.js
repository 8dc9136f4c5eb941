// Where the picture is seen from: the film's camera at a moment, or a camera that goes around the animal.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const TURN_SECONDS = 12, FIELD_OF_VIEW = 25;
const AXES = new THREE.Matrix4().makeScale(1, -1, -1);  // from OpenCV's: y down, z ahead

export class Views {
  constructor(facts, canvas, changed) {
    this.facts = facts;
    this.centers = facts.centers.map(center => new THREE.Vector3(...center));
    this.film = new THREE.PerspectiveCamera();
    this.free = new THREE.PerspectiveCamera(FIELD_OF_VIEW, facts.width / facts.height, 0.01, 100);
    this.free.up.set(...facts.up);
    this.controls = new OrbitControls(this.free, canvas);
    this.controls.enableDamping = true;
    this.controls.autoRotateSpeed = 60 / TURN_SECONDS;
    this.controls.minDistance = 0.2 * facts.radius;
    this.controls.maxDistance = 40 * facts.radius;
    this.moment = 0;
    this.aside();
    this.filming = facts.cameras[0] !== null;
    this.controls.addEventListener("start", () => { if (this.filming) this.leave(); changed(); });
    this.controls.addEventListener("change", changed);
  }

  get camera() { return this.filming ? this.film : this.free; }

  // Stands where the whole animal is seen from the film's side of it.
  aside() {
    // In a wide picture an animal, longer than it is high, may come nearer.
    const { radius, width, height } = this.facts, center = this.centers[this.moment];
    const distance = radius / Math.sin(FIELD_OF_VIEW * Math.PI / 360) * (width > height ? 0.85 : height / width);
    this.controls.target.copy(center);
    this.free.position.copy(center).addScaledVector(new THREE.Vector3(...this.facts.from), distance);
    this.free.fov = FIELD_OF_VIEW;
    this.#lens();
  }

  // Goes on freely from where the film's camera is.
  leave() {
    const camera = this.facts.cameras[this.moment];
    this.filming = false;
    if (!camera) return this.aside();
    this.controls.target.copy(this.centers[this.moment]);
    this.free.position.copy(this.film.position);
    this.free.fov = 2 * Math.atan(camera.height / 2 / camera.fy) * 180 / Math.PI;
    this.#lens();
  }

  show(moment) {
    const step = this.centers[moment].clone().sub(this.centers[this.moment]);
    this.moment = moment;
    this.controls.target.add(step);  // the free camera goes along with the animal
    this.free.position.add(step);
    const camera = this.facts.cameras[moment];
    if (!camera) { if (this.filming) this.leave(); return; }
    const near = 0.01, far = 1000 * Math.max(1, this.facts.radius), { fx, fy, cx, cy, width, height } = camera;
    this.film.matrix.fromArray(camera.world_to_camera).transpose().premultiply(AXES).invert();
    this.film.matrix.decompose(this.film.position, this.film.quaternion, this.film.scale);
    this.film.updateMatrixWorld();
    this.film.projectionMatrix.makePerspective(
      -cx / fx * near, (width - cx) / fx * near, cy / fy * near, (cy - height) / fy * near, near, far);
    this.film.projectionMatrixInverse.copy(this.film.projectionMatrix).invert();
  }

  // Moves on by some seconds.
  update(seconds) {
    if (!this.filming) this.controls.update(seconds);
  }

  turn(on) {
    if (on && this.filming) { this.filming = false; this.aside(); }
    this.controls.autoRotate = on;
  }

  #lens() {
    this.free.near = 0.01 * this.facts.radius;
    this.free.far = 1000 * this.facts.radius;
    this.free.updateProjectionMatrix();
    this.controls.update();
  }
}
