// Gives the renderer the Gaussians of a moment, with the colours that an eye sees.
import * as THREE from "three";
import { harmonics } from "./harmonics.js";

export class Moments {
  constructor(clouds) {
    this.clouds = clouds;
    this.places = clouds.flatMap((cloud, c) => Array.from({ length: cloud.moments }, (_, index) => [c, index]));
    this.most = Math.max(...clouds.map(cloud => cloud.count));
    this.turning = clouds.some(cloud => cloud.frame !== "rgb");  // colours change with the view
    for (const { tracks } of clouds)
      for (const [name, track] of Object.entries(tracks)) if (name !== "means") track.values = tabled(name, track);
  }

  // Writes a moment into splats ({setSplat}) as seen from an eye [3].
  fill(splats, moment, eye) {
    const [c, index] = this.places[moment], { count, frame, tracks } = this.clouds[c];
    const { means, quats, scales, opacities, colors } = tracks;
    const start = track => Math.min(index, track.moments - 1) * track.components * count;
    const at = [means, quats, scales, opacities, colors].map(start);
    const center = new THREE.Vector3(), scale = new THREE.Vector3(), quat = new THREE.Quaternion();
    const color = new THREE.Color();
    const place = (k, i) => means.low[k] + means.codes[at[0] + k * count + i] * means.step[k];
    const value = (track, first, k, i) => track.values[k][track.codes[first + k * count + i]];
    const coefficients = new Float32Array(colors.components), rgb = new Float32Array(3);
    for (let i = 0; i < count; i++) {
      center.set(place(0, i), place(1, i), place(2, i));
      scale.set(value(scales, at[2], 0, i), value(scales, at[2], 1, i), value(scales, at[2], 2, i));
      const [w, x, y, z] = [0, 1, 2, 3].map(k => value(quats, at[1], k, i));
      quat.set(x, y, z, w).normalize();
      for (let k = 0; k < coefficients.length; k++) coefficients[k] = value(colors, at[4], k, i);
      if (frame === "rgb") rgb.set(coefficients);
      else harmonics(coefficients, direction.copy(center).sub(eye).normalize(), frame === "own" ? quat : null, rgb);
      color.r = rgb[0]; color.g = rgb[1]; color.b = rgb[2];
      splats.setSplat(i, center, scale, quat, value(opacities, at[3], 0, i), color);
    }
    for (let i = count; i < this.most; i++) splats.setSplat(i, NOWHERE, ONE, UNTURNED, 0, BLACK);
  }
}

// Codes of eight bits have 256 values: each is computed once.
function tabled(name, { low, step }) {
  return low.map((from, k) => Float32Array.from({ length: 256 }, (_, code) => {
    const value = from + code * step[k];
    return name === "scales" ? Math.exp(value) : value;
  }));
}

const direction = new THREE.Vector3(), NOWHERE = new THREE.Vector3(), ONE = new THREE.Vector3(1, 1, 1);
const UNTURNED = new THREE.Quaternion(), BLACK = new THREE.Color(0, 0, 0);
