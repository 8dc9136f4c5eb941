"""A template that walks before known cameras, and a fit of a few steps."""

import math

import msgspec
import torch
from torch import Tensor

from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import PRESETS, PriorConfig
from rewild4d.priors.kinematics import pose
from rewild4d.priors.silhouettes import outline
from rewild4d.transforms import axis_angle_to_matrix, look_at, similarity, skin_points
from rewild4d.types import Camera, Clip, Frame

QUICK = PRESETS["quick"]
WORLD_SCALE = 0.37


def world() -> tuple[Tensor, Tensor]:
    """The animal's similarity to a world with a tilted up axis, and that up axis."""
    rotation = axis_angle_to_matrix(torch.tensor((0.9, 2.1, -0.7), dtype=torch.float64))
    return similarity(WORLD_SCALE, rotation, torch.tensor((1.0, -2.0, 0.5), dtype=torch.float64)), rotation[:, 1]


def walking_clip(count: int, cameras: str) -> Clip:
    """A long-necked walking template seen by a ring of cameras ("sweep") or from one place ("fixed")."""
    template = QUADRUPED.build(QUADRUPED.proportions(neck_length=1.2, tail_length=0.7, body_length=2.0))
    object_to_world, up = world()
    frames = []
    for t in range(count):
        angles, phase = torch.zeros(20, 3), 2 * math.pi * t / count
        for top, offset in ((10, 0.0), (13, math.pi), (16, 0.0), (19, math.pi)):
            angles[top, 0] = 0.45 * math.sin(phase + offset)
        posed = skin_points(template.vertices, template.weights, pose(angles, template.bones[:, 0], template.parents))
        turn = 2 * math.pi * t / count if cameras == "sweep" else 0.8
        eye = torch.tensor((9 * math.sin(turn), 2.5, 9 * math.cos(turn)), dtype=torch.float64)
        eye = object_to_world[:3, :3] @ eye + object_to_world[:3, 3]
        intrinsics = torch.tensor(((150.0, 0.0, 64.0), (0.0, 150.0, 48.0), (0.0, 0.0, 1.0)), dtype=torch.float64)
        camera = Camera(look_at(eye, object_to_world[:3, 3], up), intrinsics, 128, 96)
        points = posed.double() @ object_to_world[:3, :3].T + object_to_world[:3, 3]
        mask = torch.from_numpy(outline(points, template.faces, camera)).float()[None] / 255
        frames.append(Frame(t / 24, camera, mask.expand(3, -1, -1), mask))
    return Clip("made/walk", "none", tuple(frames), 24.0, "CC0", "")


def shortened(steps: int, yaw_starts: int = 4) -> PriorConfig:
    """The quick preset with fewer steps a stage and fewer starts."""
    stages = tuple(msgspec.structs.replace(stage, steps=steps) for stage in QUICK.stages)
    return msgspec.structs.replace(QUICK, stages=stages, yaw_starts=yaw_starts)


def silent(*_: object) -> None:
    return None
