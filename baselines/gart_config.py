"""Settings of GART and GART*, and their rows in tables; without torch, since flags read it first.

"10k" in a setting's help are the original's steps.
"""

from typing import Annotated

import msgspec
from msgspec import Meta

from rewild4d.baselines.common.splatting_config import GaussianRates, ImageLoss, Resets, SplatConfig
from rewild4d.contracts import MethodInfo
from rewild4d.ours.config import (
    Canonical,
    Count,
    Degree,
    Density,
    Opacity,
    Positive,
    Rate,
    Share,
    Skin,
    Skinning,
    Weight,
    Whole,
)

PAPER = "Lei et al., GART: Gaussian Articulated Template Models, CVPR 2024"
LICENCE = "MIT (written anew from the paper)"
INFO = MethodInfo(title="GART (20 bones)", paper=PAPER, licence=LICENCE)
STAR_INFO = MethodInfo(
    title="GART* (20 bones)", paper=PAPER, licence=LICENCE, mark="poses fitted once more to each input image"
)


class Poses(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Schedule of poses and skinning."""

    rate: Positive = 1e-4
    """Learning rate of the joints' rotations, radians a step (Adam); translations have 5 times that."""
    start: Weight = 0.05
    """Fraction before which poses are the prior's (500 of 10k)."""
    skinning_rate: Rate = (1e-4, 1e-5)
    """Learning rate of the skinning residual, falling exponentially."""
    skinning_start: Annotated[float, Meta(ge=0, lt=1)] = 0.2
    """Fraction before which skinning is the template's (2k of 10k)."""


class Regularisers(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Weights of the regularisers."""

    neighbours: Count = 3
    """Gaussians that are compared, the Gaussian itself included."""
    quats: Weight = 1e-3
    """Weight of the standard deviation of orientations among neighbours."""
    scales: Weight = 1e-3
    """Weight of the standard deviation of scales."""
    opacities: Weight = 1e-3
    """Weight of the standard deviation of opacities."""
    colors: Weight = 1e-3
    """Weight of the standard deviation of colours, as coefficients of the harmonics."""
    variation: Weight = 0.5
    """Weight of the total variation of the skinning residual."""
    norm: Weight = 0.1
    """Weight of the mean norm of the skinning residual."""
    every: Count = 1
    """Steps between evaluations of these two, weights multiplied accordingly."""
    small: Weight = 0.05
    """Weight of the mean square of a Gaussian's largest scale."""


class GartCanonical(Canonical, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The canonical Gaussians, on the template's surface."""

    opacity: Opacity = 0.99
    sh_degree: Degree = 3
    sh_every: Positive = 0.1
    """Fraction after which one more degree joins (1k of 10k)."""


class GartRates(GaussianRates, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Learning rates of the Gaussians' attributes (Adam)."""

    quats: Weight = 5e-3
    colors: Weight = 1.4e-3
    """Colours: 5e-3 on the coefficients of the harmonics."""


class GartLoss(ImageLoss, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Losses of one rendered view, sums over pixels divided by the area of the animal's box as in `ours`."""

    l1: Weight = 1.0
    ssim: Weight = 0.1


class GartDensity(Density, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Densification with a cap."""

    start: Weight = 0.01
    """Fraction of the first round (100 of 10k)."""
    end: Weight = 0.8
    """Fraction of the last round (8k of 10k)."""
    every: Positive = 0.03
    """Fraction between rounds (300 of 10k)."""
    gradient: Weight = 5e-4
    prune_opacity: Share = 0.05


class GartResets(Resets, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Opacity resets."""

    every: Weight = 0.1
    """Fraction between resets (1k of 10k); 0 for none."""
    until: Weight = 0.95
    """Fraction after which there are none (the last is at 9,002 of 10k)."""
    opacity: Opacity = 0.06
    """Opacities above this are set to it (original: 0.05, which is also `density.prune_opacity`)."""


class GartSkinning(Skinning, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The skinning grid."""

    resolution: Annotated[int, Meta(ge=2)] = 64
    neighbours: Count = 30
    sweeps: Whole = 30


class GartConfig(SplatConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`gart`; the defaults are the original's dog profile."""

    iterations: Whole = 10_000
    """Steps (the original's)."""
    mirrored: Share = 0.0
    """Share of the steps that see a mirror image, at time -t with a pose of its own (paper of `ours`: open)."""
    template: str = ""
    """Path of a D-SMAL file; empty for the prior's surface and its 20 bones."""
    canonical: GartCanonical = GartCanonical()
    rates: GartRates = GartRates()
    loss: GartLoss = GartLoss()
    density: GartDensity = GartDensity()
    resets: GartResets = GartResets()
    skinning: GartSkinning = GartSkinning()
    poses: Poses = Poses()
    regularisers: Regularisers = Regularisers()
    skin: Skin = Skin()


class Refine(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Second fit of each frame's pose to that frame, by SGD."""

    steps: Whole = 160
    """Steps for each frame."""
    rate: Positive = 2e-2
    """Initial learning rate."""
    halve_every: Count = 50
    """Steps after which the rate is halved."""


class GartStarConfig(GartConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`gart-star`: `gart`, then the second fit of the poses."""

    refine: Refine = Refine()
