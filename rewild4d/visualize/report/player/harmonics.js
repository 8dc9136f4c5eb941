// View-dependent colour: real spherical harmonics in the order and sign of 3D Gaussian Splatting, as in
// rewild4d/harmonics.py.
import * as THREE from "three";

const C0 = 0.28209479177387814, C1 = 0.4886025119029199;
const C2 = [1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396];
const C3 = [-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
  1.445305721320277, -0.5900435899266435];
const back = new THREE.Quaternion(), values = new Float32Array(16);

// coefficients: 3 k values, coefficient by coefficient; direction: unit, from the eye; quat: of the frame that they
// stand in, null for the world; rgb: what is written.
export function harmonics(coefficients, direction, quat, rgb) {
  if (quat) direction.applyQuaternion(back.copy(quat).conjugate());
  basis(direction.x, direction.y, direction.z, coefficients.length / 3);
  for (let channel = 0; channel < 3; channel++) {
    let sum = 0.5;
    for (let k = 0, c = channel; c < coefficients.length; k++, c += 3) sum += values[k] * coefficients[c];
    rgb[channel] = Math.max(0, sum);
  }
}

function basis(x, y, z, count) {
  values[0] = C0;
  if (count < 4) return;
  values[1] = -C1 * y; values[2] = C1 * z; values[3] = -C1 * x;
  if (count < 9) return;
  const xx = x * x, yy = y * y, zz = z * z;
  values[4] = C2[0] * x * y; values[5] = C2[1] * y * z; values[6] = C2[2] * (2 * zz - xx - yy);
  values[7] = C2[3] * x * z; values[8] = C2[4] * (xx - yy);
  if (count < 16) return;
  values[9] = C3[0] * y * (3 * xx - yy); values[10] = C3[1] * x * y * z; values[11] = C3[2] * y * (4 * zz - xx - yy);
  values[12] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy); values[13] = C3[4] * x * (4 * zz - xx - yy);
  values[14] = C3[5] * z * (xx - yy); values[15] = C3[6] * x * (xx - 3 * yy);
}
