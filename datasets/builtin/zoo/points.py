"""Named points of an animal's body that a quadruped template has too, from its skeleton."""

import numpy as np

from rewild4d.datasets.builtin.anatomy import Skeleton
from rewild4d.datasets.builtin.zoo.bodies import Proportions

ABOVE = 0.45
"""Height of withers, back and hips above the spine's nodes, in radii of the trunk."""
LEGS = {"front": "fore", "rear": "hind"}
JOINTS = {"top": 0, "upper": 1, "lower": 2}
"""Bone of a leg that starts at each joint; its last one ends at the foot."""


def body_points(skeleton: Skeleton, plan: Proportions) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return points of an animal at rest; one on two legs lacks those of forelegs.

    Args:
        skeleton: at rest in the body frame, metres.
        plan: its proportions.

    Returns:
        Names of `priors.landmarks.LANDMARKS`, the bone that carries each, int64, [L], and their places at rest, [L, 3].
    """
    found = _spine(skeleton, plan)
    for end, limb in LEGS.items():
        if f"{limb}.0.L" not in skeleton.names:
            continue
        for side, mark in (("left", "L"), ("right", "R")):
            for joint, bone in JOINTS.items():
                found[f"{end}_{side}_{joint}"] = _start(skeleton, f"{limb}.{bone}.{mark}")
            found[f"{end}_{side}_foot"] = _end(skeleton, f"{limb}.3.{mark}")
    bones, places = zip(*found.values(), strict=True)
    return tuple(found), np.array(bones), np.stack(places)


def _spine(skeleton: Skeleton, plan: Proportions) -> dict[str, tuple[int, np.ndarray]]:
    rise = ABOVE * plan.size * np.array((0.0, 1.0, 0.0))
    hips, girth = skeleton.names.index("spine.0"), plan.girth
    back, chest = skeleton.names.index("spine.1"), skeleton.names.index("spine.2")
    middle = 0.5 * (skeleton.heads[back] + skeleton.tails[back])
    return {
        "nose": _end(skeleton, "head"),
        "poll": _start(skeleton, "head"),
        "neck": _start(skeleton, "neck.1"),
        "withers": (chest, skeleton.tails[chest] + girth[2] * rise),
        "back": (back, middle + girth[1] * rise),
        "hips": (hips, skeleton.heads[hips] + girth[0] * rise),
        "tail_root": _start(skeleton, "tail.0"),
        "tail_middle": _start(skeleton, "tail.2"),
        "tail_tip": _end(skeleton, "tail.3"),
    }


def _start(skeleton: Skeleton, name: str) -> tuple[int, np.ndarray]:
    bone = skeleton.names.index(name)
    return bone, skeleton.heads[bone]


def _end(skeleton: Skeleton, name: str) -> tuple[int, np.ndarray]:
    bone = skeleton.names.index(name)
    return bone, skeleton.tails[bone]
