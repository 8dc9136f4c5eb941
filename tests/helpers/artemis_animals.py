"""Small Artemis animals on disk, whose every pixel and bone is known."""

from pathlib import Path

import numpy as np
import torch

from rewild4d.datasets.artemis.reader import ArtemisWriter
from rewild4d.transforms import look_at
from rewild4d.types import Camera

VIEWS, FRAMES, WIDTH, HEIGHT = 4, 3, 64, 36
DOT = torch.tensor((0.3, -0.2, 0.25), dtype=torch.float64)


def turned(seed: int) -> np.ndarray:
    """A random rotation, [3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def ring(views: int = VIEWS, world: np.ndarray | None = None, elevation: float = 0.5) -> list[Camera]:
    """Cameras around the origin, y up in a world that is then turned."""
    turn = torch.from_numpy(np.eye(3) if world is None else world)
    intrinsics = torch.tensor(((60.0, 0.0, 33.0), (0.0, 61.0, 17.5), (0.0, 0.0, 1.0)), dtype=torch.float64)
    cameras = []
    for angle in np.arange(views) * 2 * np.pi / views:
        eye = turn @ torch.tensor((3 * np.sin(angle), elevation, 3 * np.cos(angle)), dtype=torch.float64)
        up = turn @ torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
        cameras.append(Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up), intrinsics, WIDTH, HEIGHT))
    return cameras


def dot_image(camera: Camera, radius: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """A soft-edged red disc where the point DOT stands, on a white background that the matte takes away."""
    (u, v), _ = camera.project(DOT)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    alpha = np.clip(radius + 0.5 - np.hypot(columns - u.item(), rows - v.item()), 0, 1)
    rgb = np.full((camera.height, camera.width, 3), 255, np.uint8)
    rgb[alpha > 0] = (200, 40, 0)
    return rgb, np.rint(255 * alpha).astype(np.uint8)


def block(size: tuple[int, int, int] = (3, 3, 7), pitch: tuple[float, float, float] = (0.1, 0.2, 0.3)) -> np.ndarray:
    """Voxel centres of a filled box, longest along z, [n, 3]."""
    cells = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, 3)
    return (cells - (np.array(size) - 1) / 2) * pitch


def write_animal(folder: Path, cameras: list[Camera] | None = None, motions: tuple[str, ...] = ("walk",)) -> Path:
    """An animal of two bones whose second bone rises by 0.1 a frame."""
    cameras = cameras or ring()
    rest = np.tile(np.eye(4), (2, 1, 1))
    rest[1, :3, 3] = (0.0, 0.0, 1.0)
    bones = np.tile(rest, (FRAMES, 1, 1, 1))
    bones[:, 1, 1, 3] += 0.1 * np.arange(FRAMES)
    voxels = block()
    indices = np.tile((1, 0), (len(voxels), 1))
    weights = np.tile((0.25, 0.75), (len(voxels), 1))
    with ArtemisWriter(folder, cameras, rest, np.array((-1, 0)), voxels, indices, weights, np.ones(3)) as writer:
        for motion in motions:
            writer.motion(motion, bones)
            for view, camera in enumerate(cameras):
                rgb, alpha = dot_image(camera)
                for frame in range(FRAMES):
                    writer.image(motion, frame, view, rgb, alpha)
    return folder
