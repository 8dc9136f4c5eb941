"""The whole configuration of `ours`: one tree of frozen structs.

Section numbers are the design's method notes. "fraction" means a share of `Config.iterations`, so that presets of every
length follow one schedule. Lengths without a unit are in the object frame, whose rest diagonal is 5.
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Count = Annotated[int, Meta(ge=1)]
Whole = Annotated[int, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
Weight = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Opacity = Annotated[float, Meta(gt=0, lt=1)]
Degree = Annotated[int, Meta(ge=0, le=3)]
Size = Annotated[int, Meta(ge=16)]
Rate = tuple[Positive, Positive]


def _require_heads(width: int, heads: int) -> None:
    if heads < 1 or width % heads:
        raise ValueError(f"expected a width that is a multiple of the heads, got {width} and {heads}")


class Canonical(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The canonical Gaussians (section 3)."""

    samples: Count = 15_000
    """Gaussians at the start: area-uniform samples of the prior's rest surface."""
    thickness: Positive = 0.5
    """Scale along the normal over the scale in the surface: flat enough for a normal, thick enough edge-on."""
    opacity: Opacity = 0.9
    """At the start; 0.1 leaves the silhouette too weak when the pose loss begins."""
    sh_degree: Degree = 0
    """Spherical harmonics of colour, 0 to 3; lighting is not mirror-symmetric and views are few (paper: 3)."""
    sh_every: Positive = 0.05
    """Fraction after which one more degree joins (1k of 20k)."""
    max_scale: Positive = 0.05
    """Largest standard deviation, times the rest diagonal: one huge Gaussian hides a wrong pose."""


class Skinning(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The learnable skinning field (section 3)."""

    resolution: Annotated[int, Meta(ge=2)] = 32
    """Voxels along each axis of the cubic field (paper)."""
    margin: Positive = 1.2
    """Half-size of the cube over half the longest side of the rest shape, so that points can leave the surface."""
    neighbours: Count = 8
    """Vertices averaged by inverse distance to fill a voxel; 30 mix both legs of a pair."""
    sweeps: Whole = 2
    """Neighbour averages; 30 (SelfRecon) moved the posed prior by 5 times as much."""
    keep: Share = 0.7
    """Share of itself that a voxel keeps in a sweep."""
    floor: Positive = 1e-3
    """Added before the logarithm, so that every part can still gain any voxel."""
    tied: bool = False
    """Average the logits with their mirror image (left and right exchanged)."""
    learn: bool = True
    """False freezes the field (the paper's "fixed skinning" ablation)."""


class Pose(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Part anchors and the pose network (section 4)."""

    anchor_size: Count = 8
    """Length of a part anchor (paper)."""
    anchor_std: Weight = 1.0
    """At 0.1 all joints turn alike for ever; 1 tells them apart."""
    frequencies: Count = 4
    """Octaves of the time code; 4 fitted better than 6 in the measured prototype (24 frames)."""
    octave_frames: Whole = 24
    """Frames of a clip that `frequencies` octaves are for; one octave more for each doubling; 0 leaves it at them. Six
    for four: camel (72 training frames) 24.98 for 24.90 dB, cows (83) 23.45 for 23.26 (8: 23.36), one seed each."""
    encoding: Literal["group", "view"] = "group"
    """Sign that turns time in the code: the group's m, or the image's v ("w/o Symm. Enc."); of no use where `tied`."""
    explicit_group: bool = False
    """Append the group sign m to the code."""
    width: Count = 128
    """Width of a token: a per-video network needs less than an animal-general one (256)."""
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
    """Pose of a flipped image = mirror image of that of the image, not its own (see baselines/presets/ours.toml)."""

    def __post_init__(self) -> None:
        _require_heads(self.width, self.heads)


class Deform(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Part-conditioned deformation (section 5)."""

    enabled: bool = True
    """False is the paper's "w/o Deform" ablation."""
    anchors: bool = True
    """The query holds skinning weights times part anchors; False: the weights themselves ("w/o Part Anchors")."""
    width: Count = 64
    """Hidden width. 128 for 64: +0.03 dB on one horse, +0.3 on one cow (one seed), 0 on the cows of DAVIS."""
    heads: Count = 4
    """Attention heads over the parts."""
    frequencies: Whole = 6
    """Octaves of the position code."""
    reach: Positive = 0.1
    """Displacement per unit of output."""
    max_log_scale: Positive = 1.0
    """Bound on the change of log scale (tanh): unbounded offsets make points fly off."""
    half: bool = True
    """Factors of the network's products in bfloat16 where a CPU multiplies such pairs (sums keep single precision)."""
    sampled: Whole = 2000
    """Gaussians that stand for all in the network's own gradients (ours/fused/sampled_rows.py); 0: all."""
    ramp_start: Weight = 0.05
    """Fraction at which the deformation starts to fade in: the pose explains the motion first."""
    ramp_end: Weight = 0.15
    """Fraction at which it acts in full."""
    detach_features: bool = False
    """Keep the appearance losses out of the part features too (the strict reading of gradient isolation)."""

    def __post_init__(self) -> None:
        _require_heads(self.width, self.heads)


class PriorUse(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the prior's shape gives to the start, and its poses to what follows (sections 3 and 4)."""

    shape: bool = True
    """Start on the prior's rest surface; False: anywhere in its box ("w/o Shape Prior"; skinning and poses keep it)."""
    blend: bool = False
    """Blend the prior's poses into the network's (paper; off on Artemis: after a warm-up it only undoes that)."""
    blend_until: Share = 0.35
    """Fraction at which the blend reaches zero (7k of 20k)."""
    pull: Weight = 0.3
    """Weight of the squared distance to the prior's poses, falling linearly to zero at `pull_until` (paper: open). 50
    for 5 in 1,500 steps, one seed each: horse +0.1, wolf +0.2, cow -0.5, fox -0.2 dB."""
    pull_until: Weight = 1.0
    """Fraction at which the pull ends (paper: 4k of 20k); above 1 it is still on at the end."""


class WarmUp(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The pose warm-up: poses from blurred silhouettes, Gaussians frozen (section 11.3)."""

    iterations: Whole = 0
    """Steps on silhouettes. 600 of them after a fitted prior changed the held-out mask IoU by -.04 (horse, Walk) and
    +.01 (wolf, Gallop), one seed each: off. A prior without poses needs it (section 11)."""
    regress: Whole = 300
    """Steps before those that only copy the prior's poses into the network (zero for both leaves the stage out)."""
    copies: Count = 48
    """Poses a step of those; a handful has not reached the prior by the end."""
    views: Count = 4
    """Images a step."""
    samples: Count = 2500
    """Gaussians that stand for the body: silhouettes need few."""
    size: Size = 160
    """Longest image side."""
    blur: Weight = 0.06
    """Blur at the start, times the side of the animal's box, falling linearly to zero: reaches limbs apart."""
    regress_rate: Positive = 2e-3
    """Learning rate of the pose network while it copies."""
    rate: Positive = 5e-4
    """Learning rate on silhouettes."""
    pull: Weight = 0.3
    """Weight of the pull to the prior's poses, falling linearly to zero."""


class Loss(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Image losses of the two branches (section 6)."""

    isolated: bool = True
    """No gradient of the appearance reaches the joints (paper). Off: +.18 dB over eight animals of known cameras."""
    pose_silhouette: Weight = 0.2
    """BCE + Dice of the pose branch (paper)."""
    l1: Weight = 0.8
    """Colour of the deformed branch (paper)."""
    ssim: Weight = 0.2
    """One minus SSIM, deformed branch (paper)."""
    silhouette: Weight = 0.1
    """BCE + Dice of the deformed branch (paper)."""
    random_background: bool = True
    """One random colour a step behind render and target: floaters cannot hide in a known background."""


class Geometry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Regularisers: the paper's three, and a skeleton's (sections 6, 9, 11.6)."""

    until: Weight = 0.5
    """Fraction at which the paper's three end (10k of 20k)."""
    tv: Weight = 10.0
    """Total variation of the skinning probabilities (paper)."""
    tv_delta: Positive = 0.05
    """Where the Huber function turns linear (paper)."""
    tv_every: Count = 1
    """Steps between evaluations, weight multiplied accordingly (the next two likewise)."""
    compact: Weight = 0.1
    """Compactness of the parts (paper)."""
    compact_power: Positive = 2.0
    """Exponent on the weights: a squared weight leaves less torso in every part."""
    compact_every: Count = 4
    """Steps between evaluations; +.02 dB in the mean of 24 pairs with `deform.sampled` (results)."""
    smooth: Weight = 0.1
    """Smoothness of rendered normals (paper)."""
    smooth_every: Count = 2
    """Steps between evaluations."""
    smooth_size: Size = 256
    """Side of the square image of normals."""
    limit: Weight = 1.0
    """Pose: penalty on turning more than `limit_degrees` against the parent."""
    limit_degrees: Positive = 70.0
    """Wider than any joint of a quadruped needs between two bones of the template."""
    attach: Weight = 20.0
    """Pose: squared gap between a joint and its parent there, over the squared diagonal; not measured alone."""
    limb_plane: Weight = 0.0
    """Pose: squared turn of a limb's bone against its parent out of the plane along the body (half radians)."""
    body_plane: Weight = 0.0
    """Pose: the same of the other bones."""
    sideways: Weight = 0.0
    """Pose: squared gap of a limb's joint and its parent across the body (diagonals), beside `attach`."""
    temporal: Weight = 10.0
    """Pose: squared second difference over neighbouring frames; not measured alone."""
    still: Weight = 0.0
    """Pose: steps between neighbouring frames as Geman and McClure weigh them: what drifts slowly is held still."""
    still_step: Positive = 1e-3
    """Step of a rotation (half radians) or joint (diagonals) between drift and motion; tried: results."""
    rigid: Weight = 1.0
    """Deformed branch: change of distance between canonical neighbours; +0.3 dB on one horse (and fewer Gaussians)."""
    rigid_neighbours: Count = 5
    """Neighbours a Gaussian is compared with."""
    steady: Weight = 0.1
    """Deformed branch: squared change of log scale. Unchecked, scales grow while the deformation shrinks them again."""


class Rates(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Learning rates (section 6, Schedule); pairs fall exponentially from the first to the second."""

    means: Rate = (8e-4, 8e-6)
    """Positions: 1.6e-4 and 1.6e-6 at a scene size of 5."""
    quats: Weight = 1e-3
    """Orientations."""
    log_scales: Weight = 5e-3
    """Scales."""
    logit_opacities: Weight = 1e-2
    """5e-2 makes moving legs transparent within 200 iterations, before the pose has moved."""
    colors: Weight = 2.5e-3
    """Colours."""
    skinning: Rate = (1e-3, 1e-4)
    """Logits of the field."""
    pose: Rate = (6e-4, 1e-5)
    """Anchors and pose network; 2e-4 was 0.6 dB worse on one horse in 1,500 steps (with more Gaussians)."""
    rise: Weight = 0.02
    """Fraction over which the networks' rates rise from zero: Adam's first steps would undo the warm-up."""
    deform: Rate = (8e-4, 1.6e-6)
    """Deformation network. At (2e-3, 2e-5) animals differ by .1 dB at most (one seed); of films see `Footage`."""
    clip: Positive = 1.0
    """Bound on the gradient norm of the networks."""


class Density(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Densification with a cap (section 6)."""

    start: Weight = 0.025
    """Fraction of the first round (500 of 20k)."""
    end: Weight = 0.5
    """Fraction of the last: unregularised points appear once the geometric losses stop."""
    every: Positive = 0.005
    """Fraction between rounds (100 of 20k)."""
    gradient: Weight = 4e-4
    """Mean image gradient above which a Gaussian is refined, in half sides of the animal's box."""
    split_scale: Positive = 0.01
    """Split above this scale (times the rest diagonal), clone below."""
    prune_opacity: Share = 0.01
    """Gaussians below this opacity are removed."""
    prune_radius: Positive = 0.2
    """Gaussians that cover more than this share of the image's longest side are removed."""
    cap: Count = 40_000
    """Most Gaussians: memory, and the speed of every later step."""


class Footage(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Other values for a film of which nobody knows the cameras. One camera follows the animal and sees the same side
    from frame to frame, so that poses need less smoothing than between cameras that stand apart; and the prior has to
    guess the camera too, so that its poses are held for a shorter time. Held-out PSNR of DAVIS cows, standard, seed 0,
    every run made with `cameras` "both": 23.45 without; 23.52 with `deform` (its end 2e-5); 23.65 and `rigid`; 23.78
    and `temporal`; 23.85 and `pull_until` and 10,000 Gaussians for 6,000; 24.16 with all that stands here and 200
    steps a frame; 23.29 with rates that end at 1e-4 (`deform`, `pose`), `temporal` 3, 8,000 Gaussians and 125 steps a
    frame. The camel, which had no part in the choice: 25.92 for 24.98. With `cameras` "own": cows 24.85, camel 26.29;
    with 250 steps a frame too 24.85 and 26.41, LPIPS .135 for .143 and .119 for .123."""

    use: bool = True
    """False: the values below are not used (the paper has none of them)."""
    steps_per_frame: Whole = 250
    """Instead of `steps_per_frame`."""
    temporal: Weight = 5.0
    """Instead of `geometry.temporal`."""
    rigid: Weight = 0.2
    """Instead of `geometry.rigid`."""
    pull_until: Weight = 0.35
    """Instead of `prior.pull_until`."""
    pose: Rate = (7e-4, 1e-5)
    """Instead of `rates.pose`."""
    deform: Rate = (2e-3, 1e-5)
    """Instead of `rates.deform`."""
    cameras: Literal["both", "own"] = "own"
    """Instead of `cameras`: fits of a film and of its mirror image disagree by some pixels (cows: 3 of 512 in the mean,
    10 at worst), and poses cannot follow both. Cows, 60 steps a frame, one seed: 23.78 for 23.23 dB; the first group
    alone 23.70; with poses of its own for each group (`pose.encoding` group) 23.11."""


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`ours`; the defaults are the paper's profile, presets change them."""

    image_size: Size = 512
    """Longest image side it trains at; larger clips are reduced."""
    iterations: Count = 20_000
    """Steps of the main stage (paper)."""
    steps_per_frame: Whole = 0
    """At least so many steps for every frame of the clip; 0 leaves it at `iterations`."""
    short_frames: Whole = 0
    """Clips of so many frames or fewer take `short_iterations` steps (paper: APTv2's 15, less its test frames)."""
    short_iterations: Count = 10_000
    """Most steps on a short clip (paper)."""
    mirrored: Share = 0.5
    """Share of the steps that see a mirror image (paper: half). Mirror images teach the side that no camera saw; what
    cameras did see they pull towards its mirror image. .125 for .5 (standard, poses tied, one seed each, sweep, held-
    out PSNR): pinto horse 25.6 for 24.4, tiger 22.6 for 22.2; symmetric coats: cow 27.4 for 27.3, fox 20.5 for 20.7."""
    cameras: Literal["both", "own"] = "both"
    """Cameras that an image is seen from: those of both groups (paper), or those alone that were fitted to it: frames
    from the first group's, mirror images from the second's (m = v). Where cameras are known both show the same views,
    and only `pose.encoding` "group" tells them apart."""
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
    rates: Rates = Rates()
    density: Density = Density()
    footage: Footage = Footage()
