"""Tensors on a GPU that stay where they are, for the inputs of recorded training steps."""

from dataclasses import replace
from typing import NamedTuple, cast

import torch
from torch import Tensor

from rewild4d.ours.inputs import Scalar, StepInput

ALIGNED = 4
"""Each slot starts at a multiple of as many numbers: 16 bytes, which kernels read at once."""


class Kind(NamedTuple):
    """What decides which kernels a step runs; steps of one kind differ only in numbers.

    Attributes:
        size: width and height of the image.
        degree: of the harmonics.
        blends, pulls, ramps, smooths, varies, compacts: which parts of `StepInput` act.
        observes: whether the density control looks at the gradients.
    """

    size: tuple[int, int]
    degree: int
    blends: bool
    pulls: bool
    ramps: bool
    smooths: bool
    varies: bool
    compacts: bool
    observes: bool

    @classmethod
    def of(cls, given: StepInput, observes: bool) -> "Kind":
        """Return the kind of a step."""
        return cls(
            (given.target.camera.width, given.target.camera.height),
            given.degree,
            blends=given.blend is not None,
            pulls=given.pull is not None,
            ramps=given.ramp is not None,
            smooths=given.direction is not None,
            varies=given.varies,
            compacts=given.compacts,
            observes=observes,
        )


class Slots:
    """One vector on a device for all small inputs of a step, filled in one copy, and a place for its images.

    Args:
        given: a step's input; others have the same shapes.
        rates: number of learning rates.
        device: of the slots.
    """

    def __init__(self, given: StepInput, rates: int, device: torch.device) -> None:
        self.given = given
        self.parts = [torch.as_tensor(part) for part in _numbers(given, [0.0] * rates)]
        starts = [0]
        for part in self.parts:
            starts.append(starts[-1] + -(-part.numel() // ALIGNED) * ALIGNED)
        self.there = torch.zeros(starts[-1], device=device)
        self.here = torch.zeros(starts[-1], pin_memory=device.type == "cuda")
        self.staged, self.placed = (
            [
                vector[start : start + part.numel()].view(part.shape)
                for start, part in zip(starts[:-1], self.parts, strict=True)
            ]
            for vector in (self.here, self.there)
        )
        self.images: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}

    def fill(self, given: StepInput, rates: list[float]) -> None:
        """Copy a step's input to the device; the device must have read the last one."""
        for slot, part in zip(self.staged, _numbers(given, rates), strict=True):
            if isinstance(part, Tensor):
                slot.copy_(part)
            else:
                slot.fill_(part)
        self.there.copy_(self.here, non_blocking=True)
        target = given.target
        size = target.camera.width, target.camera.height
        if size not in self.images:
            self.images[size] = torch.empty_like(target.rgb), torch.empty_like(target.mask)
        for place, image in zip(self.images[size], (target.rgb, target.mask), strict=True):
            place.copy_(image)

    def rates(self) -> list[Tensor]:
        """Return the learning rates, scalars."""
        return self.placed[_FIXED:]

    def input(self, kind: Kind) -> StepInput:
        """Return the input that the slots hold, as tensors on the device."""
        (
            world_to_camera, intrinsics, side, eye, codes, flipped, row, background, blend, pull, ramp, gaps, quats,
            shifts, direction, marks,
        ) = self.placed[:_FIXED]  # fmt: skip
        rgb, mask = self.images[kind.size]
        width, height = kind.size
        camera = replace(
            self.given.target.camera,
            world_to_camera=world_to_camera,
            intrinsics=intrinsics,
            width=width,
            height=height,
        )
        return StepInput(
            replace(self.given.target, rgb=rgb, mask=mask, camera=camera, side=cast(float, side)),
            eye,
            codes,
            flipped > 0,
            row.long(),
            None if self.given.gaps is None else gaps,
            prior_pose=(quats, shifts),
            blend=blend if kind.blends else None,
            pull=pull if kind.pulls else None,
            ramp=ramp if kind.ramps else None,
            offset=0.0,
            background=background,
            direction=direction if kind.smooths else None,
            degree=kind.degree,
            varies=kind.varies,
            compacts=kind.compacts,
            marks=marks,
        )


_FIXED = 16
"""Number of slots before the learning rates."""


def _numbers(given: StepInput, rates: list[float]) -> list[Scalar]:
    """Return all numbers of an input but the images, in the order of the slots; zeros where a part does not act."""
    target = given.target
    return [
        target.camera.world_to_camera, target.camera.intrinsics, target.side, given.eye, given.codes, given.flipped,
        given.row, given.background, given.blend or 0.0, given.pull or 0.0, given.ramp or 0.0,
        torch.zeros(0, 2) if given.gaps is None else given.gaps, *given.prior_pose,
        torch.zeros(3) if given.direction is None else given.direction, given.marks, *rates,
    ]  # fmt: skip
