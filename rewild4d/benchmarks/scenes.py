"""Scenes to time: an animal-like cloud of Gaussians, and a training step of `ours` on a clip of it.

They are procedural and seeded, so that all machines time the same work.
"""

import math
from dataclasses import dataclass

import msgspec
import torch
from torch import Tensor

from rewild4d.config import load_preset
from rewild4d.ours.config import Config
from rewild4d.ours.fit import Training
from rewild4d.ours.model import build_model
from rewild4d.ours.symmetry import Supervision
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.kinematics import pose
from rewild4d.priors.motion import SurfaceSample, pose_gaussians, quats_from_normals, sample_surface
from rewild4d.priors.posed import posed_prior
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import look_at
from rewild4d.types import Camera, Clip, Frame, Prior

COVERED = 0.25
"""Share of the image that the animal fills."""
OPACITY = 0.7
TILING = 1.5
"""Standard deviation over the radius of a disc with a Gaussian's share of the surface; closes the surface."""
FLATNESS = 0.5
"""Scale along the normal over the scale in the surface."""
DISTANCE, AZIMUTH = 12.0, math.radians(40)

FRAMES, FPS = 8, 10.0
PROGRESS = 0.175
"""Share of the iterations at which a step is timed: under `paper` deformation and colour are complete (0.15), and
the losses of prior (until 0.2) and geometry (until 0.5) act."""


@dataclass(frozen=True)
class SplatScene:
    """One call of the rasterizer."""

    gaussians: tuple[Tensor, ...]  # means, quats, scales, opacities, colors [N, ...], float32
    world_to_camera: Tensor  # [1, 4, 4]
    intrinsics: Tensor  # [1, 3, 3]
    size: int  # side of the square image in pixels

    def __len__(self) -> int:
        return len(self.gaussians[0])

    def to(self, device: torch.device) -> "SplatScene":
        """Move the scene to a device."""
        moved = tuple(tensor.to(device) for tensor in self.gaussians)
        return SplatScene(moved, self.world_to_camera.to(device), self.intrinsics.to(device), self.size)

    def render(self, gaussians: tuple[Tensor, ...] | None = None, backend: str = "auto") -> tuple[Tensor, Tensor]:
        """Render image [3, size, size] on black and alpha [size, size], of the scene's or other Gaussians."""
        means, quats, scales, opacities, colors = gaussians or self.gaussians
        image, alpha, _ = rasterize(
            means, quats, scales, opacities, colors, self.world_to_camera, self.intrinsics, self.size, self.size,
            backend=backend,
        )  # fmt: skip
        return image[0], alpha[0, 0]


def coverage(scene: SplatScene) -> float:
    """Return the share of pixels with alpha above one half."""
    return float((scene.render()[1] > 0.5).float().mean())


def splat_scene(count: int, size: int, seed: int = 0) -> SplatScene:
    """Build the template at rest, seen from its front left, covering a quarter of a square image."""
    generator = torch.Generator().manual_seed(seed)
    surface = sample_surface(_prior(_swing(0.0), [AZIMUTH] * FRAMES, 64), count, generator)
    scales = torch.tensor((1.0, 1.0, FLATNESS)) * TILING * surface.radius
    gaussians = (
        surface.points,
        quats_from_normals(surface.normals),
        scales.repeat(count, 1),
        torch.full((count,), OPACITY),
        torch.rand(count, 3, generator=generator),
    )
    focal = 2.5 * size
    for _ in range(6):  # the covered area grows with the square of the focal length, except at the border
        camera = _camera(AZIMUTH, focal, size)
        scene = SplatScene(gaussians, camera.world_to_camera[None].float(), camera.intrinsics[None].float(), size)
        focal *= math.sqrt(COVERED / max(coverage(scene), 1e-3))
    return scene


def step_config(size: int, gaussians: int, preset: str) -> Config:
    """Load a preset of `ours` with another image size and a fixed number of Gaussians (no densification).

    Raises:
        UserError: no such preset.
    """
    config = load_preset("ours", Config, preset)
    return msgspec.structs.replace(
        config,
        image_size=size,
        canonical=msgspec.structs.replace(config.canonical, samples=gaussians),
        density=msgspec.structs.replace(config.density, start=2.0, end=-1.0),
    )


def training(size: int, gaussians: int, preset: str, device: torch.device | None = None) -> tuple[Training, int]:
    """Build a training of `ours` at `PROGRESS`; return it and the index of its next step.

    Raises:
        UserError: no such preset.
    """
    device = device or torch.device("cpu")
    config = step_config(size, gaussians, preset)
    clip, prior = posed_clip(size, gaussians)
    generator = torch.Generator().manual_seed(0)
    model = build_model(config, prior, generator)
    for layer in (model.network.head, model.deform.out):  # they start at zero, where gradients vanish
        torch.nn.init.normal_(layer.weight, std=0.01, generator=generator)
    supervision = Supervision(clip, prior, size, device, config.loss.mean_over)
    return Training(model.to(device), supervision, config, generator), round(PROGRESS * config.iterations)


def posed_clip(size: int, gaussians: int) -> tuple[Clip, Prior]:
    """Build a clip of the template with swinging legs and a moving camera, and the prior of its true motion."""
    prior = _prior(_swing(0.5), [AZIMUTH + math.pi / 2 * index / FRAMES for index in range(FRAMES)], size)
    generator = torch.Generator().manual_seed(1)
    surface = sample_surface(prior, gaussians, generator)
    colors = torch.rand(gaussians, 3, generator=generator)
    frames = tuple(_frame(surface, colors, prior, index) for index in range(FRAMES))
    return Clip("bench/swing", "template", frames, FPS, "CC0", f"bench {size} {gaussians}"), prior


def _frame(surface: SurfaceSample, colors: Tensor, prior: Prior, index: int) -> Frame:
    scales = torch.full((len(colors), 3), surface.radius)
    moved = pose_gaussians(surface, quats_from_normals(surface.normals), scales, colors, prior.transforms[index])
    camera = prior.cameras[index]
    image, alpha, _ = rasterize(
        moved.means, moved.quats, moved.scales, moved.opacities, colors, camera.world_to_camera[None],
        camera.intrinsics[None], camera.width, camera.height,
    )  # fmt: skip
    return Frame(float(prior.times[index]), camera, image[0].clamp(0, 1), alpha[0].clamp(0, 1), index)


def _camera(azimuth: float, focal: float, size: int) -> Camera:
    """Build a camera that looks at the centre of the template at rest from a little above."""
    target = QUADRUPED.build().vertices.aminmax(dim=0)
    middle = ((target.min + target.max) / 2).double()
    offset = DISTANCE * torch.tensor((math.sin(azimuth), 0.25, math.cos(azimuth)), dtype=torch.float64)
    up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    pinhole = torch.tensor(((focal, 0, size / 2), (0, focal, size / 2), (0, 0, 1)), dtype=torch.float64)
    return Camera(look_at(middle + offset, middle, up), pinhole, size, size)


def _swing(amplitude: float) -> Tensor:
    """Return transforms of legs that swing by an amplitude in radians, diagonal pairs together, [FRAMES, J, 4, 4]."""
    phase = torch.arange(1, FRAMES + 1) * (2 * math.pi / FRAMES)
    angles = torch.zeros(FRAMES, len(QUADRUPED.parents), 3)
    for bone, sign in ((10, 1), (16, 1), (13, -1), (19, -1)):
        angles[:, bone, 0] = sign * amplitude * phase.sin()
    return pose(angles, QUADRUPED.build().bones[:, 0], QUADRUPED.parents)


def _prior(transforms: Tensor, azimuths: list[float], size: int) -> Prior:
    cameras = [_camera(azimuth, 2.4 * size, size) for azimuth in azimuths]
    world = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    times = torch.arange(FRAMES, dtype=torch.float64) / FPS
    given = QUADRUPED.build(), transforms, world, cameras, times
    return posed_prior(*given, name="bench", provenance="the template itself", digest="bench")
