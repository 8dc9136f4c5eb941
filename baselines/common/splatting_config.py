"""Settings of all Gaussian competitors; without torch, since flags read it before the method is loaded."""

import msgspec

from rewild4d.ours.config import Canonical, Density
from rewild4d.ours.numbers import Count, Opacity, Positive, Rate, Size, Weight, Whole


class GaussianRates(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Learning rates of the Gaussians' attributes (Adam)."""

    means: Rate = (8e-4, 8e-6)
    """Positions, falling exponentially: 1.6e-4 and 1.6e-6 at a scene size of 5."""
    quats: Weight = 1e-3
    """Orientations."""
    log_scales: Weight = 5e-3
    """Scales."""
    logit_opacities: Weight = 5e-2
    """Opacities."""
    colors: Weight = 2.5e-3
    """Colours."""
    colors_epsilon: Positive = 1e-15
    """Adam's epsilon for colours, as in `ours`."""


class ImageLoss(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Losses of one rendered view, sums over pixels divided by the area of the animal's box as in `ours`."""

    l1: Weight = 0.8
    """Absolute difference of colour."""
    ssim: Weight = 0.2
    """One minus SSIM."""
    silhouette: Weight = 0.0
    """BCE + Dice of the matte."""
    random_background: bool = True
    """Put one random colour a step behind render and target, else white."""


class Resets(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Opacity resets: opacities are lowered from time to time, so that floaters are pruned."""

    every: Weight = 0.0
    """Fraction of the iterations between resets; 0 for none."""
    until: Weight = 1.0
    """Fraction of the iterations after which there are none."""
    opacity: Opacity = 0.01
    """Opacities above this are set to it."""


class SplatConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of all Gaussian competitors; "fraction" means a share of `iterations`."""

    image_size: Size = 512
    """Longest training image side, pixels; larger clips are reduced."""
    iterations: Whole = 20_000
    """Steps."""
    steps_per_frame: Whole = 0
    """Least steps for every frame of the clip; 0 leaves it at `iterations`."""
    checkpoint_every: Count = 500
    """Steps between checkpoints, where a work folder is given."""
    canonical: Canonical = Canonical()
    rates: GaussianRates = GaussianRates()
    loss: ImageLoss = ImageLoss()
    density: Density = Density()
    resets: Resets = Resets()
