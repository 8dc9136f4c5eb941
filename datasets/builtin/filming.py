"""Film an animal of the zoo with one moving camera, over a painted meadow: data in the formats of other benchmarks."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from rewild4d.datasets.builtin import anatomy, building
from rewild4d.datasets.builtin.zoo import animals, bodies, points
from rewild4d.datasets.rigs.animal import AnimatedAnimal
from rewild4d.datasets.rigs.studio import camera_ring, picture
from rewild4d.types import Camera

STEP = 2
"""Degrees about the animal by which the camera goes on from frame to frame."""
THINNED = 5
"""Every so-manieth vertex is looked at to place the camera."""
JOINTS = (
    "eye.L", "eye.R", "nose", "neck", "tail_root", "front_left_top", "front_left_upper", "front_left_foot",
    "front_right_top", "front_right_upper", "front_right_foot", "rear_left_top", "rear_left_upper", "rear_left_foot",
    "rear_right_top", "rear_right_upper", "rear_right_foot",
)  # fmt: skip
"""Points of the body that stand for the 17 keypoints of AP-10K, in their order."""


@dataclass(frozen=True)
class Shot:
    """One frame of a film.

    Attributes:
        rgb: with its background, uint8 [h, w, 3].
        alpha: of the animal, uint8 [h, w].
        camera: in the animal's world.
        joints: column, row and 1 of each keypoint of AP-10K in pixels, three zeros for one that the animal lacks,
            float64, [17, 3].
    """

    rgb: np.ndarray
    alpha: np.ndarray
    camera: Camera
    joints: np.ndarray


def film(seed: int, frames: int, width: int, height: int) -> Iterator[Shot]:
    """Yield the frames of a zoo animal's clip; its middle stays in the image's.

    Args:
        seed: of the animal (`zoo.animals.draw`).
        frames: of the clip.
        width: of the images in pixels.
        height: of the images in pixels.

    Raises:
        UserError: no such seed.
    """
    animal = animals.build(seed, frames)
    posed = np.stack([np.concatenate(animal.posed(t))[::THINNED] for t in range(frames)])
    ring = camera_ring(posed, animal.up, 360 // STEP, width, height)
    joints, meadow = _joints(seed, animal), _meadow(seed, width, height)
    start = np.random.default_rng(seed).integers(len(ring))
    for frame in range(frames):
        camera = ring[(start + frame) % len(ring)]
        rgb, alpha = picture(animal, frame).render(camera)
        focal = float(camera.intrinsics[0, 0])
        behind = np.roll(meadow, round(-frame * np.radians(STEP) * focal), axis=1)[:, :width]
        weight = alpha[..., None].astype(np.float32) / 255
        drawn = np.rint(rgb * weight + behind * (1 - weight)).astype(np.uint8)
        yield Shot(drawn, alpha, camera, _seen(joints, animal, frame, camera))


def _joints(seed: int, animal: AnimatedAnimal) -> dict[str, tuple[int, np.ndarray]]:
    """Return bone and place at rest, in the world, of every named point of the body."""
    drawn = animals.draw(seed)
    body = bodies.body(drawn.proportions)
    names, bones, places = points.body_points(anatomy.assemble(body)[0], drawn.proportions)
    world = building.world_matrix(drawn.heading, drawn.up, drawn.place)
    eye, head = np.array(body.eye[:3]), animal.bone_names.index("head")
    found = dict(zip(names, zip(bones.tolist(), places, strict=True), strict=True))
    found |= {"eye.L": (head, eye), "eye.R": (head, eye * (-1, 1, 1))}
    return {name: (bone, world[:3, :3] @ place + world[:3, 3]) for name, (bone, place) in found.items()}


def _seen(joints: dict[str, tuple[int, np.ndarray]], animal: AnimatedAnimal, frame: int, camera: Camera) -> np.ndarray:
    """Project the keypoints of one frame, [17, 3]."""
    found = np.zeros((len(JOINTS), 3))
    moved = animal.bones[frame] @ np.linalg.inv(animal.bones_rest)
    for row, name in enumerate(JOINTS):
        if name in joints:
            bone, place = joints[name]
            pixel, _ = camera.project(torch.from_numpy(moved[bone, :3, :3] @ place + moved[bone, :3, 3]))
            found[row] = (*pixel.tolist(), 1.0)
    return found


def _meadow(seed: int, width: int, height: int) -> np.ndarray:
    """Paint a strip of meadow under a sky, all around, float32 [h, w', 3]."""
    strip, random = 4 * width, np.random.default_rng(seed)
    noise = cv2.GaussianBlur(random.normal(0.0, 1.0, (height, strip)), (0, 0), max(1.0, height / 60))
    share = np.linspace(0, 1, height)[:, None, None]
    ground = np.where(share > 0.45, np.array((96.0, 128.0, 70.0)), np.array((150.0, 175.0, 205.0)))
    return np.clip(ground + 40 * noise[..., None] / noise.std(), 0, 255).astype(np.float32)
