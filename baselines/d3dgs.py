"""D-3DGS: canonical Gaussians and one network that deforms them; and D-3DGS*, which gets what `ours` gets.

Paper: Yang et al., Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction, CVPR 2024; the
authors' code is under the MIT licence on top of 3DGS's non-commercial one. Nothing of it is copied; it is written anew
from the paper on this package's rasterizer. The network has the original's sizes in the preset `paper` and is narrower
in the others.

`d3dgs` sees the clip alone. It works in the world, scaled so that the volume that all input cameras look at is a cube
of side 6, and starts from random points in it that all of them see. It has to find the animal's own motion as well as
its limbs', as the original would. Where nobody knows the cameras in the world, it takes the prior's.

`d3dgs-star` is the paper's D-3DGS*: it starts from the prior's surface in its pose of the first frame, coloured from
the frames, adds the silhouette loss, and sees each frame flipped as well, at time t v with v = -1 and the mirrored
camera. It works in the animal's frame of reference, with the root motion that `ours` gets: a mirror image means
something only there, and the root is part of the prior that the star stands for.

What differs from the original: the time is (frame + 1) / T, so that t and -t are never the same; the heads start at
zero; a Gaussian's harmonics turn with it; densification looks at the animal's box, its number of Gaussians is capped,
and every Gaussian has at least half an input pixel of blur, as in `ours`; the schedule is given in fractions; the
network works in bfloat16 where the CPU multiplies such pairs.
"""

import math
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from rewild4d.baselines.common.saved import Root, gaussians_from_state, load_state, save_state, splats_of
from rewild4d.baselines.common.splatting import Shape, SplatTraining, run_steps, surface_gaussians
from rewild4d.baselines.common.volume import random_points, scene_frame
from rewild4d.baselines.d3dgs_config import INFO, STAR_INFO, D3dgsConfig, D3dgsStarConfig, NetworkShape
from rewild4d.baselines.d3dgs_network import DeformationNetwork
from rewild4d.contracts import Log, MethodInfo
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.checkpoint import fit_digest
from rewild4d.ours.config import Canonical
from rewild4d.ours.schedule import exponential, fade, for_clip
from rewild4d.ours.symmetry import Key, Supervision, Target, match_times
from rewild4d.rasterizer import RasterInfo
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Prior, Splats

REACH = OBJECT_DIAGONAL / 2
"""The network's unit of length, so that an animal fills about [-1, 1] as in the original's scenes."""


class D3dgsModel(nn.Module):
    """Canonical Gaussians and the network that moves them."""

    def __init__(self, gaussians: Gaussians, config: NetworkShape, generator: torch.Generator) -> None:
        super().__init__()
        self.gaussians, self.network = gaussians, DeformationNetwork(config, generator)

    def still(self) -> Shape:
        """Return the Gaussians as they are."""
        own = self.gaussians
        return Shape(own.means, nn.functional.normalize(own.quats, dim=-1), own.scales(own.scales_log()))

    def moved(self, time: Tensor) -> Shape:
        """Return the Gaussians at a time in [-1, 1]: offsets are added to activated values, as in the original."""
        own = self.gaussians
        move, turn, grow = self.network(own.means / REACH, time.to(own.means))
        quats = nn.functional.normalize(own.quats, dim=-1) + turn
        scales = own.scales_log().exp() + REACH * grow
        return Shape(
            own.means + REACH * move,
            nn.functional.normalize(quats, dim=-1),
            (scales.square() + own.blur.square() + 1e-12).sqrt(),
        )


class D3dgsTraining(SplatTraining):
    """The loop's body; the star's sees mirrored frames too, at negative times."""

    model: D3dgsModel

    def __init__(
        self, model: D3dgsModel, config: D3dgsConfig, supervision: Supervision, generator: torch.Generator
    ) -> None:
        super().__init__(model, {"network": list(model.network.parameters())}, config, supervision, generator)
        self.config, self.mirrored = config, config.mirrored if isinstance(config, D3dgsStarConfig) else 0.0

    def rate(self, name: str, progress: float) -> float:
        return exponential(*self.config.motion.rate, progress)

    def losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo, Target]:
        progress, motion = index / self.config.iterations, self.config.motion
        frames = self.supervision.frames
        frame = int(torch.randint(frames, (), generator=self.generator))
        view = -1 if self.mirrored and float(torch.rand((), generator=self.generator)) < self.mirrored else 1
        noise = torch.randn((), generator=self.generator) * motion.noise * fade(progress, motion.noise_until)
        target = self.supervision.target(Key(1, view, frame))
        shape = (
            self.model.still() if progress < motion.warm_up else self.model.moved(view * (frame + 1 + noise) / frames)
        )
        rgb, alpha, info = self.render(shape, target, progress)
        return self.image_losses(rgb, alpha, target), info, target


class D3dgsReconstruction:
    """A fitted model with its frame of reference (contracts.Reconstruction)."""

    def __init__(self, model: D3dgsModel, config: D3dgsConfig, root: Root) -> None:
        self.model, self.config, self.root = model.eval().requires_grad_(False), config, root

    @torch.no_grad()
    def at(self, time: float) -> Splats:
        """Return the Gaussians at a time in seconds in the world; the network interpolates between frames."""
        position = self.root.position(time)
        shape = self.model.moved(torch.tensor((position + 1) / len(self.root.times)))
        return self.root.in_world(splats_of(self.model.gaussians, *shape), position)

    def camera(self, time: float) -> Camera | None:
        """Return the input camera of the frame nearest to a time."""
        return self.root.camera(time)

    def diagnostics(self) -> dict[str, float]:
        """Return how many Gaussians there are and how opaque."""
        own = self.model.gaussians
        return {"gaussians": float(len(own)), "opacity_mean": float(own.opacities().mean())}

    def save(self, folder: Path) -> None:
        """Write the state and the settings into an existing, empty folder."""
        save_state(folder, {"model": self.model.state_dict(), "root": self.root.state()}, self.config)


class D3dgs:
    """The method from the clip alone (contracts.Method)."""

    name: ClassVar[str] = "d3dgs"
    info: ClassVar[MethodInfo] = INFO
    Config: ClassVar[type[D3dgsConfig]] = D3dgsConfig

    def fit(
        self,
        clip: Clip,
        prior: Prior,
        *,
        config: D3dgsConfig,
        seed: int,
        device: torch.device,
        log: Log,
        workdir: Path | None,
    ) -> D3dgsReconstruction:
        """Reconstruct from the clip; see contracts.Method."""
        config = for_clip(config, len(clip.frames))
        generator = torch.Generator().manual_seed(seed)
        frame, values = self._start(clip, prior, config, generator)
        supervision = Supervision(clip, frame, config.image_size, device)
        model = D3dgsModel(Gaussians(values, config.canonical.max_scale), config.network, generator).to(device)
        training = D3dgsTraining(model, config, supervision, generator)
        run_steps(training, f"{self.name} {fit_digest(config, clip, prior, seed)}", log, workdir)
        return D3dgsReconstruction(model, config, Root.of(clip, frame))

    def load(self, folder: Path, device: torch.device) -> D3dgsReconstruction:
        """Read back what `D3dgsReconstruction.save` wrote."""
        state, config = load_state(folder, self.name, self.Config)
        gaussians = gaussians_from_state(state["model"], config.canonical.max_scale)
        model = D3dgsModel(gaussians, config.network, torch.Generator())
        model.load_state_dict(state["model"])
        return D3dgsReconstruction(model.to(device), config, Root.from_state(state["root"]))

    def _start(
        self, clip: Clip, prior: Prior, config: D3dgsConfig, generator: torch.Generator
    ) -> tuple[Prior, dict[str, Tensor]]:
        """Return the frame of reference (as a prior that stands still) and the first Gaussians."""
        scene = scene_frame(clip, prior)
        cameras = [scene.cameras[row] for row in match_times(clip, prior)]
        return (
            scene,
            random_gaussians(random_points(config.canonical.samples, cameras, generator), config.canonical),
        )


class D3dgsStar(D3dgs):
    """The method with the prior's start, silhouettes and flipped frames (contracts.Method)."""

    name: ClassVar[str] = "d3dgs-star"
    info: ClassVar[MethodInfo] = STAR_INFO
    Config: ClassVar[type[D3dgsConfig]] = D3dgsStarConfig

    def _start(
        self, clip: Clip, prior: Prior, config: D3dgsConfig, generator: torch.Generator
    ) -> tuple[Prior, dict[str, Tensor]]:
        first = prior.transforms[match_times(clip, prior)[0]]
        return prior, surface_gaussians(prior, clip, first, config.canonical, generator)


def random_gaussians(points: Tensor, config: Canonical) -> dict[str, Tensor]:
    """Round grey Gaussians, as large as they are far apart (3DGS), at points [n, 3]; attributes by name."""
    count = len(points)
    near = cKDTree(points.numpy()).query(points.numpy(), k=min(4, count))[0][:, 1:]
    scales = torch.from_numpy(np.sqrt(np.square(near).mean(axis=1))).float().clamp_min(1e-3)
    colors = torch.zeros(count, (config.sh_degree + 1) ** 2, 3)
    colors[:, 0] = 0.5
    return {
        "means": points,
        "quats": torch.tensor((1.0, 0.0, 0.0, 0.0)).repeat(count, 1),
        "log_scales": scales.log()[:, None].expand(-1, 3),
        "logit_opacities": torch.full((count,), math.log(config.opacity / (1 - config.opacity))),
        "colors": colors,
    }
