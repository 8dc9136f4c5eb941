"""Settings of the losses of `ours`; conventions as in rewild4d/ours/config.py."""

from typing import Literal

import msgspec

from rewild4d.ours.numbers import Count, Positive, Size, Weight


class Loss(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Image losses of the two branches (section 6)."""

    isolated: bool = True
    """Keep gradients of the appearance from the joints (paper)."""
    pose_silhouette: Weight = 0.2
    """Weight of BCE + Dice of the pose branch (paper)."""
    l1: Weight = 0.8
    """Weight of the L1 colour loss of the deformed branch (paper)."""
    ssim: Weight = 0.2
    """Weight of one minus SSIM, deformed branch (paper)."""
    silhouette: Weight = 0.1
    """Weight of BCE + Dice of the deformed branch (paper)."""
    random_background: bool = True
    """Compose render and target over one random colour a step, so that floaters cannot hide; False: over white."""
    mean_over: Literal["box", "image"] = "box"
    """Area that sums over pixels are divided by: the animal's box, so that the frame's margins change no weight, or the
    image ("standard" losses, as the paper calls them)."""


class Geometry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Regularizers: the paper's three, then some that it does not have (sections 6, 9, 11.6)."""

    until: Weight = 0.5
    """Fraction at which the paper's three end (paper: 10k of 20k)."""
    tv: Weight = 10.0
    """Weight of the total variation of the skinning probabilities (paper)."""
    tv_delta: Positive = 0.05
    """Huber threshold of the total variation (paper)."""
    tv_every: Count = 1
    """Steps between evaluations, weight multiplied accordingly (the next two likewise)."""
    compact: Weight = 0.1
    """Weight of the compactness of the parts, mean over canonical and posed centres (paper)."""
    compact_alpha: Weight = 2.0
    """Factor in the exponent that makes large parts count less (paper)."""
    compact_every: Count = 4
    """Steps between evaluations."""
    smooth: Weight = 0.1
    """Weight of the smoothness of rendered normals (paper)."""
    smooth_every: Count = 2
    """Steps between evaluations."""
    smooth_size: Size = 256
    """Side of the square image of normals, pixels."""
    limit: Weight = 1.0
    """Pose: weight of rotations of more than `limit_degrees` against the parent."""
    limit_degrees: Positive = 70.0
    """Joint limit, degrees."""
    attach: Weight = 20.0
    """Pose: weight of the squared gap between a joint and its parent's copy, over the squared diagonal."""
    limb_plane: Weight = 0.0
    """Pose: weight of a limb bone's squared rotation out of the plane along the body, against its parent (half
    radians)."""
    body_plane: Weight = 0.0
    """Pose: weight of the same of the other bones."""
    sideways: Weight = 0.0
    """Pose: weight of a limb joint's squared gap across the body (diagonals), added to `attach`."""
    temporal: Weight = 10.0
    """Pose: weight of the squared second difference over neighbouring frames."""
    still: Weight = 0.0
    """Pose: weight of steps between neighbouring frames under Geman and McClure's function, which stops slow drift."""
    still_step: Positive = 1e-3
    """Step of a rotation (half radians) or joint (diagonals) that separates drift from motion."""
    rigid: Weight = 1.0
    """Deformed branch: weight of changed distances between canonical neighbours."""
    rigid_neighbours: Count = 5
    """Neighbours that a Gaussian is compared with."""
    steady: Weight = 0.1
    """Deformed branch: weight of the squared change of log scale, against scales that grow and are shrunk again."""
    stray: Weight = 0.0
    """Deformed branch: weight of squared displacements above `stray_from`, against parts that leave the body where no
    image speaks of them."""
    stray_from: Weight = 0.02
    """Displacement by the deformation that costs nothing, diagonals."""


class Skin(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Gaussians held to the skin that the fit starts from (not in the paper); off by default."""

    disc: Weight = 0.0
    """Weight of what a Gaussian lacks of an opaque disc of the starting size."""
    bind: Weight = 0.0
    """Weight of the distance from the skin along its normal, and of the angle to that normal."""
    evidence: Weight = 0.0
    """Information (share of the frames that see a point, across their lines of sight) at which a hold has half its
    weight; 0 holds all alike."""
    flat: Positive = 3.0
    """Least ratio of a disc's radius to its thickness."""
    growth: Positive = 1.3
    """Largest scale, in starting radii."""
    reach: Positive = 3.0
    """Distance, in starting radii, beyond which a Gaussian is free."""
    heights: Weight = 0.0
    """Rate at which the skin moves as a whole along its normals, falling to a hundredth (heights.py); 0 for none."""
    follow: bool = False
    """Let a centre move on its own only as far as frames from several sides tell its place (`evidence`; with 0 not at
    all), and with the skin (`heights`) as far as they do not."""

    @property
    def holds(self) -> bool:
        """Whether a Gaussian needs its point of the skin at all."""
        return self.disc > 0 or self.bind > 0 or self.heights > 0 or self.follow
