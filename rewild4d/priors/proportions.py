"""Body proportions, the parameters of the quadruped template."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class Proportion(NamedTuple):
    """One body measure: half sizes and lengths in object units, angles in radians.

    Attributes:
        average: of a generic quadruped.
        spread: one standard deviation over species, relative (of the logarithm) unless additive.
        additive: the measure is average + spread * z instead of average * exp(spread * z).
    """

    average: float
    spread: float
    additive: bool = False


PROPORTIONS: dict[str, Proportion] = {
    "body_length": Proportion(1.75, 0.20),
    "chest_width": Proportion(0.36, 0.25),
    "chest_height": Proportion(0.46, 0.20),
    "belly_width": Proportion(0.36, 0.25),
    "belly_height": Proportion(0.40, 0.20),
    "hip_width": Proportion(0.33, 0.25),
    "hip_height": Proportion(0.42, 0.20),
    "chest_drop": Proportion(0.0, 0.08, True),
    "belly_drop": Proportion(0.0, 0.08, True),
    "front_leg": Proportion(1.40, 0.25),
    "rear_leg": Proportion(1.45, 0.25),
    "front_stance": Proportion(0.20, 0.25),
    "rear_stance": Proportion(0.20, 0.25),
    "front_thigh": Proportion(0.17, 0.25),
    "rear_thigh": Proportion(0.23, 0.25),
    "front_shank": Proportion(0.085, 0.30),
    "rear_shank": Proportion(0.085, 0.30),
    "paw": Proportion(0.10, 0.30),
    "elbow_back": Proportion(0.08, 0.08, True),
    "knee_forward": Proportion(0.12, 0.10, True),
    "hock_back": Proportion(0.16, 0.10, True),
    "neck_length": Proportion(0.85, 0.30),
    "neck_angle": Proportion(0.85, 0.40, True),
    "neck_base": Proportion(0.29, 0.25),
    "neck_top": Proportion(0.19, 0.25),
    "head_length": Proportion(0.72, 0.25),
    "head_angle": Proportion(-0.45, 0.30, True),
    "head_height": Proportion(0.20, 0.25),
    "head_width": Proportion(0.17, 0.25),
    "muzzle": Proportion(0.10, 0.30),
    "tail_length": Proportion(1.0, 0.40),
    "tail_angle": Proportion(-0.95, 0.50, True),
    "tail_base": Proportion(0.075, 0.35),
    "tail_middle": Proportion(0.075, 0.45),
}


SECTIONS = (15, 9, 9)
"""Cross sections of the body, of a front leg and of a rear leg."""
RELIEF_SPREAD = (0.15, 0.15, 0.05, 0.05)
"""One standard deviation of a cross section's relief: width and height relative, shifts in object units."""


@dataclass(frozen=True)
class Proportions:
    """Body proportions as deviations from the average quadruped, in standard deviations.

    Attributes:
        deviations: one column per entry of `PROPORTIONS`, float32, [..., P].
        relief: logarithm of width and height, shift in y and z of each of `SECTIONS` cross sections (body from the
            nose, front legs and rear legs from the top), [..., S, 4]; None is zero.
    """

    deviations: Tensor
    relief: Tensor | None = None

    @staticmethod
    def average() -> "Proportions":
        return Proportions(torch.zeros(len(PROPORTIONS)))

    @staticmethod
    def of(**measures: float) -> "Proportions":
        """Return the average animal with other values of the named measures (object units, radians)."""
        deviations = torch.zeros(len(PROPORTIONS))
        for name, value in measures.items():
            average, spread, additive = PROPORTIONS[name]
            deviation = (value - average) / spread if additive else np.log(value / average) / spread
            deviations[list(PROPORTIONS).index(name)] = float(deviation)
        return Proportions(deviations)

    def reliefs(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the relief of body, front legs and rear legs, logarithms and object units, each [..., s, 4]."""
        relief = self.relief
        if relief is None:
            relief = self.deviations.new_zeros(*self.deviations.shape[:-1], sum(SECTIONS), 4)
        return (relief * relief.new_tensor(RELIEF_SPREAD)).split(SECTIONS, dim=-2)

    def measures(self) -> dict[str, Tensor]:
        """Return every measure by name, each [...]."""
        return {
            name: p.average + p.spread * z if p.additive else p.average * torch.exp(p.spread * z)
            for (name, p), z in zip(PROPORTIONS.items(), self.deviations.unbind(-1), strict=True)
        }
