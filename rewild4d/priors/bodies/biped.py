"""Animals on two legs: birds, kangaroos, dinosaurs; their front limbs are wings or arms."""

import torch
from torch import Tensor

from rewild4d.priors.bodies.body import Measure
from rewild4d.priors.bodies.quadruped import leg_sections
from rewild4d.priors.bodies.tetrapod import Measures, Tetrapod, direction, head_sections, tail_sections
from rewild4d.priors.bodies.tubes import Section, point

HEAD_FORWARD, NOSE_FORWARD = 0.3, 0.1
"""Least distance forwards of the nose from the poll, in head lengths, and from the withers, in body lengths."""


class Biped(Tetrapod):
    """A trunk that rises towards the chest, on two legs; wings hang like arms at rest and are raised sideways."""

    name = "biped"
    table = {
        "body_length": Measure(1.15, 0.30),
        "body_pitch": Measure(0.35, 0.35, True),
        "chest_width": Measure(0.30, 0.30),
        "chest_height": Measure(0.34, 0.30),
        "belly_width": Measure(0.33, 0.30),
        "belly_height": Measure(0.38, 0.30),
        "hip_width": Measure(0.28, 0.30),
        "hip_height": Measure(0.32, 0.30),
        "chest_drop": Measure(0.0, 0.08, True),
        "belly_drop": Measure(0.0, 0.08, True),
        "rear_leg": Measure(1.30, 0.30),
        "rear_stance": Measure(0.20, 0.30),
        "rear_thigh": Measure(0.22, 0.35),
        "rear_shank": Measure(0.08, 0.35),
        "leg_forward": Measure(0.12, 0.15, True),
        "knee_forward": Measure(0.20, 0.15, True),
        "hock_back": Measure(0.12, 0.15, True),
        "hock_height": Measure(0.68, 0.10, True),
        "foot": Measure(0.30, 0.40),
        "paw": Measure(0.07, 0.30),
        "front_arm": Measure(0.60, 0.60),
        "front_back": Measure(0.45, 0.50, True),
        "front_width": Measure(0.05, 0.40),
        "front_chord": Measure(0.10, 0.60),
        "neck_length": Measure(0.55, 0.50),
        "neck_angle": Measure(1.0, 0.40, True),
        "neck_base": Measure(0.20, 0.35),
        "neck_top": Measure(0.13, 0.35),
        "head_length": Measure(0.48, 0.40),
        "head_angle": Measure(-0.2, 0.35, True),
        "head_height": Measure(0.15, 0.35),
        "head_width": Measure(0.13, 0.35),
        "muzzle": Measure(0.06, 0.40),
        "tail_length": Measure(0.90, 0.60),
        "tail_angle": Measure(-0.15, 0.45, True),
        "tail_base": Measure(0.12, 0.50),
        "tail_middle": Measure(0.07, 0.50),
    }
    feet = (11, 14)
    bends = {
        0: (0.35, 0.30, 0.10), 1: (0.40, 0.30, 0.10), 2: (0.45, 0.30, 0.10), 3: (0.15, 0.08, 0.04),
        4: (0.35, 0.35, 0.05), 5: (0.35, 0.35, 0.05), 6: (0.20, 0.15, 0.04), 7: (0.15, 0.08, 0.04),
        8: (0.40, 0.20, 0.30), 9: (0.60, 0.20, 0.40), 10: (0.70, 0.30, 0.80),
        11: (0.60, 0.0, 0.04), 12: (0.60, 0.0, 0.04), 13: (0.60, 0.05, 0.10),
    }  # fmt: skip
    reach = {10: (1.6, 1.1, 1.7), 11: (1.6, 1.1, 1.1), 12: (1.6, 1.1, 1.1)}

    def spine(self, m: Measures) -> list[Tensor]:
        half, high = m["body_length"] / 2, 0.45 * m["chest_height"]
        withers, hips = _pitched(m, high, half), _pitched(m, 0.45 * m["hip_height"], -half)
        neck = direction(m["neck_angle"]) * m["neck_length"][..., None]
        head = direction(m["head_angle"]) * m["head_length"][..., None]
        tail = direction(m["tail_angle"], -1.0) * m["tail_length"][..., None]
        root = _pitched(m, 0.45 * m["hip_height"], -half - 0.8 * m["hip_height"])
        return [
            withers + neck + head, withers + neck, withers + neck / 2, withers,
            _pitched(m, high, torch.zeros_like(half)), hips, root, root + tail / 2, root + tail,
        ]  # fmt: skip

    def limb(self, m: Measures, end: str) -> list[Tensor]:
        half = m["body_length"] / 2
        return self._arm(m, half) if end == "front" else self._leg(m, half)

    def _arm(self, m: Measures, half: Tensor) -> list[Tensor]:
        top = _pitched(m, 0.1 * m["chest_height"], 0.8 * half) + point(
            torch.zeros_like(half), torch.zeros_like(half), 0.8 * m["chest_width"]
        )
        # from straight down towards the tail
        along = direction(m["front_back"] - torch.pi / 2, -1.0) * m["front_arm"][..., None]
        return [top, top + 0.4 * along, top + 0.75 * along, top + along]

    def _leg(self, m: Measures, half: Tensor) -> list[Tensor]:
        length, stance = m["rear_leg"], m["rear_stance"]
        top = _pitched(m, torch.zeros_like(half), m["leg_forward"] - half)
        y, z = top[..., 1], top[..., 2]
        return [
            point(y, z, stance),
            point(y - 0.5 * m["hock_height"] * length, z + m["knee_forward"], stance),
            point(y - m["hock_height"] * length, z - m["hock_back"], stance),
            point(y - length, z, stance),
        ]

    def trunk(self, m: Measures, joints: list[Tensor]) -> list[Section]:
        half, zero = m["body_length"] / 2, torch.zeros_like(m["body_length"])
        throat = joints[3] + _pitched(m, -0.35 * m["chest_height"], 0.12 * half)
        return [
            *head_sections(m, joints),
            (throat, 0.8 * m["chest_width"], 1.2 * m["neck_base"]),
            (_pitched(m, m["chest_drop"], 0.8 * half), m["chest_width"], m["chest_height"]),
            (_pitched(m, m["belly_drop"], zero), m["belly_width"], m["belly_height"]),
            (_pitched(m, zero, -0.75 * half), m["hip_width"], m["hip_height"]),
            (_pitched(m, zero, -half - 0.45 * m["hip_height"]), 0.75 * m["hip_width"], 0.75 * m["hip_height"]),
            *tail_sections(m, joints),
        ]

    def limb_sections(self, m: Measures, joints: list[Tensor], end: str) -> list[Section]:
        if end == "rear":
            sections = leg_sections(joints, m["rear_thigh"], m["rear_shank"], m["paw"])
            toes = joints[-1] + point(-0.5 * m["paw"], m["foot"])
            return [*sections[:-1], (toes, 0.9 * m["paw"], 0.4 * m["paw"])]
        top, elbow, wrist, tip = joints
        width, chord = m["front_width"], m["front_chord"]
        inside = top - 0.3 * (elbow - top)
        return [
            (inside, 0.5 * width, 0.5 * chord),
            (top, 1.2 * width, chord),
            (0.45 * top + 0.55 * elbow, 1.1 * width, 1.1 * chord),
            (elbow, width, 1.1 * chord),
            (0.5 * (elbow + wrist), 0.9 * width, 1.1 * chord),
            (wrist, 0.8 * width, chord),
            (0.5 * (wrist + tip), 0.7 * width, 0.9 * chord),
            (0.15 * wrist + 0.85 * tip, 0.6 * width, 0.7 * chord),
            (tip, 0.4 * width, 0.4 * chord),
        ]

    def carriage(self, bones: Tensor, transforms: Tensor) -> Tensor:
        """A head points forwards, a tail backwards."""
        nose, poll, withers, tip, hips = (
            _at(bones, transforms, bone, end) for bone, end in ((0, 1), (0, 0), (3, 1), (4, 1), (6, 0))
        )
        length = (bones[:, 3, 1] - bones[:, 6, 0]).norm(dim=-1)[:, None]
        head = (bones[:, 0, 1] - bones[:, 0, 0]).norm(dim=-1)[:, None]
        faults = (
            HEAD_FORWARD * head - (nose - poll)[..., 2],
            NOSE_FORWARD * length - (nose - withers)[..., 2],
            (tip - hips)[..., 2],
        )
        return (torch.stack(faults).clamp_min(0) / length).square().mean(2).sum(0)


def _at(bones: Tensor, transforms: Tensor, bone: int, end: int) -> Tensor:
    """Return the posed start (0) or end (1) of a bone, [B, T, 3]."""
    matrix = transforms[:, :, bone]
    return (matrix[..., :3, :3] @ bones[:, None, bone, end, :, None])[..., 0] + matrix[..., :3, 3]


def _pitched(m: Measures, y: Tensor, z: Tensor) -> Tensor:
    """Return a point of the trunk, given above and ahead of its middle while level, [..., 3]."""
    sine, cosine = m["body_pitch"].sin(), m["body_pitch"].cos()
    return point(y * cosine + z * sine, z * cosine - y * sine)


class Primate(Biped):
    """Long arms, a short neck and little tail, on all fours or upright."""

    name = "primate"
    table = {
        **Biped.table,
        "body_length": Measure(1.15, 0.20),
        "body_pitch": Measure(0.75, 0.40, True),
        "chest_width": Measure(0.40, 0.25),
        "chest_height": Measure(0.36, 0.25),
        "belly_width": Measure(0.34, 0.25),
        "rear_leg": Measure(1.05, 0.25),
        "rear_thigh": Measure(0.20, 0.25),
        "rear_shank": Measure(0.11, 0.25),
        "leg_forward": Measure(0.0, 0.10, True),
        "knee_forward": Measure(0.15, 0.15, True),
        "hock_back": Measure(0.05, 0.10, True),
        "hock_height": Measure(0.92, 0.05, True),
        "front_arm": Measure(1.25, 0.25),
        "front_back": Measure(-0.2, 0.40, True),
        "front_width": Measure(0.11, 0.25),
        "front_chord": Measure(0.11, 0.25),
        "neck_length": Measure(0.25, 0.40),
        "head_length": Measure(0.38, 0.30),
        "head_height": Measure(0.24, 0.25),
        "head_width": Measure(0.19, 0.25),
        "muzzle": Measure(0.12, 0.30),
        "tail_length": Measure(0.25, 0.80),
        "tail_angle": Measure(-0.8, 0.60, True),
        "tail_base": Measure(0.06, 0.40),
        "tail_middle": Measure(0.05, 0.40),
    }
    bends = Biped.bends | {8: (0.40, 0.15, 0.20), 9: (0.60, 0.20, 0.20), 10: (0.70, 0.30, 0.40)}


BIPED, PRIMATE = Biped(), Primate()
