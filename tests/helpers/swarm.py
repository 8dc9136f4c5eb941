"""Gaussians that move, and a film of them, for what shows them."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from rewild4d.harmonics import rotated
from rewild4d.transforms import axis_angle_to_matrix, look_at, matrix_to_quat, quat_multiply, quat_to_matrix
from rewild4d.types import Camera, Clip, Frame, Splats

COUNT, MOMENTS = 300, 6
WIDTH, HEIGHT = 96, 64
Colors = Literal["rgb", "world", "own", "changing"]


@dataclass(frozen=True)
class Swarm:
    """A cloud that turns about y while a red and a blue disc before it change places; a tenth of it is invisible.

    Attributes:
        colors: RGB, or coefficients of harmonics that stay in the world, in the Gaussian's own frame, or nowhere.
        film: whether the film's camera is known.
    """

    colors: Colors = "rgb"
    film: bool = True

    def at(self, time: float) -> Splats:
        generator = torch.Generator().manual_seed(0)
        means = torch.randn(COUNT, 3, generator=generator)
        quats = torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=generator), dim=1)
        scales = 0.03 + 0.15 * torch.rand(COUNT, 3, generator=generator)
        opacities = 0.1 + 0.85 * torch.rand(COUNT, generator=generator)
        opacities[5::10] = 0.003
        count = 1 if self.colors == "rgb" else 16
        colors = torch.rand(COUNT, count, 3, generator=generator) - (0.0 if count == 1 else 0.5)
        turn = axis_angle_to_matrix(torch.tensor((0.0, 3 * time, 0.0)))
        means, moved = means @ turn.T, quat_multiply(matrix_to_quat(turn).expand(COUNT, 4), quats)
        if self.colors == "own":
            colors = rotated(colors, quat_to_matrix(moved))
        elif self.colors == "changing":
            colors = colors + time
        else:
            side = 0.3 * float(torch.cos(torch.tensor(40 * time)))
            means[:2] = torch.tensor(((0.0, 0.0, 2.5 + side), (0.3, 0.0, 2.5 - side)))
            scales[:2], opacities[:2] = torch.tensor((0.4, 0.4, 0.02)), 0.95
            moved[:2] = torch.tensor((1.0, 0.0, 0.0, 0.0))
            colors[:2, 0] = torch.tensor(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
        return Splats(means, moved, scales, opacities, colors)

    def camera(self, time: float) -> Camera | None:
        if not self.film:
            return None
        eye = torch.tensor((6 * time, 1.0, 9.0), dtype=torch.float64)
        up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
        intrinsics = torch.tensor(((140.0, 0, 44), (0, 140, 35), (0, 0, 1)), dtype=torch.float64)
        return Camera(look_at(eye, torch.zeros(3).double(), up), intrinsics, WIDTH, HEIGHT)

    def save(self, folder: object) -> None: ...


class Growing(Swarm):
    """A swarm of 100 Gaussians that are 200 from the fourth moment on, and gone at the last; some are invisible."""

    def at(self, time: float) -> Splats:
        return only(super().at(time), torch.arange(COUNT) < (100 if time < 0.1 else 0 if time > 0.2 else 200))


def film(count: int = MOMENTS) -> Clip:
    """A film without cameras whose frames tell their place: grey, brighter from frame to frame."""
    frames = tuple(
        Frame(row / 24, None, torch.full((3, HEIGHT, WIDTH), row / max(count - 1, 1)), torch.ones(1, HEIGHT, WIDTH))
        for row in range(count)
    )
    return Clip("swarm/turn", "swarm", frames, 24.0, "CC0", "d")


def only(splats: Splats, rows: Tensor) -> Splats:
    """Some of the Gaussians."""
    return replace(
        splats, means=splats.means[rows], quats=splats.quats[rows], scales=splats.scales[rows],
        opacities=splats.opacities[rows], colors=splats.colors[rows],
    )  # fmt: skip
