"""Settings of D-3DGS and D-3DGS*, and their rows in tables; without torch, since flags read it first."""

from typing import Annotated

import msgspec
from msgspec import Meta

from rewild4d.baselines.common.splatting_config import ImageLoss, Resets, SplatConfig
from rewild4d.contracts import MethodInfo
from rewild4d.ours.config import Canonical, Density, Skin
from rewild4d.ours.numbers import Degree, Opacity, Positive, Rate, Share, Weight, Whole

PAPER = "Yang et al., Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction, CVPR 2024"
LICENCE = "MIT (written anew from the paper)"
INFO = MethodInfo(title="D-3DGS", paper=PAPER, licence=LICENCE, uses_prior=False)
STAR_INFO = MethodInfo(title="D-3DGS*", paper=f"{PAPER}; the star as in the paper of `ours`", licence=LICENCE)


Width = Annotated[int, Meta(ge=1, le=2048)]
Layers = Annotated[int, Meta(ge=1, le=64)]
Octaves = Annotated[int, Meta(ge=0, le=64)]


class NetworkShape(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sizes of the deformation network; the defaults are the original's."""

    depth: Layers = 8
    """Number of layers before the heads."""
    width: Width = 256
    """Hidden width of each layer."""
    skip: Whole = 4
    """Layer after which the input is added again, counted from 0."""
    place_octaves: Octaves = 10
    """Octaves of the position code."""
    time_octaves: Octaves = 6
    """Octaves of the time code."""
    time_width: Width = 256
    """Hidden width of the network that encodes time."""
    time_features: Width = 30
    """Outputs of that network."""
    half: bool = True
    """Multiply in bfloat16 on a CPU that has it (docs/experiments/bfloat16.md)."""


class Motion(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Schedule of the deformation network."""

    warm_up: Weight = 0.075
    """Fraction before which the Gaussians are not deformed (3k of 40k)."""
    noise: Weight = 0.1
    """Standard deviation of the time jitter in frames, falling linearly to zero."""
    noise_until: Weight = 0.5
    """Fraction at which the jitter ends (20k of 40k)."""
    rate: Rate = (8e-4, 1.6e-6)
    """Learning rate of the network, falling exponentially."""


class D3dgsCanonical(Canonical, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The canonical Gaussians."""

    opacity: Opacity = 0.1
    sh_degree: Degree = 3


class D3dgsDensity(Density, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Densification with a cap."""

    start: Weight = 0.0125
    """Fraction of the first round (500 of 40k)."""
    end: Weight = 0.375
    """Fraction of the last round (15k of 40k)."""
    every: Positive = 0.0025
    """Fraction between rounds (100 of 40k)."""
    prune_opacity: Share = 0.005
    """Remove Gaussians below this opacity (3DGS); less than `resets.opacity`."""


class D3dgsResets(Resets, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Opacity resets."""

    every: Weight = 0.075
    """Fraction between resets (3k of 40k); 0 for none."""
    until: Weight = 0.375
    """Fraction after which there are none (15k of 40k)."""


class D3dgsConfig(SplatConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`d3dgs`; the defaults are the original's schedule on 20k steps."""

    canonical: D3dgsCanonical = D3dgsCanonical()
    density: D3dgsDensity = D3dgsDensity()
    resets: D3dgsResets = D3dgsResets()
    network: NetworkShape = NetworkShape()
    motion: Motion = Motion()


class StarCanonical(D3dgsCanonical, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The canonical Gaussians, on the prior's surface."""

    opacity: Opacity = 0.9


class StarLoss(ImageLoss, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Losses of one rendered view."""

    silhouette: Weight = 0.1


class D3dgsStarConfig(D3dgsConfig, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`d3dgs-star`; the defaults are those of `d3dgs` with the initial opacity and the silhouette loss of `ours`."""

    mirrored: Share = 0.5
    """Share of the steps that see a mirror image, at negative times (paper: open)."""
    canonical: StarCanonical = StarCanonical()
    loss: StarLoss = StarLoss()
    skin: Skin = Skin()
