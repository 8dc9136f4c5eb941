"""What animals of the zoo do: postures over time, and the bones that they put where.

A posture is a set of numbers, so that a clip of several motions blends one into the next. Lengths are in hip heights,
angles in degrees (see `gait`), times in [0, 1) of a motion. The animal stays in place: feet of a gait slide backwards
under it at the speed of the ground, as on a treadmill.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Self

import numpy as np

from rewild4d.datasets.builtin.anatomy import Skeleton
from rewild4d.datasets.builtin.gait import FEET, Gait, about, angle_of, bend_leg, foot_path, rotation

LEGS = ("hind", "fore")


@dataclass(frozen=True)
class Posture:
    """One moment.

    Attributes:
        root: shift along y and z, and pitch, yaw and roll of the body about its hips, [5].
        chains: pitch, yaw and roll that each bone of a chain adds to its parent's, by chain, [bones, 3] or [3].
            Yaw and roll of the right one of a pair are mirrored.
        feet: sideways, upward and forward offset of each foot from where it rests, and degrees of its flexion, by the
            names of `FEET`, [4].
    """

    root: np.ndarray = field(default_factory=lambda: np.zeros(5))
    chains: dict[str, np.ndarray] = field(default_factory=dict)
    feet: dict[str, np.ndarray] = field(default_factory=dict)

    def mixed(self, other: Self, amount: float) -> "Posture":
        """Return the posture that is ``amount`` of the way to another."""

        def between(one: dict[str, np.ndarray], two: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            names = dict.fromkeys((*one, *two))
            return {n: (1 - amount) * one.get(n, np.zeros(1)) + amount * two.get(n, np.zeros(1)) for n in names}

        root = (1 - amount) * self.root + amount * other.root
        return Posture(root, between(self.chains, other.chains), between(self.feet, other.feet))


Motion = Callable[[float], Posture]
"""Time in [0, 1) -> posture."""


def _sine(time: float, phase: float = 0.0) -> float:
    return float(np.sin(2 * np.pi * (time + phase)))


def _chain(*bones: tuple[float, float, float]) -> np.ndarray:
    return np.array(bones)


def _tail(time: float, amount: float = 9.0, lift: float = 0.0) -> np.ndarray:
    return _chain(*((lift, amount * _sine(time, -0.12 * i), 0.0) for i in range(4)))


def stepping(touchdown: Sequence[float], duty: float, stride: float, lift: float, fold: float) -> Motion:
    """Return feet of a gait alone."""
    steps = Gait(tuple(touchdown), duty, stride, lift, fold, (0.0, 0.0), ())  # type: ignore[arg-type]

    def posture(time: float) -> Posture:
        feet = {}
        for name, lands in zip(FEET, touchdown, strict=True):
            forward, up, flexion = foot_path(steps, (time - lands) % 1.0)
            share = 1.0 if name.startswith("fore") else 0.5
            feet[name] = np.array((0.0, share * up, forward, share * fold * flexion))
        return Posture(feet=feet)

    return posture


def walk(time: float) -> Posture:
    """One cycle of a lateral-sequence walk."""
    feet = stepping((0.0, 0.25, 0.5, 0.75), 0.63, 0.46, 0.12, 45.0)(time).feet
    spine = _chain(*((0.0, 2.0 * _sine(time, -0.15 * i), 0.0) for i in range(3)))
    neck = np.array((2.5 * _sine(2 * time, 0.3), 1.5 * _sine(time), 0.0))
    root = np.array((0.012 * _sine(2 * time, 0.1) - 0.025, 0.0, 0.0, 0.0, 2.0 * _sine(time, 0.1)))
    return Posture(root, {"spine": spine, "neck": neck, "tail": _tail(time)}, feet)


def trot(time: float) -> Posture:
    """One cycle of a trot: diagonal legs together."""
    feet = stepping((0.0, 0.5, 0.5, 0.0), 0.45, 0.5, 0.18, 55.0)(time).feet
    root = np.array((0.03 * _sine(2 * time, 0.1) - 0.02, 0.0, 0.0, 0.0, 1.0 * _sine(time)))
    return Posture(root, {"neck": np.array((2.0 * _sine(2 * time), 0, 0)), "tail": _tail(time, 7.0, 3.0)}, feet)


def gallop(time: float) -> Posture:
    """One cycle of a gallop with a flexing spine."""
    feet = stepping((0.0, 0.42, 0.10, 0.54), 0.32, 0.52, 0.24, 60.0)(time).feet
    root = np.array((0.045 * _sine(time, 0.3) - 0.02, 0.0, 5.0 * _sine(time, 0.05), 0.0, 0.0))
    spine = _chain((0, 0, 0), (3 * _sine(time, 0.55), 0, 0), (3 * _sine(time, 0.55), 0, 0))
    neck = np.array((5.0 * _sine(time, 0.6) + 5.0, 0.0, 0.0))
    return Posture(root, {"spine": spine, "neck": neck, "tail": _tail(time, 4.0, 8.0)}, feet)


def stand(time: float) -> Posture:
    """Look around."""
    neck = np.array((2.0 * _sine(time), 9.0 * _sine(time, 0.2), 0.0))
    head = np.array((4.0 * _sine(time, 0.3), 6.0 * _sine(time, 0.1), 5.0 * _sine(time, 0.6)))
    root = np.array((-0.015 + 0.006 * _sine(2 * time), 0.0, 0.0, 0.0, 0.0))
    return Posture(root, {"neck": neck, "head": head, "tail": _tail(time, 12.0)})


def graze(time: float, lowering: float = 40.0) -> Posture:
    """Lower the head to the ground, by ``lowering`` degrees at each of the neck's two bones, and tear at grass."""
    down = lowering + 3.0 * _sine(3 * time)
    feet = {"fore.L": np.array((0.0, 0.0, 0.1, 0.0)), "fore.R": np.array((0.0, 0.0, -0.06, 0.0))}
    root = np.array((-0.05, 0.0, 5.0, 0.0, 0.0))
    neck, head = np.array((down, 4.0 * _sine(time), 0.0)), np.array((8.0 * _sine(3 * time, 0.2) - 15.0, 0.0, 0.0))
    return Posture(root, {"neck": neck, "head": head, "tail": _tail(2 * time, 10.0)}, feet)


def sit(time: float) -> Posture:
    """Sit on the haunches with straight forelegs and look around."""
    forward = {f"hind.{side}": np.array((0.05 * sign, 0.0, 0.22, 0.0)) for side, sign in (("L", 1), ("R", -1))}
    back = {f"fore.{side}": np.array((0.0, 0.0, -0.13, 0.0)) for side in "LR"}
    root = np.array((-0.52, 0.05, -30.0, 0.0, 0.0))
    neck = np.array((8.0 + 2 * _sine(time), 8.0 * _sine(time, 0.2), 0.0))
    head = np.array((10.0 + 4.0 * _sine(time, 0.5), 6.0 * _sine(time), 0.0))
    return Posture(root, {"neck": neck, "head": head, "tail": _tail(2 * time, 12.0, -8.0)}, forward | back)


def rear(time: float) -> Posture:
    """Sit upright as a bear does, with the forelegs in the air."""
    low = sit(time)
    feet = {name: offset for name, offset in low.feet.items() if name.startswith("hind")}
    for side, phase in (("L", 0.0), ("R", 0.4)):
        feet[f"fore.{side}"] = np.array((0.0, 0.85 + 0.05 * _sine(time, phase), -0.1, 30.0))
    root = np.array((-0.55, 0.12, -58.0, 0.0, 0.0))
    return Posture(root, low.chains | {"neck": np.array((22.0, 8.0 * _sine(time), 0.0))}, feet)


def turn(time: float) -> Posture:
    """Turn on the spot by a right angle and back, lifting feet in turn."""
    yaw = 45.0 * (1 - np.cos(2 * np.pi * time))
    feet = {}
    for name, lands in zip(FEET, (0.0, 0.25, 0.5, 0.75), strict=True):
        swing = max(0.0, _sine(4 * time, -lands))
        feet[name] = np.array((0.0, 0.09 * swing, 0.0, 25.0 * swing))
    lead = 10.0 * _sine(time)
    chains = {"neck": np.array((0.0, lead, 0.0)), "spine": np.array((0.0, 0.3 * lead, 0.0)), "tail": _tail(time)}
    return Posture(np.array((-0.02, 0.0, 0.0, yaw, 0.0)), chains, feet)


def shake(time: float) -> Posture:
    """Shake like a wet dog, from head to tail."""
    strength = np.sin(np.pi * time) ** 0.5
    roll = [14.0 * strength * _sine(4 * time, -0.15 * i) for i in range(6)]
    spine = _chain(*((0.0, 0.0, r) for r in roll[3:]))
    head = np.array((5.0, 0.0, 1.6 * roll[0]))
    neck = _chain((6.0, 0.0, roll[2]), (6.0, 0.0, roll[1]))
    root = np.array((-0.05, 0.0, 0.0, 0.0, 0.3 * roll[5]))
    wide = {name: np.array((0.05 if name.endswith("L") else -0.05, 0.0, 0.0, 0.0)) for name in FEET}
    return Posture(root, {"spine": spine, "neck": neck, "head": head, "tail": 2.0 * _tail(4 * time, 8.0)}, wide)


def jump(time: float) -> Posture:
    """Crouch, take off, fly with folded legs and land."""
    air = float(np.clip((time - 0.3) / 0.4, 0.0, 1.0))
    height = 4 * air * (1 - air)
    crouch = 0.16 * np.exp(-(((time - 0.22) / 0.1) ** 2)) + 0.14 * np.exp(-(((time - 0.78) / 0.09) ** 2))
    pitch = 16.0 * (np.exp(-(((time - 0.7) / 0.14) ** 2)) - np.exp(-(((time - 0.32) / 0.14) ** 2)))
    feet = {}
    for name in FEET:
        forward = 0.2 * height * (1.0 if name.startswith("fore") else -1.0) * np.cos(np.pi * air)
        feet[name] = np.array((0.0, 0.62 * height, forward, 35.0 * height))
    root = np.array((0.5 * height - crouch, 0.0, pitch, 0.0, 0.0))
    return Posture(root, {"neck": np.array((0.3 * pitch, 0, 0)), "tail": _tail(time, 5.0, 10 * height)}, feet)


def stride(time: float) -> Posture:
    """One cycle of a walk on two legs."""
    feet = stepping((0.0, 0.0, 0.5, 0.5), 0.58, 0.5, 0.22, 55.0)(time).feet
    root = np.array((0.02 * _sine(2 * time, 0.1) - 0.03, 0.0, 2.0 * _sine(2 * time), 0.0, 3.0 * _sine(time, 0.1)))
    neck = np.array((7.0 * _sine(2 * time, 0.3), 0.0, 0.0))
    return Posture(
        root,
        {"neck": neck, "head": -neck, "tail": _tail(time, 8.0), "arm": np.array((8 * _sine(2 * time), 0, 0))},
        feet,
    )


def peck(time: float) -> Posture:
    """Bend down on two legs and peck twice."""
    down = 1 - np.cos(4 * np.pi * time)
    neck = np.array((22.0 * down, 3.0 * _sine(time), 0.0))
    return Posture(np.array((-0.05, 0.0, 9.0 * down, 0.0, 0.0)), {"neck": neck, "tail": _tail(time, 4.0)})


def hop(time: float) -> Posture:
    """One jump of a kangaroo."""
    air = float(np.clip((time - 0.25) / 0.6, 0.0, 1.0))
    height, phase = 4 * air * (1 - air), 2 * air - 1
    # In the air feet swing forwards; on the ground they slide back at its speed, before and after the loop's seam.
    ground = (time + 0.15) % 1.0
    forward = 0.3 * phase if 0 < air < 1 else 0.3 - 0.6 * ground / 0.4
    feet = {f"hind.{side}": np.array((0.0, 0.42 * height, forward, 40.0 * height)) for side in "LR"}
    root = np.array((0.4 * height - 0.06, 0.0, 9.0 * _sine(time, 0.1), 0.0, 0.0))
    chains = {
        "neck": np.array((5.0 * _sine(time, 0.5), 0, 0)),
        "arm": np.array((18.0 * _sine(time), 0, 0)),
        "tail": _chain(*((9.0 * _sine(time, 0.3 - 0.1 * i), 0, 0) for i in range(4))),
    }
    return Posture(root, chains, feet)


def fly(time: float) -> Posture:
    """One beat of the wings, legs drawn up."""
    bones = ((32.0, 0.0, 5.0), (18.0, 0.1, 0.0), (16.0, 0.2, 0.0))
    beat = _chain(*((0.0, 4.0 * _sine(time, 0.25), much * _sine(time, -lag) + up) for much, lag, up in bones))
    feet = {f"hind.{side}": np.array((0.0, 0.38, -0.22, 65.0)) for side in "LR"}
    root = np.array((0.55 - 0.05 * _sine(time), 0.0, 2.0 * _sine(time, 0.2), 0.0, 3.0 * _sine(time, 0.3)))
    return Posture(root, {"wing": beat, "neck": np.array((2.0 * _sine(time), 0, 0)), "tail": _tail(time, 3.0)}, feet)


MOTIONS: dict[str, Motion] = {
    m.__name__: m for m in (walk, trot, gallop, stand, graze, sit, rear, turn, shake, jump, stride, peck, hop, fly)
}
"""Motions by name."""

CYCLES = {"walk": 2.0, "trot": 2.0, "gallop": 2.0, "stride": 2.0, "hop": 2.0, "fly": 2.0}
"""Cycles of a motion in one clip that shows nothing else; 1 where missing."""
BLEND = 0.4
"""Share of a motion's time over which it becomes the next one."""


def clip(names: Sequence[str], frames: int, lowering: float = 40.0) -> list[Posture]:
    """Return postures of motions one after another, each blended into the next over the last `BLEND` of its time.

    Args:
        names: of motions.
        frames: in all.
        lowering: see `graze`.
    """
    motions = MOTIONS | {"graze": partial(graze, lowering=lowering)}
    found = []
    for frame in range(frames):
        at = frame / frames * len(names)
        index = min(int(at), len(names) - 1)
        cycles = CYCLES.get(names[index], 1.0) if len(names) == 1 else 1.0
        posture = motions[names[index]](cycles * (at - index) % 1.0)
        left = (1 - (at - index)) / BLEND
        if left < 1.0 and index + 1 < len(names):
            amount = 1 - left
            posture = posture.mixed(motions[names[index + 1]](0.0), amount * amount * (3 - 2 * amount))
        found.append(posture)
    return found


def pose(skeleton: Skeleton, posture: Posture, size: float) -> np.ndarray:
    """Return rest-to-posed transforms of all bones, float64, [J, 4, 4].

    Args:
        skeleton: bones at rest in the body frame, metres.
        posture: see there.
        size: hip height in metres.
    """
    rise, surge, pitch, yaw, roll = posture.root
    moved = np.tile(np.eye(4), (len(skeleton.names), 1, 1))
    heading = about(skeleton.heads[0] * (1, 0, 1), rotation(0.0, yaw, 0.0))
    body = about(skeleton.heads[0], rotation(pitch, 0.0, roll))
    body[:3, 3] += np.array((0.0, rise, surge)) * size
    for j, name in enumerate(skeleton.names):
        chain, _, rest = name.partition(".")
        if chain in LEGS:
            continue
        angles = _angles(posture, chain, rest)
        parent = moved[skeleton.parents[j]] if skeleton.parents[j] >= 0 else body
        moved[j] = parent @ about(skeleton.heads[j], rotation(*angles))
    for foot in FEET:
        if f"{foot[:4]}.0.{foot[-1]}" in skeleton.names:
            _place_leg(skeleton, moved, foot, np.resize(posture.feet.get(foot, np.zeros(4)), 4), size)
    return heading @ moved


def _angles(posture: Posture, chain: str, rest: str) -> np.ndarray:
    given = posture.chains.get(chain, np.zeros(3))
    parts = rest.split(".")
    number = int(parts[0]) if parts[0].isdigit() else 0
    angles = given[min(number, len(given) - 1)] if given.ndim == 2 else np.resize(given, 3)
    return angles * ((1, -1, -1) if parts[-1] == "R" else (1, 1, 1))


def _place_leg(skeleton: Skeleton, moved: np.ndarray, foot: str, offset: np.ndarray, size: float) -> None:
    """Set the bones of a leg so that its fetlock is at its rest place plus an offset; out of reach it stretches."""
    limb, side = foot.split(".")
    bones = [skeleton.names.index(f"{limb}.{i}.{side}") for i in range(4)]
    joints = [skeleton.heads[b] for b in bones] + [skeleton.tails[bones[3]]]
    steps = [(b - a)[1:] for a, b in zip(joints, joints[1:], strict=False)]
    rest = [angle_of(s) for s in steps]
    hip = (moved[skeleton.parents[bones[0]]] @ np.append(joints[0], 1.0))[:3]

    target = joints[3] + offset[:3] * size
    # The leg moves in a plane through the hip that leans sideways towards its foot.
    across = target[0] - hip[0] - (joints[3][0] - joints[0][0])
    height = max(hip[1] - target[1], 1e-6)
    lean, depth = np.degrees(np.arctan2(across, height)), np.hypot(across, height)
    goal = np.array((hip[1] - depth, target[2]))
    fold = np.radians(offset[3])
    cannon = rest[2] + fold - np.arctan2(goal[1] - hip[2] - (joints[3][2] - joints[0][2]), joints[0][1])
    sideways = about(hip, rotation(0.0, 0.0, lean))
    for bone, matrix in zip(bones, bend_leg(joints, hip, goal, cannon, rest[3] + fold), strict=True):
        moved[bone] = sideways @ matrix
