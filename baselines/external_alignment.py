"""Placing what others made: by 3D-Fauna's camera, or by the best input-view PSNR over azimuth, elevation and scale."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from rewild4d.contracts import Log
from rewild4d.errors import UserError
from rewild4d.harmonics import seen_colors
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import look_at, similarity, transform_splats
from rewild4d.types import Camera, Frame, Splats

UPS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "y": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "-y": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "z": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
}
"""The axis that points up, and the one in which azimuth 0 stands."""
AZIMUTHS, ELEVATIONS, SCALES = 24, (-20.0, 0.0, 20.0, 45.0), (0.85, 1.0, 1.18)
"""The coarse search; scales are relative to the one at which the silhouettes are equally large."""
SIZE, FRAMES, GAUSSIANS = 96, 6, 4000
"""Of the search: longest image side in pixels, input frames, Gaussians."""
REFINED, STEPS = 3, 120
"""Best starts that are refined, and how many renderings of all frames each may take."""
FAUNA_FOV = 25.0
"""Degrees, of 3D-Fauna's camera."""


@dataclass(frozen=True)
class Placement:
    """Where another program's object stands in the world.

    Attributes:
        matrix: object -> world similarity, float64, [4, 4].
        azimuth: from which the first camera sees it, degrees.
        elevation: degrees.
        scale: world units per unit of the object.
        psnr: mean over the frames of the search, dB, on white.
    """

    matrix: Tensor
    azimuth: float
    elevation: float
    scale: float
    psnr: float


@dataclass(frozen=True)
class Shot:
    """What a candidate is compared with: image on white [3, h, w], matte [1, h, w], camera."""

    image: Tensor
    mask: Tensor
    camera: Camera


def place_by_search(
    moments: Sequence[Splats], frames: Sequence[tuple[Frame, Camera]], depth: float, up: str, elevation: float, log: Log
) -> Placement:
    """Rotate, scale and shift an object so that the input views show what the video shows: an upper bound (METHOD 7).

    A coarse grid over azimuth and elevation, each at the scale and place at which its silhouette covers the animal's,
    is refined from the best few starts. The depth of its centre stays where the prior has it, unless the camera moves
    and can tell.

    Args:
        moments: Gaussians for each frame, in the object's own frame of reference.
        frames: the input frames with their cameras.
        depth: of the animal's centre before the first camera, world units.
        up: the object's axis that points up, one of `UPS`.
        elevation: one more start, degrees.
        log: progress.

    Raises:
        UserError: an object without an extent.
    """
    picked = sorted({round(i) for i in np.linspace(0, len(frames) - 1, min(FRAMES, len(frames)))})
    shots = [_reduced(*frames[index]) for index in picked]
    search = _Search([_thinned(moments[index]) for index in picked], shots, depth, up, frames[0][1])
    total = AZIMUTHS * len({*ELEVATIONS, elevation}) * len(SCALES) + REFINED
    found: list[tuple[float, np.ndarray]] = []
    for height in sorted({*ELEVATIONS, elevation}):
        for index in range(AZIMUTHS):
            start = search.start(360.0 * index / AZIMUTHS, height)
            for scale in SCALES:
                candidate = start + np.array([0, 0, math.log(scale), 0, 0, 0])
                found.append((search.psnr(candidate), candidate))
                log(len(found), total, {"psnr": found[-1][0]})
    found.sort(key=lambda pair: -pair[0])
    refined = [search.refined(candidate) for _, candidate in found[:REFINED]]
    best = max([*refined, found[0]], key=lambda pair: pair[0])
    log(total, total, {"psnr": best[0]})
    return search.placement(best[1], best[0])


class _Search:
    """Candidates are vectors: azimuth and elevation in degrees, log of the scale, shift of the centre's pixel in image
    sides, log of the depth relative to the prior's."""

    def __init__(self, moments: Sequence[Splats], shots: Sequence[Shot], depth: float, up: str, camera: Camera) -> None:
        self.moments, self.shots, self.depth, self.camera = moments, shots, depth, camera
        self.up, self.ahead = (torch.tensor(axis, dtype=torch.float64) for axis in UPS[up])
        first = moments[0]
        self.center = first.means.double().median(0).values
        self.spread = float((first.means.double() - self.center).norm(dim=1).quantile(0.9))
        if not self.spread > 0:
            raise UserError(f"external: expected an object with an extent, got {len(first)} Gaussians in one place.")
        centers = torch.stack([shot.camera.center for shot in shots])
        self.moves = float((centers - centers[0]).norm(dim=1).max()) > 0.05 * depth

    def start(self, azimuth: float, elevation: float) -> np.ndarray:
        """Return the candidate whose first silhouette has the area and the centre of the animal's."""
        shot = self.shots[0]
        radius = math.sqrt(float(shot.mask.sum()) / math.pi) / float(shot.camera.intrinsics[0, 0])
        candidate = np.array([azimuth, elevation, math.log(radius * self.depth / self.spread), 0.0, 0.0, 0.0])
        for _ in range(3):
            alpha = self._render(0, self.matrix(candidate))[1]
            if float(alpha.sum()) < 1:
                return candidate
            candidate[2] += 0.5 * math.log(float(shot.mask.sum()) / float(alpha.sum()))
            candidate[3:5] += (_middle(shot.mask) - _middle(alpha)).numpy()
        return candidate

    def psnr(self, candidate: np.ndarray) -> float:
        """Return the mean over the frames, dB."""
        matrix = self.matrix(candidate)
        errors = []
        for index, shot in enumerate(self.shots):
            color, alpha = self._render(index, matrix)
            errors.append(float((color + 1 - alpha - shot.image).square().mean()))
        return float(np.mean([-10 * math.log10(max(error, 1e-10)) for error in errors]))

    def refined(self, candidate: np.ndarray) -> tuple[float, np.ndarray]:
        """Search near a candidate by the simplex method."""
        free = [0, 1, 2, 3, 4, *([5] if self.moves else [])]
        steps = np.array([8.0, 8.0, 0.08, 0.03, 0.03, 0.08])

        def full(values: np.ndarray) -> np.ndarray:
            whole = candidate.copy()
            whole[free] += values * steps[free]
            return whole

        simplex = np.concatenate((np.zeros((1, len(free))), np.eye(len(free))))
        options = {"initial_simplex": simplex, "maxfev": STEPS, "xatol": 1e-3, "fatol": 1e-3}
        found = minimize(lambda v: -self.psnr(full(v)), simplex[0], method="Nelder-Mead", options=options)
        return -float(found.fun), full(found.x)

    def matrix(self, candidate: np.ndarray) -> Tensor:
        """Return the transform from object to world, [4, 4]."""
        azimuth, elevation, scale, column, row, deeper = (float(value) for value in candidate)
        angle, height = math.radians(azimuth), math.radians(max(-89.0, min(89.0, elevation)))
        side = torch.linalg.cross(self.up, self.ahead)
        level = math.cos(angle) * self.ahead + math.sin(angle) * side
        eye = math.cos(height) * level + math.sin(height) * self.up
        turn = look_at(eye, torch.zeros(3, dtype=torch.float64), self.up)[:3, :3]
        middle = _middle(self.shots[0].mask).numpy() + (column, row)
        return self._in_world(turn, math.exp(scale), middle, self.depth * math.exp(deeper))

    def _in_world(self, turn: Tensor, scale: float, middle: np.ndarray, depth: float) -> Tensor:
        """Put the object's centre at a place of the first image, given in image sides, at a depth."""
        size = max(self.camera.width, self.camera.height)
        pixel = torch.tensor((middle[0] * size, middle[1] * size, 1.0), dtype=torch.float64)
        ray = torch.linalg.inv(self.camera.intrinsics.double()) @ pixel
        to_camera = similarity(scale, turn, depth * ray - scale * turn @ self.center)
        return torch.linalg.inv(self.camera.world_to_camera.double()) @ to_camera

    def placement(self, candidate: np.ndarray, psnr: float) -> Placement:
        return Placement(
            self.matrix(candidate), float(candidate[0]) % 360, float(candidate[1]), math.exp(candidate[2]), psnr
        )

    def _render(self, index: int, matrix: Tensor) -> tuple[Tensor, Tensor]:
        return _render(transform_splats(self.moments[index], matrix), self.shots[index].camera)


def place_fauna(pose: Path, box: tuple[float, float, float], camera: Camera, depth: float) -> Tensor:
    """Object -> world similarity of a mesh that 3D-Fauna predicted from a crop of a frame (FORMATS 4.7, 4.8).

    Its camera has a field of view and a distance of its own, so the object is put on the ray of the crop's view, as far
    as the prior has the animal, with the size that it has in the crop.

    Args:
        pose: the file `*_pose.txt`: twelve numbers.
        box: left, top and side of the crop in pixels of the frame.
        camera: of the frame.
        depth: of the animal's centre, world units.

    Raises:
        UserError: the file is missing or holds something else, or its mesh does not lie before its camera.
    """
    try:
        numbers = torch.tensor([float(word) for word in pose.read_text(encoding="utf-8").split()], dtype=torch.float64)
    except OSError as error:
        raise UserError(f"{pose}: expected 3D-Fauna's camera, but: {error.strerror}.") from error
    except ValueError as error:
        raise UserError(f"{pose}: expected twelve numbers, but: {error}.") from error
    if len(numbers) != 12 or not torch.isfinite(numbers).all():
        raise UserError(f"{pose}: expected twelve finite numbers, got {len(numbers)}.")
    to_opencv = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))
    turn = to_opencv @ numbers[:9].view(3, 3).T
    place = to_opencv @ (numbers[9:] + torch.tensor((0.0, 0.0, -10.0), dtype=torch.float64))
    if not float(place[2]) > 0:
        raise UserError(f"{pose}: expected a mesh before 3D-Fauna's camera, got one at depth {float(place[2]):g}.")
    left, top, side = box
    focal = side / 2 / math.tan(math.radians(FAUNA_FOV / 2))
    k = camera.intrinsics.double()
    seen = place / place[2]
    pixel = torch.stack((left + side / 2 + focal * seen[0], top + side / 2 + focal * seen[1], torch.ones(()).double()))
    ray = torch.linalg.inv(k) @ pixel
    scale = depth * focal / (float(place[2]) * float(k[0, 0]))
    to_camera = similarity(scale, _between(seen, ray) @ turn, depth * ray)
    return torch.linalg.inv(camera.world_to_camera.double()) @ to_camera


def _between(start: Tensor, end: Tensor) -> Tensor:
    """Return the smallest rotation that turns one direction into another, [3, 3]; they are never opposite."""
    a, b = normalize(start, dim=0), normalize(end, dim=0)
    axis, cosine = torch.linalg.cross(a, b), a @ b
    zero = torch.zeros((), dtype=a.dtype)
    skew = torch.stack((zero, -axis[2], axis[1], axis[2], zero, -axis[0], -axis[1], axis[0], zero)).view(3, 3)
    return torch.eye(3, dtype=a.dtype) + skew + skew @ skew / (1 + cosine)


def _reduced(frame: Frame, camera: Camera) -> Shot:
    height, width = frame.mask.shape[1:]
    shrink = min(1.0, SIZE / max(height, width))
    shape = max(1, round(height * shrink)), max(1, round(width * shrink))
    image, mask = (interpolate(part[None], shape, mode="area")[0] for part in (frame.over(1.0), frame.mask))
    return Shot(image, mask, camera.resized(shape[1], shape[0]))


def _thinned(splats: Splats) -> Splats:
    """Return a fixed choice of the Gaussians, made larger so that they still close the surface."""
    if len(splats) <= GAUSSIANS:
        return splats
    keep = torch.randperm(len(splats), generator=torch.Generator().manual_seed(0))[:GAUSSIANS]
    names = ("means", "quats", "scales", "opacities", "colors")
    fewer = Splats(*(getattr(splats, name)[keep] for name in names))
    return replace(fewer, scales=fewer.scales * math.sqrt(len(splats) / GAUSSIANS))


def _middle(mask: Tensor) -> Tensor:
    """Centre of mass of a matte [1, h, w] in image sides (the longer one counts), column first, float64, [2]."""
    height, width = mask.shape[1:]
    weight = mask[0].double()
    total = weight.sum().clamp_min(1e-9)
    column = (weight.sum(0) @ (torch.arange(width).double() + 0.5)) / total
    row = (weight.sum(1) @ (torch.arange(height).double() + 0.5)) / total
    return torch.stack((column, row)) / max(height, width)


def _render(splats: Splats, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the premultiplied colour [3, h, w] and alpha [1, h, w]."""
    with torch.no_grad():
        color, alpha, _ = rasterize(
            splats.means, splats.quats, splats.scales, splats.opacities, seen_colors(splats, camera.center),
            camera.world_to_camera[None].float(), camera.intrinsics[None].float(), camera.width, camera.height,
        )  # fmt: skip
    return color[0], alpha[0]
