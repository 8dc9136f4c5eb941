"""What the fit asks of a template: bones, a skinned surface that follows its proportions, and how joints may bend."""

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from rewild4d.types import OBJECT_DIAGONAL

ANGLE_LIMIT = 1.1
"""Bound of a joint's rotation about each axis, radians (Fauna: 60 degrees)."""


class Measure(NamedTuple):
    """One body measure: half sizes and lengths in object units, angles in radians.

    Attributes:
        average: of a generic animal of this kind.
        spread: one standard deviation over species, relative (of the logarithm) unless additive.
        additive: the measure is average + spread * z instead of average * exp(spread * z).
    """

    average: float
    spread: float
    additive: bool = False

    def deviation(self, value: float) -> float:
        """Return the deviation at which the measure has a value, in standard deviations."""
        away = value - self.average if self.additive else float(np.log(value / self.average))
        return away / self.spread

    def at(self, deviation: Tensor) -> Tensor:
        """Return the measure at deviations of any shape."""
        if self.additive:
            return self.average + self.spread * deviation
        return self.average * torch.exp(self.spread * deviation)


@dataclass(frozen=True)
class Proportions:
    """Body proportions as deviations from a template's average animal, in standard deviations.

    Attributes:
        deviations: one column per measure of the body, float32, [..., P].
        relief: of the body's cross sections, a row each, [..., S, 4]; None is zero.
    """

    deviations: Tensor
    relief: Tensor | None = None


@dataclass(frozen=True)
class Template:
    """An animal at rest in object axes; leading dimensions are those of its proportions.

    Attributes:
        vertices: [..., n, 3].
        faces: counter-clockwise from outside, int64, [f, 3].
        weights: rows sum to one, [n, J].
        bones: start (the pivot) and end of each bone, [..., J, 2, 3].
        parents: of each bone, -1 for a root.
        mirror: the bone on the other side, of each.
        blobs: centres of a few hundred round Gaussians that fill the surface, [..., m, 3].
        blob_sizes: their standard deviations, [..., m].
        blob_weights: rows sum to one, [m, J].
        cover: points between which quadrilaterals cover the surface, [..., k, 3].
        cover_weights: rows sum to one, [k, J].
        quads: their corners in order, int64, [q, 4].
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor
    bones: Tensor
    parents: tuple[int, ...]
    mirror: tuple[int, ...]
    blobs: Tensor
    blob_sizes: Tensor
    blob_weights: Tensor
    cover: Tensor
    cover_weights: Tensor
    quads: Tensor

    def scaled(self, factor: Tensor) -> "Template":
        """Return the template with all lengths multiplied by a factor, [...]."""
        each = factor[..., None, None]
        return replace(
            self, vertices=self.vertices * each, bones=self.bones * each[..., None], blobs=self.blobs * each,
            blob_sizes=self.blob_sizes * factor[..., None], cover=self.cover * each,
        )  # fmt: skip


class Body(Protocol):
    """A kind of animal: a differentiable function from proportions to a skinned mesh.

    Attributes:
        name: as `--prior template:<name>` has it.
        parents: of each bone, -1 for a root.
        mirror: the bone on the other side, of each.
        feet: bones whose end treads the ground.
        measures: number of its proportions.
        sections: number of its cross sections that have relief.
    """

    @property
    def name(self) -> str: ...
    @property
    def parents(self) -> tuple[int, ...]: ...
    @property
    def mirror(self) -> tuple[int, ...]: ...
    @property
    def feet(self) -> tuple[int, ...]: ...
    @property
    def measures(self) -> int: ...
    @property
    def sections(self) -> int: ...

    @property
    def spreads(self) -> Tensor:
        """Return standard deviations of joint angles about the object's axes, radians, [J, 3]; 0 where fixed."""
        ...

    @property
    def limits(self) -> Tensor:
        """Return bounds of joint angles about the object's axes, radians, [J, 3]."""
        ...

    def build(self, shape: Proportions | None = None, *, unit: bool = True) -> Template:
        """Build the template; differentiable in the proportions.

        Args:
            shape: body proportions, any leading dimensions; None is the average animal.
            unit: scale so that the bounding-box diagonal is `OBJECT_DIAGONAL`.

        Returns:
            The template, symmetric about x = 0, y up, z towards the head.
        """
        ...

    def carriage(self, bones: Tensor, transforms: Tensor) -> Tensor:
        """Return a penalty on unlikely carriage of head and tail, squared body lengths, [B].

        Args:
            bones: at rest, [B, J, 2, 3].
            transforms: rest -> posed, [B, T, J, 4, 4].
        """
        ...


def diagonal(vertices: Tensor) -> Tensor:
    """Return the length of the bounding-box diagonal, [..., n, 3] -> [...]."""
    return (vertices.amax(-2) - vertices.amin(-2)).norm(dim=-1)


def to_unit(template: Template) -> Template:
    """Return the template whose bounding-box diagonal is `OBJECT_DIAGONAL`."""
    return template.scaled(OBJECT_DIAGONAL / diagonal(template.vertices))
