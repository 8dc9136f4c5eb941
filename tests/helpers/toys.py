"""A toy: the procedural quadruped swings its legs while a camera walks around it."""

import math

import torch

from rewild4d.ours.config import Canonical, Config, Deform, Density, Skinning, WarmUp
from rewild4d.ours.losses.config import Geometry
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import PARENTS
from rewild4d.priors.kinematics import pose
from rewild4d.priors.motion import quats_from_normals, sample_surface
from rewild4d.priors.posed import posed_prior
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import look_at, skin_points
from rewild4d.types import Camera, Clip, Frame, Prior

WIDTH, HEIGHT, FRAMES = 64, 48, 5
TINY = Config(
    image_size=64,
    iterations=16,
    checkpoint_every=5,
    canonical=Canonical(samples=200, sh_degree=1),
    skinning=Skinning(resolution=10, sweeps=5),
    deform=Deform(width=16, sampled=60),
    warmup=WarmUp(iterations=6, regress=4, samples=150, size=48, views=2),
    geometry=Geometry(smooth_size=24, temporal=0.1, rigid=0.1),
    density=Density(every=0.2, cap=260),
)


def camera(index: int) -> Camera:
    """One of twelve on a ring around the origin."""
    angle = 2 * math.pi * index / 12
    eye = torch.tensor((12 * math.sin(angle), 3.0, 12 * math.cos(angle)), dtype=torch.float64)
    up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    focal = 2.2 * HEIGHT
    intrinsics = torch.tensor(((focal, 0, WIDTH / 2), (0, focal, HEIGHT / 2), (0, 0, 1)), dtype=torch.float64)
    return Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up), intrinsics, WIDTH, HEIGHT)


def swing(amplitude: float) -> torch.Tensor:
    """Transforms of legs that swing by an amplitude in radians, [T, J, 4, 4]."""
    angles = torch.zeros(FRAMES, 20, 3)
    for frame in range(FRAMES):
        step = amplitude * math.sin(2 * math.pi * (frame + 1) / FRAMES)
        for bone, sign in ((10, 1), (19, -1), (13, -1), (16, 1)):
            angles[frame, bone, 0] = sign * step
    return pose(angles, QUADRUPED.build().bones[:, 0], PARENTS)


def make_toy() -> tuple[Clip, Prior]:
    """A clip of the animal, and a prior of the right shape that does not move."""
    cameras = [camera(index) for index in range(FRAMES)]
    still = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    times = torch.arange(FRAMES, dtype=torch.float64) / 10
    given = QUADRUPED.build(), swing(0.0), still, cameras, times
    prior = posed_prior(*given, name="toy", provenance="toy", digest="toy")
    surface = sample_surface(prior, 800, torch.Generator().manual_seed(1))
    front = surface.points[:, 2:] > 0
    colors = torch.where(front, torch.tensor((0.8, 0.3, 0.1)), torch.tensor((0.1, 0.4, 0.7)))
    frames = []
    for index, transforms in enumerate(swing(0.7)):
        view = cameras[index]
        means = skin_points(surface.points, surface.weights, transforms)
        image, alpha, _ = rasterize(
            means, quats_from_normals(surface.normals), torch.full((800, 3), surface.radius), torch.full((800,), 0.95),
            colors, view.world_to_camera[None], view.intrinsics[None], WIDTH, HEIGHT,
        )  # fmt: skip
        frames.append(Frame(index / 10, view, image[0].clamp(0, 1), alpha[0].clamp(0, 1), index))
    return Clip("toy/swing", "toy", tuple(frames), 10.0, "CC0", "toy"), prior
