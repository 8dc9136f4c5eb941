"""Every choice of the template fit."""

from typing import Literal

import msgspec

Use = Literal["all", "half", "none"]
"""Frames whose keypoints a fit sees: all; every other one, and the rest is scored; none, and all are scored."""


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One round of gradient descent on all hypotheses that are still in the race.

    Attributes:
        size: side of the square crops in pixels; early rounds only need the gross outline.
        steps: of Adam.
        frames: per step; of longer clips as many are drawn anew each step, so that time does not grow with the clip.
        blur: of both silhouettes at the first and last step, as a share of the crop: a thin leg must feel a far one.
        keep: hypotheses that survive; the best of the opposite facing is always among them while two or more do.
        joints: whether joints bend and the root moves over time, or the animal stands still.
        rasterized: silhouettes by the benchmark's rasterizer; otherwise by its batched stand-in.
        relief: whether the cross sections may leave what the proportions make of them.
    """

    size: int
    steps: int
    blur: tuple[float, float]
    keep: int
    joints: bool = True
    frames: int = 24
    rasterized: bool = False
    relief: bool = False


class PriorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the template is fitted.

    Attributes:
        yaw_starts: facing is a local minimum, so every start turns the template by an equal share of the circle.
        elevations: camera elevations (degrees) tried where the cameras alone do not tell which way is up.
        stages: rounds, from all starts to one winner.
        learning_rate: of Adam at the start of each round, on parameters whitened by their natural spread.
        shape_weight: of the mean squared deviation of proportions: an average animal unless the masks insist.
        relief_weight: of the mean squared relief of the cross sections.
        angle_weight: of the squared whitened joint angles: limbs rest, and move slowly, unless the masks insist.
        root_weight: of the squared whitened root motion and tilt: a sweeping camera sees each moment once.
        view_weight: of the squared cosine between heading and a single direction of view: seen from one side only, a
            turned animal looks like a shorter one, and its outline hardly changes near the broadside.
        gait_weight: of feet that bear weight and move forwards, when guesses are compared: outlines alone hardly tell
            the head of a bushy-tailed animal.
        travel_weight: of heads that point against the way the animal goes, when guesses are compared.
        carriage_weight: of heads folded into the body and tails carried like necks, under unknown cameras.
        keypoint_weight: of the robust distance of joints to keypoints.
    """

    stages: tuple[Stage, ...]
    yaw_starts: int = 12
    elevations: tuple[float, ...] = (5.0, 20.0, 40.0)
    learning_rate: float = 0.06
    shape_weight: float = 0.02
    relief_weight: float = 0.015
    angle_weight: float = 0.15
    root_weight: float = 0.2
    view_weight: float = 0.01
    gait_weight: float = 0.015
    travel_weight: float = 0.08
    carriage_weight: float = 1.0
    keypoint_weight: float = 0.1


STANDARD = PriorConfig(
    stages=(
        Stage(size=32, steps=40, blur=(0.08, 0.04), keep=6, joints=False, frames=12),
        Stage(size=48, steps=80, blur=(0.05, 0.03), keep=2),
        Stage(size=64, steps=150, blur=(0.04, 0.015), keep=2),
        Stage(size=80, steps=250, blur=(0.02, 0.006), keep=1, rasterized=True, relief=True),
    )
)
QUICK = PriorConfig(
    stages=(
        Stage(size=32, steps=30, blur=(0.08, 0.04), keep=4, joints=False, frames=12),
        Stage(size=40, steps=60, blur=(0.05, 0.03), keep=2),
        Stage(size=48, steps=60, blur=(0.04, 0.02), keep=1),
        Stage(size=64, steps=80, blur=(0.02, 0.008), keep=1, rasterized=True, relief=True),
    )
)
FOOTAGE = PriorConfig(
    stages=(
        Stage(size=32, steps=50, blur=(0.08, 0.04), keep=6, joints=False, frames=12),
        Stage(size=48, steps=80, blur=(0.05, 0.03), keep=4, frames=16),
        Stage(size=64, steps=150, blur=(0.04, 0.015), keep=1, frames=16),
        Stage(size=80, steps=250, blur=(0.02, 0.006), keep=1, rasterized=True, relief=True),
    ),
    shape_weight=0.035,
    view_weight=0.06,
)
PRESETS = {"quick": QUICK, "standard": STANDARD}
