"""The paper's formulas in float64 with plain loops, written from its text alone ("Progressive Optimization and
Objectives", equations of the encoding and of the geometric regularization)."""

import math

import numpy as np

Array = np.ndarray


def encoding(t: float, m: int, v: int, octaves: int) -> list[float]:
    """e = emb(t m) + v (concatenated); emb is the sinusoidal embedding with its input, as in D-3DGS."""
    tau = t * m
    return [tau, *(math.sin(2**k * tau) for k in range(octaves)), *(math.cos(2**k * tau) for k in range(octaves)), v]


def huber(x: float, delta: float) -> float:
    return x * x / 2 if abs(x) <= delta else delta * (abs(x) - delta / 2)


def total_variation(field: Array, delta: float = 0.05) -> float:
    """L_tv = 1/3 sum over d of E[H_delta(grad_d W)], W [J, R, R, R]."""
    joints, size = field.shape[:2]
    total = 0.0
    for axis in range(3):
        found = []
        for j in range(joints):
            for place in np.ndindex(size, size, size):
                ahead = list(place)
                ahead[axis] += 1
                if ahead[axis] < size:
                    found.append(huber(field[(j, *ahead)] - field[(j, *place)], delta))
        total += sum(found) / len(found)
    return total / 3


def compactness(points: Array, weights: Array, alpha: float = 2.0) -> float:
    """L_compact = 1/J sum over j of gamma_j (lambda_j1 + lambda_j2), of the two smallest eigenvalues."""
    count, joints = weights.shape
    mass = [sum(weights[i, j] for i in range(count)) for j in range(joints)]
    total = 0.0
    for j in range(joints):
        if mass[j] == 0:
            continue
        center = sum(weights[i, j] * points[i] for i in range(count)) / mass[j]
        spread = np.zeros((3, 3))
        for i in range(count):
            spread += weights[i, j] * np.outer(points[i] - center, points[i] - center) / mass[j]
        smallest, second, _ = sorted(np.linalg.eigvalsh(spread))
        total += math.exp(-alpha * mass[j] / max(mass)) * (smallest + second)
    return total / joints


def smoothness(normals: Array, cover: Array, epsilon: float = 1e-6) -> float:
    """L_smooth = sum over d in {x, y} of (sum_p w (1 - |N(p) . N(p + d)|)) / (sum_p w + eps), w = S(p) S(p + d);
    normals [3, h, w] of length 1."""
    height, width = cover.shape
    total = 0.0
    for down, right in ((0, 1), (1, 0)):
        above, below = 0.0, 0.0
        for y in range(height - down):
            for x in range(width - right):
                weight = cover[y, x] * cover[y + down, x + right]
                cosine = float(normals[:, y, x] @ normals[:, y + down, x + right])
                above += weight * (1 - abs(cosine))
                below += weight
        total += above / (below + epsilon)
    return total


def silhouette(rendered: Array, mask: Array) -> float:
    """L_sil = BCE + Dice: the mean of the binary cross entropy over the pixels, and 1 - 2 |A B| / (|A| + |B|), smoothed
    by 1."""
    cross, both, sizes = 0.0, 0.0, 0.0
    for a, b in zip(rendered.flat, mask.flat, strict=True):
        a = float(a)
        cross -= b * math.log(a) + (1 - b) * math.log(1 - a)
        both += a * b
        sizes += a + b
    return cross / rendered.size + 1 - (2 * both + 1) / (sizes + 1)


def colour(rendered: Array, image: Array, share: float = 0.2) -> float:
    """L_rgb = (1 - share) L1 + share (1 - SSIM), means over pixels and channels, [3, h, w]."""
    l1 = sum(abs(a - b) for a, b in zip(rendered.flat, image.flat, strict=True)) / image.size
    return (1 - share) * l1 + share * (1 - ssim(rendered, image))


def ssim(a: Array, b: Array) -> float:
    """Mean SSIM under a Gaussian window of 11 pixels, sigma 1.5, zeros beyond the border (Wang et al. 2004)."""
    weights = [math.exp(-(k**2) / (2 * 1.5**2)) for k in range(-5, 6)]
    weights = [weight / sum(weights) for weight in weights]
    channels, height, width = a.shape
    c1, c2, total = 0.01**2, 0.03**2, 0.0
    for c in range(channels):
        for y in range(height):
            for x in range(width):
                sums = np.zeros(5)
                for i in range(-5, 6):
                    for j in range(-5, 6):
                        if 0 <= y + i < height and 0 <= x + j < width:
                            p, q = a[c, y + i, x + j], b[c, y + i, x + j]
                            sums += weights[i + 5] * weights[j + 5] * np.array((p, q, p * p, q * q, p * q))
                mean_a, mean_b, aa, bb, ab = sums
                top = (2 * mean_a * mean_b + c1) * (2 * (ab - mean_a * mean_b) + c2)
                total += top / ((mean_a**2 + mean_b**2 + c1) * (aa - mean_a**2 + bb - mean_b**2 + c2))
    return total / a.size


def blend_weight(iteration: int) -> float:
    """Weight of the prior's poses: from 1 to 0 over 7K iterations."""
    return max(0.0, 1 - iteration / 7000)
