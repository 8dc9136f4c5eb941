"""The quadruped: a trunk between front and rear legs, with neck, head and tail."""

import torch
from torch import Tensor

from rewild4d.priors.bodies.body import Measure
from rewild4d.priors.bodies.tetrapod import ENDS, SPINE, Measures, Tetrapod, direction, head_sections, tail_sections
from rewild4d.priors.bodies.tubes import Section, point

HEAD_FORWARD, NOSE_FORWARD, POLL_FORWARD = 0.4, 0.35, 0.1
"""Least distance forwards of the nose from the poll, in head lengths; of nose and poll from the withers, in body
lengths."""


class Quadruped(Tetrapod):
    """A leg starts at its shoulder or hip; the chest's centre is near the origin."""

    name = "quadruped"
    table = {
        "body_length": Measure(1.75, 0.20),
        "chest_width": Measure(0.36, 0.25),
        "chest_height": Measure(0.46, 0.20),
        "belly_width": Measure(0.36, 0.25),
        "belly_height": Measure(0.40, 0.20),
        "hip_width": Measure(0.33, 0.25),
        "hip_height": Measure(0.42, 0.20),
        "chest_drop": Measure(0.0, 0.08, True),
        "belly_drop": Measure(0.0, 0.08, True),
        "front_leg": Measure(1.40, 0.25),
        "rear_leg": Measure(1.45, 0.25),
        "front_stance": Measure(0.20, 0.25),
        "rear_stance": Measure(0.20, 0.25),
        "front_thigh": Measure(0.17, 0.25),
        "rear_thigh": Measure(0.23, 0.25),
        "front_shank": Measure(0.085, 0.30),
        "rear_shank": Measure(0.085, 0.30),
        "paw": Measure(0.10, 0.30),
        "elbow_back": Measure(0.08, 0.08, True),
        "knee_forward": Measure(0.12, 0.10, True),
        "hock_back": Measure(0.16, 0.10, True),
        "neck_length": Measure(0.85, 0.30),
        "neck_angle": Measure(0.85, 0.40, True),
        "neck_base": Measure(0.29, 0.25),
        "neck_top": Measure(0.19, 0.25),
        "head_length": Measure(0.72, 0.25),
        "head_angle": Measure(-0.45, 0.30, True),
        "head_height": Measure(0.20, 0.25),
        "head_width": Measure(0.17, 0.25),
        "muzzle": Measure(0.10, 0.30),
        "tail_length": Measure(1.0, 0.40),
        "tail_angle": Measure(-0.95, 0.50, True),
        "tail_base": Measure(0.075, 0.35),
        "tail_middle": Measure(0.075, 0.45),
    }
    bends = {
        0: (0.30, 0.25, 0.10), 1: (0.35, 0.25, 0.10), 2: (0.40, 0.25, 0.10), 3: (0.10, 0.08, 0.04),
        4: (0.35, 0.35, 0.05), 5: (0.40, 0.40, 0.05), 6: (0.15, 0.10, 0.04), 7: (0.10, 0.08, 0.04),
        **{
            bone: (0.45, 0.05, 0.10) if bone in (10, 13) else (0.45, 0.0, 0.04)
            for end in ENDS[:2] for bone in range(end, end + 3)
        },
    }  # fmt: skip

    def spine(self, m: Measures) -> list[Tensor]:
        half, high = m["body_length"] / 2, 0.45 * m["chest_height"]
        zero = torch.zeros_like(half)
        withers, hips = point(high, half), point(0.45 * m["hip_height"], -half)
        neck = direction(m["neck_angle"]) * m["neck_length"][..., None]
        head = direction(m["head_angle"]) * m["head_length"][..., None]
        tail = direction(m["tail_angle"], -1.0) * m["tail_length"][..., None]
        root = hips + point(zero, -0.8 * m["hip_height"])
        return [
            withers + neck + head, withers + neck, withers + neck / 2, withers, point(high, zero),
            hips, root, root + tail / 2, root + tail,
        ]  # fmt: skip

    def limb(self, m: Measures, end: str) -> list[Tensor]:
        side = 1.0 if end == "front" else -1.0
        length, stance = m[f"{end}_leg"], m[f"{end}_stance"]
        top = side * m["body_length"] / 2
        if end == "front":
            knee, hock = top - m["elbow_back"], top
        else:
            knee, hock = top + m["knee_forward"], top - m["hock_back"]
        return [
            point(torch.zeros_like(length), top, stance),
            point(-0.36 * length, knee, stance),
            point(-0.68 * length, hock, stance),
            point(-length, top - (0.0 if end == "front" else 0.5) * m["hock_back"], stance),
        ]

    def trunk(self, m: Measures, joints: list[Tensor]) -> list[Section]:
        half, zero = m["body_length"] / 2, torch.zeros_like(m["body_length"])
        return [
            *head_sections(m, joints),
            (joints[3] + point(-0.35 * m["chest_height"], 0.12 * half), 0.8 * m["chest_width"], 1.2 * m["neck_base"]),
            (point(m["chest_drop"], 0.8 * half), m["chest_width"], m["chest_height"]),
            (point(m["belly_drop"], zero), m["belly_width"], m["belly_height"]),
            (point(zero, -0.75 * half), m["hip_width"], m["hip_height"]),
            (point(zero, -half - 0.45 * m["hip_height"]), 0.75 * m["hip_width"], 0.75 * m["hip_height"]),
            *tail_sections(m, joints),
        ]

    def limb_sections(self, m: Measures, joints: list[Tensor], end: str) -> list[Section]:
        return leg_sections(joints, m[f"{end}_thigh"], m[f"{end}_shank"], m["paw"])

    def carriage(self, bones: Tensor, transforms: Tensor) -> Tensor:
        """A head points forwards and lies before the withers, a tail hangs behind the hips."""
        turns = transforms[..., :3, :3]
        spine = transforms[:, :, :SPINE, None, :3, 3]
        ends = torch.einsum("btjac,bjkc->btjka", turns[:, :, :SPINE], bones[:, :SPINE]) + spine
        nose, poll, withers, tip, hips = (
            ends[:, :, bone, end] for bone, end in ((0, 1), (0, 0), (3, 1), (4, 1), (6, 0))
        )
        length = (bones[:, 3, 1, 2] - bones[:, 6, 0, 2])[:, None]
        head = (bones[:, 0, 1] - bones[:, 0, 0]).norm(dim=-1)[:, None]
        faults = (
            HEAD_FORWARD * head - (nose - poll)[..., 2],
            NOSE_FORWARD * length - (nose - withers)[..., 2],
            POLL_FORWARD * length - (poll - withers)[..., 2],
            (tip - hips)[..., 1],
            (tip - hips)[..., 2],
        )
        return (torch.stack(faults).clamp_min(0) / length).square().mean(2).sum(0)


def leg_sections(joints: list[Tensor], thigh: Tensor, shank: Tensor, paw: Tensor) -> list[Section]:
    """Return sections of a left leg through its four joints, from inside the body to the toes."""
    top, knee, hock, foot = joints
    lift, forward = point(0.9 * thigh, torch.zeros_like(thigh)), point(torch.zeros_like(paw), paw)
    return [
        (top + lift, 0.4 * thigh, 0.6 * thigh),
        (top, 0.8 * thigh, 1.3 * thigh),
        (0.45 * top + 0.55 * knee, 0.7 * thigh, 1.1 * thigh),
        (knee, 0.5 * (thigh + shank), 0.5 * (thigh + shank)),
        (0.5 * (knee + hock), 1.05 * shank, 1.15 * shank),
        (hock, shank, shank),
        (0.5 * (hock + foot), 0.9 * shank, 0.9 * shank),
        (foot, 0.9 * paw, paw),
        (foot + 0.7 * forward + 0.1 * (foot - hock), 0.5 * paw, 0.6 * paw),
    ]


QUADRUPED = Quadruped()
