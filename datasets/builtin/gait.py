"""Motions of the built-in animals: waves along the spine, and legs placed by inverse kinematics.

The animal walks in place: a foot in stance moves backwards at the constant speed of the ground, so it never slides.
All rotations are pitch (about x, positive tips an upright bone forwards), yaw (about y) and roll (about z).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rewild4d.datasets.builtin.anatomy import Skeleton

FEET = ("hind.L", "fore.L", "hind.R", "fore.R")
"""Feet in the order of a lateral-sequence walk."""


@dataclass(frozen=True)
class Wave:
    """offset + amplitude * sin(2 pi (harmonic * time + phase - lag * i)) on bone i of a chain.

    Angles are in degrees; "rise" and "surge" move the root by metres along y and z.
    """

    chain: str
    kind: Literal["pitch", "yaw", "roll", "rise", "surge"]
    amplitude: float
    harmonic: int = 1
    phase: float = 0.0
    lag: float = 0.0
    offset: float = 0.0


@dataclass(frozen=True)
class Gait:
    """How feet move, lengths in metres, times as fractions of the cycle.

    Attributes:
        touchdown: when each foot of `FEET` lands.
        duty: fraction of the cycle on the ground.
        stride: length of ground covered in stance.
        lift: height of a fore foot in swing; a hind foot rises half as much.
        fold: swing flexion of the two lowest bones of a fore leg in degrees; half as much in a hind leg.
        ahead: centre of the stance, ahead of the foot at rest, for fore and hind feet.
        waves: motion of everything else.
    """

    touchdown: tuple[float, float, float, float]
    duty: float
    stride: float
    lift: float
    fold: float
    ahead: tuple[float, float]
    waves: tuple[Wave, ...]


def animate(skeleton: Skeleton, gait: Gait, frames: int) -> np.ndarray:
    """Rest-to-posed transforms over one cycle, float64, [frames, J, 4, 4]; the frame after the last is the first."""
    return np.stack([pose(skeleton, gait, frame / frames) for frame in range(frames)])


def pose(skeleton: Skeleton, gait: Gait, time: float) -> np.ndarray:
    """Return rest-to-posed transforms at a time in cycles, [J, 4, 4]."""
    moved = np.tile(np.eye(4), (len(skeleton.names), 1, 1))
    for j, name in enumerate(skeleton.names):
        if name.split(".")[0] in ("fore", "hind"):
            continue
        values = _wave_values(name, gait, time)
        parent = moved[skeleton.parents[j]] if skeleton.parents[j] >= 0 else np.eye(4)
        local = about(skeleton.heads[j], rotation(values["pitch"], values["yaw"], values["roll"]))
        local[:3, 3] += (0.0, values["rise"], values["surge"])
        moved[j] = parent @ local
    for touchdown, foot in zip(gait.touchdown, FEET, strict=True):
        _place_leg(skeleton, moved, foot, gait, (time - touchdown) % 1.0)
    return moved


def foot_path(gait: Gait, phase: float) -> tuple[float, float, float]:
    """Where a foot is at a phase since its touchdown: forward and upward offset (metres) and flexion in [0, 1]."""
    if phase < gait.duty:
        return gait.stride * (0.5 - phase / gait.duty), 0.0, 0.0
    swing = (phase - gait.duty) / (1.0 - gait.duty)
    # The cubic leaves and meets the ground at the ground's own speed.
    speed = (1.0 - gait.duty) / gait.duty
    rest, hump = swing * swing * (3 - 2 * swing), swing * (1 - swing) * (1 - 2 * swing)
    forward = gait.stride * (rest - 0.5 - speed * hump)
    return forward, gait.lift * np.sin(np.pi * swing) ** 2, np.sin(np.pi * swing**0.8) ** 2


def _wave_values(name: str, gait: Gait, time: float) -> dict[str, float]:
    chain, _, number = name.partition(".")
    values = dict.fromkeys(("pitch", "yaw", "roll", "rise", "surge"), 0.0)
    for wave in gait.waves:
        if wave.chain in (chain, name):
            turns = wave.harmonic * time + wave.phase - wave.lag * int(number or 0)
            values[wave.kind] += wave.offset + wave.amplitude * np.sin(2 * np.pi * turns)
    return values


def _place_leg(skeleton: Skeleton, moved: np.ndarray, foot: str, gait: Gait, phase: float) -> None:
    """Set the four bones of a leg so that the fetlock is where the foot path puts it."""
    limb, side = foot.split(".")
    bones = [skeleton.names.index(f"{limb}.{i}.{side}") for i in range(4)]
    joints = [skeleton.heads[b] for b in bones] + [skeleton.tails[bones[3]]]
    steps = [(b - a)[1:] for a, b in zip(joints, joints[1:], strict=False)]
    rest = [angle_of(s) for s in steps]
    parent = moved[skeleton.parents[bones[0]]]
    hip = (parent @ np.append(joints[0], 1.0))[:3]

    # A hind leg folds mostly at the stifle, which the reach takes care of.
    share = 1.0 if limb == "fore" else 0.5
    forward, up, flexion = foot_path(gait, phase)
    up *= share
    forward += gait.ahead[0 if limb == "fore" else 1]
    fetlock = joints[3][1:] + (up, forward)
    lean = -np.arctan2(forward, joints[0][1])
    fold = np.radians(gait.fold) * share * flexion
    cannon = rest[2] + lean + fold
    for bone, matrix in zip(bones, bend_leg(joints, hip, fetlock, cannon, rest[3] + fold), strict=True):
        moved[bone] = matrix


def bend_leg(
    joints: list[np.ndarray], hip: np.ndarray, fetlock: np.ndarray, cannon: float, toe: float
) -> list[np.ndarray]:
    """Return rest-to-posed transforms of a leg's four bones in a plane along the body, each [4, 4]; out of reach it
    stretches.

    Args:
        joints: at rest, from the hip to the end of the toe, five of [3].
        hip: where the leg hangs, [3].
        fetlock: y and z of the fourth joint, [2].
        cannon: angle of the third bone (see `angle_of`).
        toe: angle of the fourth.
    """
    steps = [(b - a)[1:] for a, b in zip(joints, joints[1:], strict=False)]
    rest, lengths = [angle_of(s) for s in steps], [float(np.linalg.norm(s)) for s in steps]
    hock = fetlock - lengths[2] * _direction(cannon)
    reach = hock - hip[1:]
    span = np.clip(np.linalg.norm(reach), abs(lengths[0] - lengths[1]) * 1.001, (lengths[0] + lengths[1]) * 0.999)
    bend = np.arccos((lengths[0] ** 2 + span**2 - lengths[1] ** 2) / (2 * lengths[0] * span))
    side_of_bend = np.sign(_wrap(rest[0] - angle_of(steps[0] + steps[1])))
    upper = angle_of(reach) + side_of_bend * bend
    knee = hip[1:] + lengths[0] * _direction(upper)
    lower = angle_of(hip[1:] + span * reach / np.linalg.norm(reach) - knee)

    at = hip
    matrices = []
    for angle, start, length in zip((upper, lower, cannon, toe), range(4), lengths, strict=True):
        matrices.append(about(joints[start], rotation(np.degrees(angle - rest[start]), 0.0, 0.0)))
        matrices[-1][:3, 3] += at - joints[start]
        at = at + np.append(joints[start + 1][0] - joints[start][0], length * _direction(angle))
    return matrices


def angle_of(vector: np.ndarray) -> float:
    """Return the angle of (y, z) from up towards ahead, radians: pitch adds to it."""
    return float(np.arctan2(vector[1], vector[0]))


def _direction(angle: float) -> np.ndarray:
    return np.array((np.cos(angle), np.sin(angle)))


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def rotation(pitch: float, yaw: float, roll: float) -> np.ndarray:
    """yaw * pitch * roll in degrees, [3, 3]."""
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(a), np.sin(a)) for a in np.radians((pitch, yaw, roll)))
    about_x = np.array(((1, 0, 0), (0, cx, -sx), (0, sx, cx)))
    about_y = np.array(((cy, 0, sy), (0, 1, 0), (-sy, 0, cy)))
    about_z = np.array(((cz, -sz, 0), (sz, cz, 0), (0, 0, 1)))
    return about_y @ about_x @ about_z


def about(pivot: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, pivot - rotation @ pivot
    return matrix
