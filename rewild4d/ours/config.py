"""Settings of `ours`: one tree of frozen structs.

"Fraction" means a share of `Config.iterations`, so that presets of every length follow one schedule. Lengths without a
unit are in the object frame, whose rest diagonal is 5. "Paper" marks values of the paper; section numbers are those of
the method notes. Experiments: see docs/experiments/.
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from rewild4d.ours.losses.config import Geometry, Loss, Skin
from rewild4d.ours.numbers import Count, Degree, Opacity, Positive, Rate, Share, Size, Weight, Whole


def _require_heads(width: int, heads: int) -> None:
    if heads < 1 or width % heads:
        raise ValueError(f"expected a width that is a multiple of the heads, got {width} and {heads}")


class Canonical(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Canonical Gaussians (section 3)."""

    samples: Count = 15_000
    """Gaussians at the start: area-uniform samples of the prior's rest surface."""
    thickness: Positive = 0.5
    """Initial scale along the normal over the scale in the surface."""
    opacity: Opacity = 0.9
    """Initial opacity, in (0, 1)."""
    sh_degree: Degree = 0
    """Degree of the spherical harmonics of colour, 0 to 3 (paper: 3)."""
    sh_every: Positive = 0.05
    """Fraction after which one more degree joins (1k of 20k)."""
    start: Literal["surface", "vertices"] = "surface"
    """Start `samples` points of the prior's rest surface, or one Gaussian at each of its vertices (paper)."""
    max_scale: Weight = 0.05
    """Largest standard deviation, times the rest diagonal; 0 for none (paper)."""


class Skinning(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Learnable skinning field (section 3)."""

    resolution: Annotated[int, Meta(ge=2)] = 32
    """Voxels along each axis of the cubic field (paper)."""
    margin: Positive = 1.2
    """Half-size of the cube over half the longest side of the rest shape."""
    neighbours: Count = 8
    """Vertices averaged by inverse distance to fill a voxel."""
    sweeps: Whole = 2
    """Rounds of neighbour averaging."""
    keep: Share = 0.7
    """Share of itself that a voxel keeps in a round."""
    floor: Positive = 1e-3
    """Added before the logarithm, so that every part can still gain any voxel."""
    tied: bool = False
    """Average the logits with their mirror image (left and right exchanged)."""
    learn: bool = True
    """False freezes the field (the paper's "fixed skinning" ablation)."""


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Part anchors and pose network (section 4)."""

    anchors: bool = True
    """Part anchors; False removes them everywhere ("w/o Part Anchors"): joints' features come from the time code alone,
    and the deformation's query has the skinning weights themselves."""
    anchor_size: Count = 8
    """Length of a part anchor (paper)."""
    anchor_std: Weight = 1.0
    """Standard deviation of the initial anchors; small ones keep the joints alike."""
    frequencies: Count = 4
    """Octaves of the time code."""
    octave_frames: Whole = 24
    """Frames that `frequencies` octaves suffice for; each doubling of the clip adds an octave; 0 adds none."""
    encoding: Literal["group", "view"] = "group"
    """Sign that multiplies time in the code: the group's m (paper), or the image's v ("w/o Symm. Enc."); unused if
    `tied`."""
    explicit_group: bool = False
    """Append the group sign m to the code."""
    width: Count = 128
    """Width of a token."""
    blocks: Count = 2
    """Pre-norm self-attention blocks."""
    heads: Count = 4
    """Attention heads."""
    reach: Positive = 0.1
    """Translation of a joint per unit of the head's output, times the rest diagonal."""
    time_noise: Weight = 0.1
    """Standard deviation of the time jitter in frames, falling linearly to zero."""
    time_noise_until: Weight = 0.5
    """Fraction at which the jitter ends."""
    tied: bool = False
    """Derive the pose of a flipped image by mirroring that of the image (see baselines/presets/ours.toml)."""
    turns: bool = False
    """Let each frame turn its joints a little beside the network (`ours.turns`; docs/experiments/tuning.md)."""
    turns_from: Share = 0.3
    """Fraction from which the turns learn."""
    search_limbs: Share = 0.0
    """Fraction at which limbs that others hide are searched where the mask is empty (`ours.limbs`;
    docs/experiments/films.md); 0 for never."""

    def __post_init__(self) -> None:
        _require_heads(self.width, self.heads)


class Deform(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Part-conditioned deformation (section 5)."""

    enabled: bool = True
    """False is the paper's "w/o Deform" ablation."""
    width: Count = 64
    """Hidden width."""
    heads: Count = 4
    """Attention heads over the parts."""
    frequencies: Whole = 6
    """Octaves of the position code."""
    reach: Positive = 0.1
    """Displacement per unit of output."""
    max_log_scale: Positive = 1.0
    """Bound on the change of log scale (tanh)."""
    half: bool = True
    """Round the factors of the network's products to bfloat16 where a CPU multiplies such pairs; sums in float32."""
    sampled: Whole = 2000
    """Gaussians sampled for the gradients of the network's parameters (ours/fused/sampled_rows.py); 0 uses all."""
    ramp_start: Weight = 0.05
    """Fraction at which the deformation starts to fade in (paper: it acts from the start)."""
    ramp_end: Weight = 0.15
    """Fraction at which it acts in full."""
    detach_features: bool = False
    """Keep the appearance losses out of the part features too (the strict reading of gradient isolation)."""

    def __post_init__(self) -> None:
        _require_heads(self.width, self.heads)


class PriorUse(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Use of the prior's shape at the start, and of its poses later (sections 3 and 4)."""

    shape: bool = True
    """Start on the prior's rest surface; False: anywhere in its box ("w/o Shape Prior"; skinning and poses keep it)."""
    blend: bool = False
    """Blend the prior's poses into the network's; for footage see `Footage` (paper: there alone)."""
    blend_until: Weight = 0.35
    """Fraction at which the blend reaches zero (paper: 7k of 20k)."""
    pull: Weight = 0.3
    """Weight of the squared distance to the prior's poses, falling linearly to zero (paper: for footage alone, weight
    open)."""
    pull_until: Weight = 1.0
    """Fraction at which the pull ends (paper: 4k of 20k); above 1 it is still on at the end."""
    pull_turn: Weight = 0.0
    """How well the frames beside one tell its depth (`ours.evidence.turn`: 0.07 for a camera that turns by 10 degrees a
    frame) above which the pull falls in proportion; 0 for never."""
    untold: Weight = 0.0
    """Weight of the squared distance from the prior's posed skin as far as an image does not tell it: where the skin is
    hidden, and along the line of sight where it is seen; over the prior's mean squared error where the image tells it.
    It does not fall; places that frames from several sides tell are free (`skin.evidence`)."""


class WarmUp(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pose warm-up: poses from blurred silhouettes, Gaussians frozen (section 11.3)."""

    iterations: Whole = 0
    """Steps on silhouettes; needed only by a prior without poses (section 11)."""
    regress: Whole = 300
    """Steps before those that only copy the prior's poses into the network; zero for both skips the stage."""
    copies: Count = 48
    """Poses a step while copying."""
    views: Count = 4
    """Images a step on silhouettes."""
    samples: Count = 2500
    """Gaussians that represent the body."""
    size: Size = 160
    """Longest image side, pixels."""
    blur: Weight = 0.06
    """Initial blur, times the side of the animal's box, falling linearly to zero."""
    regress_rate: Positive = 2e-3
    """Learning rate of the pose network while it copies."""
    rate: Positive = 5e-4
    """Learning rate on silhouettes."""
    pull: Weight = 0.3
    """Weight of the pull to the prior's poses, falling linearly to zero."""


class Rates(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Learning rates (section 6, Schedule); pairs fall exponentially from the first to the second."""

    means: Rate = (8e-4, 8e-6)
    """Positions: 1.6e-4 and 1.6e-6 at a scene size of 5."""
    quats: Weight = 1e-3
    """Orientations."""
    log_scales: Weight = 5e-3
    """Scales."""
    logit_opacities: Weight = 1e-2
    """Logits of the opacities."""
    colors: Weight = 2.5e-3
    """Colours."""
    colors_epsilon: Positive = 1e-15
    """Adam's epsilon for colours: with 1e-4, Gaussians that are hardly seen move in proportion to their gradient
    instead of as fast as all."""
    skinning: Rate = (1e-3, 1e-4)
    """Logits of the field."""
    pose: Rate = (6e-4, 1e-5)
    """Anchors and pose network."""
    turns: Weight = 1e-4
    """Turns of each frame's joints (`pose.turns`), radians."""
    rise: Weight = 0.02
    """Fraction over which the networks' rates rise from zero, since Adam's first steps would undo the warm-up."""
    deform: Rate = (8e-4, 1.6e-6)
    """Deformation network; for footage see `Footage`."""
    clip: Weight = 1.0
    """Bound on the gradient norm of the networks; 0 for none."""


class Density(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Densification with a cap (section 6)."""

    start: Weight = 0.025
    """Fraction of the first round (500 of 20k)."""
    end: Weight = 0.5
    """Fraction of the last round."""
    every: Positive = 0.005
    """Fraction between rounds (100 of 20k)."""
    gradient: Weight = 4e-4
    """Mean image gradient above which a Gaussian is refined, in half sides of the animal's box."""
    split_scale: Positive = 0.01
    """Split above this scale (times the rest diagonal), clone below."""
    prune_opacity: Share = 0.01
    """Remove Gaussians below this opacity."""
    prune_radius: Positive = 0.2
    """Remove Gaussians that cover more than this share of the image's longest side."""
    cap: Count = 40_000
    """Most Gaussians."""


class Footage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Values that replace others for footage of unknown cameras (docs/experiments/films.md)."""

    use: bool = True
    """False: the values below are not used."""
    steps_per_frame: Whole = 250
    """Instead of `steps_per_frame`."""
    temporal: Weight = 5.0
    """Instead of `geometry.temporal`."""
    rigid: Weight = 0.2
    """Instead of `geometry.rigid`."""
    blend: bool | None = None
    """Instead of `prior.blend`; None leaves it."""
    pull: Weight | None = None
    """Instead of `prior.pull`; None leaves it."""
    pull_until: Weight = 0.35
    """Instead of `prior.pull_until`."""
    pose: Rate = (7e-4, 1e-5)
    """Instead of `rates.pose`."""
    deform: Rate = (2e-3, 1e-5)
    """Instead of `rates.deform`."""
    turns: bool = False
    """Instead of `pose.turns`."""
    turns_rate: Weight = 1e-4
    """Instead of `rates.turns`."""
    search_limbs: Share = 0.0
    """Instead of `pose.search_limbs`."""
    cameras: Literal["both", "own"] = "own"
    """Instead of `cameras`: fits of a film and of its mirror image disagree by some pixels."""


class OneSide(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Values that replace others where all frames see the animal from one side (docs/experiments/held-skin.md)."""

    when: Literal["never", "known", "always"] = "never"
    """Where they are used: "known" where cameras are known, "always" for footage of unknown cameras too."""
    samples: Count = 12_000
    """Instead of `canonical.samples`."""
    thickness: Positive = 0.3
    """Instead of `canonical.thickness`."""
    opacity: Opacity = 0.98
    """Instead of `canonical.opacity`."""
    max_scale: Weight = 0.009
    """Instead of `canonical.max_scale`: where a foot is not where the prior has it, a few large ones blur it."""
    pull: Weight = 5.0
    """Instead of `prior.pull`."""
    pull_until: Weight = 0.35
    """Instead of `prior.pull_until`."""
    untold: Weight = 0.2
    """Instead of `prior.untold`."""
    temporal: Weight = 5.0
    """Instead of `geometry.temporal`."""
    turns: bool = False
    """Instead of `pose.turns`: what one side tells of a turn may be false."""
    stray: Weight = 100.0
    """Instead of `geometry.stray`."""
    colors_epsilon: Positive = 1e-4
    """Instead of `rates.colors_epsilon`."""
    cap: Count = 16_000
    """Instead of `density.cap`."""
    skin: Skin = Skin(disc=0.05, bind=0.02, evidence=0.03, heights=1e-3, follow=True)
    """Instead of `skin`."""


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of `ours`; the defaults are the paper's profile, presets change them."""

    image_size: Size = 512
    """Longest training image side, pixels; larger clips are reduced."""
    iterations: Count = 20_000
    """Steps of the main stage (paper)."""
    steps_per_frame: Whole = 0
    """Least steps for every frame of the clip; 0 leaves it at `iterations`."""
    short_frames: Whole = 0
    """Most frames of a clip that takes `short_iterations` steps (paper: APTv2's 15, less its test frames)."""
    short_iterations: Count = 10_000
    """Most steps on a short clip (paper)."""
    mirrored: Share = 0.5
    """Share of the steps that see a mirror image (paper: half)."""
    cameras: Literal["both", "own"] = "both"
    """Cameras of an image: those of both groups (paper), or only those fitted to it ("own", m = v). Equal views where
    cameras are known."""
    checkpoint_every: Count = 500
    """Steps between checkpoints, where a work folder is given."""
    canonical: Canonical = Canonical()
    skinning: Skinning = Skinning()
    pose: Pose = Pose()
    deform: Deform = Deform()
    prior: PriorUse = PriorUse()
    warmup: WarmUp = WarmUp()
    loss: Loss = Loss()
    geometry: Geometry = Geometry()
    skin: Skin = Skin()
    rates: Rates = Rates()
    density: Density = Density()
    footage: Footage = Footage()
    one_side: OneSide = OneSide()
