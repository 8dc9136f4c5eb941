"""Draw examples to train on: sequences of random animals under random cameras, and where their points are."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from rewild4d.datasets import surface_nets
from rewild4d.datasets.builtin.gait import rotation
from rewild4d.datasets.builtin.zoo.varied import FOUR_FOOTED, VariedAnimal, draw_animal, draw_clip
from rewild4d.datasets.rigs.animal import Surface
from rewild4d.priors.learned.drawing import draw
from rewild4d.priors.learned.pictures import LENGTH, LEVEL, MARGIN, SIZE, Examples, joined, looking_at, normalised
from rewild4d.priors.learned.points import NAMES, root_of
from rewild4d.transforms import look_at

CLIPS = 8
"""Sequences of each animal."""


def draw_sequences(
    rng: np.random.Generator,
    count: int = CLIPS,
    length: int = LENGTH,
    *,
    kinds: Sequence[str] = FOUR_FOOTED,
    names: Sequence[str] = NAMES,
    stretched: bool = False,
) -> Examples:
    """Draw ``count`` sequences of one random animal with the named points; the rest as of `draw_animal`."""
    animal = draw_animal(rng, kinds, stretched=stretched)
    return joined([_sequence(animal, length, names, rng) for _ in range(count)])


def _sequence(animal: VariedAnimal, length: int, names: Sequence[str], rng: np.random.Generator) -> Examples:
    transforms = draw_clip(animal, length, rng)
    vertices = [animal.surface.posed(moved) for moved in transforms]
    order = [animal.names.index(name) for name in names]
    homogeneous = np.concatenate((animal.points, np.ones((len(animal.points), 1))), axis=1)[order]
    points = np.einsum("tlab,lb->tla", transforms[:, animal.point_bones[order], :3], homogeneous)
    shades = _shades(animal.surface, rng)
    faces = animal.surface.faces.astype(np.int32)
    radius = float(np.linalg.norm(vertices[0] - vertices[0].mean(axis=0), axis=1).max())
    place = _Place(radius, length, rng)
    rows = [place.seen(t, vertices[t], points[t], faces, shades, rng) for t in range(length)]
    pictures, rotations, openings, marks = (np.stack(column) for column in zip(*rows, strict=True))
    if rng.random() < 0.3:
        pictures[:, 1] = 0
    known = rng.random() < 0.7
    if not known:
        rotations[:] = LEVEL
    shown, turned, opened, found = (
        torch.from_numpy(value.astype(np.float32))[None] for value in (pictures, rotations, openings, marks)
    )
    return Examples(shown, turned, opened, torch.tensor([known]), found)


def _shades(surface: Surface, rng: np.random.Generator) -> np.ndarray:
    """Return the brightness of every vertex of a surface at rest, under a light of random direction, [n]."""
    grey = surface.colors @ rng.dirichlet((2, 2, 2))
    light = rng.normal(0, 1, 3) + (0, 1, 0)
    facing = surface_nets.normals(surface.vertices, surface.faces) @ light / np.linalg.norm(light)
    return np.asarray(grey * (1 + rng.uniform(0.1, 0.5) * facing), np.float32)


class _Place:
    """Cameras around one animal: still, slowly moving, circling or jumping."""

    def __init__(self, radius: float, length: int, rng: np.random.Generator) -> None:
        kind = rng.random()
        step = 0.0 if kind < 0.35 else float(rng.normal(0, 3)) if kind < 0.5 else float(rng.choice((-1, 1)))
        step *= float(rng.uniform(5, 40)) if kind >= 0.5 else 1.0
        self.yaws = np.radians(rng.uniform(0, 360) + step * np.arange(length))
        if kind > 0.9:
            self.yaws = rng.uniform(0, 2 * np.pi, length)
        tilt, drift = rng.uniform(-8, 40) if rng.random() < 0.9 else rng.uniform(-25, 75), rng.normal(0, 0.4)
        self.tilts = np.radians(tilt + drift * np.arange(length))
        self.rolls = rng.normal(0, 2.0) + rng.normal(0, 0.3, length)
        self.distance = radius * float(np.exp(rng.uniform(np.log(2.2), np.log(12.0))))
        self.heading = rng.uniform(0, 360)
        self.dirt = rng.random()

    def camera(self, t: int) -> np.ndarray:
        """Return the rotation body frame -> camera axes at a frame, [3, 3]."""
        yaw, tilt = self.yaws[t], self.tilts[t]
        eye = torch.tensor((np.sin(yaw) * np.cos(tilt), np.sin(tilt), np.cos(yaw) * np.cos(tilt)))
        axes = look_at(eye, torch.zeros(3).double(), torch.tensor((0.0, 1.0, 0.0)).double())[:3, :3].numpy()
        return np.asarray(rotation(0.0, 0.0, self.rolls[t]) @ axes)

    def seen(
        self, t: int, vertices: np.ndarray, points: np.ndarray, faces: np.ndarray, shades: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:  # fmt: skip
        """Return picture, rotation, opening and points of one frame."""
        axes, middle = self.camera(t), vertices.mean(axis=0)
        local = (vertices - middle) @ axes.T + (0.0, 0.0, self.distance)
        low, high = (local[:, :2] / local[:, 2:]).min(axis=0), (local[:, :2] / local[:, 2:]).max(axis=0)
        half = 0.5 * float((high - low).max()) * (1 + 2 * MARGIN) * float(np.exp(rng.normal(0, 0.03)))
        center = (low + high) / 2 + half * rng.normal(0, 0.03, 2)
        turn = looking_at(center)
        seen, marks = local @ turn.T, ((points - middle) @ axes.T + (0.0, 0.0, self.distance)) @ turn.T
        opening = half / (1 + center @ center)
        flat = np.concatenate((0.5 + 0.5 * seen[:, :2] / seen[:, 2:] / opening, seen[:, 2:]), axis=1)
        picture = soiled(draw(flat.astype(np.float32), faces, shades, SIZE), self.dirt, rng)
        turned = rotation(0.0, self.heading, 0.0)
        depth = root_of(marks)[2]
        scaled = (marks - (0.0, 0.0, depth)) / (opening * depth)
        return normalised(picture), turn @ axes @ turned.T, float(opening), scaled


def soiled(picture: np.ndarray, dirt: float, rng: np.random.Generator) -> np.ndarray:
    """Return a picture [2, s, s] whose mask has faults: a strip cut off, a bitten or ragged outline."""
    if dirt < 0.6:
        return picture
    mask = picture[0]
    ragged = gaussian_filter(rng.normal(0, 1, mask.shape), rng.uniform(1.0, 3.0))
    amount = rng.uniform(0.0, 0.3) * ragged / (ragged.std() + 1e-9)
    soft = gaussian_filter(mask, 0.7)
    border = 4 * gaussian_filter(mask, 1.5) * (1 - gaussian_filter(mask, 1.5))
    kept = np.clip(4 * (soft - 0.5 + amount * border * (dirt > 0.75)) + 0.5, 0, 1)
    if dirt > 0.93 and rng.random() < 0.7:
        edge = int(rng.integers(2, SIZE // 5))
        turns = int(rng.integers(4))
        kept = np.rot90(kept, turns).copy()
        kept[:edge] = 0
        kept = np.rot90(kept, -turns)
    bright = picture[1] / np.maximum(mask, 1e-3)
    return np.stack((kept, bright * kept * (mask > 0))).astype(np.float32)
