"""Settings of the template fit."""

from typing import Literal

import msgspec

Use = Literal["all", "half", "none"]
"""Frames whose keypoints a fit sees: all; every other one, and the rest is scored; none, and all are scored."""


class Stage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One round of gradient descent on all remaining hypotheses.

    Attributes:
        size: side of the square crops in pixels.
        steps: of Adam.
        frames: used in each step; of longer clips as many are drawn at random.
        blur: standard deviation of the blur of both silhouettes at the first and last step, as a share of the crop.
        keep: most hypotheses that survive; if two or more, the best of the opposite heading is among them unless its
            misfit is far higher (`race.LOST`).
        joints: fit joint angles and their motion.
        rasterized: draw silhouettes by the rasterizer; otherwise by its batched approximation.
        relief: fit the cross sections too, beyond the proportions.
        colors: fit colours of the surface too, and compare them with the images; left out where all cameras look one
            way.
        pace: factor of the learning rate.
    """

    size: int
    steps: int
    blur: tuple[float, float]
    keep: int
    joints: bool = True
    frames: int = 24
    rasterized: bool = False
    relief: bool = False
    colors: bool = False
    pace: float = 1.0


class PriorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the fit; weights multiply the named term of the cost.

    Attributes:
        stages: rounds, from all starts to one winner.
        yaw_starts: starts, at even yaws: the heading is a local minimum.
        elevations: camera elevations in degrees, tried where the cameras leave the up direction open.
        learning_rate: of Adam at the start of each round, per standard deviation of a parameter.
        shape_weight: mean squared deviation of the proportions from the average animal, in standard deviations.
        relief_weight: mean squared relief of the cross sections, in standard deviations.
        density_weight: mean squared deviation from the shapes of random animals, where these are known; instead of the
            two before.
        angle_weight: squared joint angles, in standard deviations; fast motion counts more.
        straight_weight: squared mean yaw and roll of head, neck, trunk and tail, in standard deviations, where shapes
            are known: an animal that bends sideways looks shorter to one camera.
        root_weight: squared motion and tilt of the root, in standard deviations; fast motion counts more.
        view_weight: squared cosine between heading and viewing direction, where all cameras look one way: an animal at
            an angle looks like a shorter one.
        least_turn: span of headings that a network reads, degrees, from which all guesses turn as the readings do.
        heading_weight: nats below the heading that a network finds likeliest, likewise.
        turned_weight: the same of an animal that turns before unknown cameras.
        gait_weight: feet on the ground that move towards the head, when hypotheses are compared.
        travel_weight: heading against the direction of travel, when hypotheses are compared.
        carriage_weight: heads folded into the body and raised tails, under unknown cameras.
        color_weight: robust distance of colours, in stages that fit them.
        keypoint_weight: robust distance of joints to keypoints.
        points_weight: robust distance of joints to the points that a network finds, in its expected errors, where
            there is one.
        root_period: frames for each term of the root's motion.
    """

    stages: tuple[Stage, ...]
    yaw_starts: int = 12
    elevations: tuple[float, ...] = (5.0, 20.0, 40.0)
    learning_rate: float = 0.06
    shape_weight: float = 0.02
    relief_weight: float = 0.015
    density_weight: float = 0.03
    angle_weight: float = 0.15
    straight_weight: float = 0.03
    root_weight: float = 0.2
    view_weight: float = 0.01
    least_turn: float = 40.0
    heading_weight: float = 0.03
    turned_weight: float = 0.06
    gait_weight: float = 0.015
    travel_weight: float = 0.08
    carriage_weight: float = 1.0
    color_weight: float = 4.0
    keypoint_weight: float = 0.1
    points_weight: float = 0.0
    root_period: int = 4


COLORS = Stage(
    size=96, steps=300, blur=(0.03, 0.005), keep=1, frames=12, rasterized=True, relief=True, colors=True, pace=0.33
)
"""The round that looks at colours too."""
STANDARD = PriorConfig(
    stages=(
        Stage(size=32, steps=40, blur=(0.08, 0.04), keep=6, joints=False, frames=12),
        Stage(size=48, steps=80, blur=(0.05, 0.03), keep=2),
        Stage(size=64, steps=150, blur=(0.04, 0.015), keep=2),
        Stage(size=80, steps=250, blur=(0.02, 0.006), keep=1, rasterized=True, relief=True),
        COLORS,
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


def with_points(config: PriorConfig) -> PriorConfig:
    """Return the settings of a fit that has a network's points too: they speak of motion that masks leave open."""
    return msgspec.structs.replace(
        config, points_weight=0.05, angle_weight=0.03, root_weight=0.05, root_period=2, gait_weight=0.0
    )


def without_colors(config: PriorConfig) -> PriorConfig:
    """Return the settings of a fit to masks alone."""
    stages = tuple(stage for stage in config.stages if not stage.colors)
    return msgspec.structs.replace(config, stages=stages)


PRESETS = {"quick": QUICK, "standard": STANDARD}
