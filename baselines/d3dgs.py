"""D-3DGS: canonical Gaussians and a network that deforms them over time; and D-3DGS*, with the input of `ours`.

Paper: Yang et al., Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction, CVPR 2024.
Written anew from the paper on this package's rasterizer; nothing is copied from the authors' code (MIT, on top of
3DGS's non-commercial licence). The network has the original's sizes in the preset `paper`, smaller ones in the others.

`d3dgs` sees the clip alone. It works in the world, scaled so that the volume that all input cameras look at is a cube
of side 6, and starts from random points in it that all cameras see. The network has to learn the motion of the whole
animal too, as in the original. Frames without a camera in the world get the prior's.

`d3dgs-star` is the paper's D-3DGS*. It starts from the prior's surface in its pose of the first frame, coloured from
the frames, adds the silhouette loss, and sees each frame flipped as well, at time -t with the mirrored camera. It works
in the object frame, where mirroring is defined, with the root motion that `ours` gets. Settings `skin` hold its
Gaussians to that surface as in `ours`, off by default.

Differences from the original: time runs from one frame above zero to one, so that t and -t differ; the heads start
at zero; harmonics rotate with their Gaussian; image gradients for densification are in units of the animal's box, and
the number of Gaussians is capped; every Gaussian is blurred by at least half an input pixel, as in `ours`; the
schedule is in fractions; the network computes in bfloat16 on CPUs that have it.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from rewild4d.baselines.common.splatting import STATE, Shape, SplatTraining, run_training, surface_gaussians
from rewild4d.baselines.common.volume import random_points, scene_frame
from rewild4d.baselines.d3dgs_config import INFO, STAR_INFO, D3dgsConfig, D3dgsStarConfig, NetworkShape
from rewild4d.baselines.d3dgs_network import DeformationNetwork
from rewild4d.contracts import Log, MethodInfo
from rewild4d.foreign.states import read_as
from rewild4d.ours.canonical import Gaussians, Posed, attributes
from rewild4d.ours.checkpoint import fit_digest, load_fitted, save_fitted
from rewild4d.ours.config import Canonical
from rewild4d.ours.evidence import Sighting, training_views
from rewild4d.ours.motion import Root
from rewild4d.ours.schedule import exponential, fade, for_clip
from rewild4d.ours.symmetry import Supervision, Target, match_times
from rewild4d.rasterizer import RasterInfo
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Prior, Splats

UNIT = OBJECT_DIAGONAL / 2
"""The network's unit of length: an animal fills about [-1, 1], as in the original's scenes."""


class D3dgsModel(nn.Module):
    """Canonical Gaussians and the deformation network."""

    def __init__(self, gaussians: Gaussians, config: NetworkShape, generator: torch.Generator) -> None:
        super().__init__()
        self.gaussians, self.network = gaussians, DeformationNetwork(config, generator)

    def canonical(self) -> Shape:
        """Return the canonical Gaussians, activated."""
        own = self.gaussians
        return Shape(own.means, nn.functional.normalize(own.quats, dim=-1), own.scales(own.scales_log()))

    def deformed(self, time: Tensor) -> Shape:
        """Return the Gaussians at a time in [-1, 1]: offsets are added to activated values, as in the original."""
        own = self.gaussians
        means, rotations, sizes = self.network(own.means / UNIT, time.to(own.means))
        quats = nn.functional.normalize(own.quats, dim=-1) + rotations
        scales = own.scales_log().exp() + UNIT * sizes
        return Shape(
            own.means + UNIT * means,
            nn.functional.normalize(quats, dim=-1),
            (scales.square() + own.blur.square() + 1e-12).sqrt(),
        )


class D3dgsTraining(SplatTraining):
    """One fit; that of the star sees mirrored frames too, at negative times."""

    model: D3dgsModel
    config: D3dgsConfig

    def __init__(
        self, model: D3dgsModel, config: D3dgsConfig, supervision: Supervision, generator: torch.Generator
    ) -> None:
        super().__init__(model, {"network": list(model.network.parameters())}, config, supervision, generator)
        self.mirrored = config.mirrored if isinstance(config, D3dgsStarConfig) else 0.0

    def rate(self, name: str, progress: float) -> float:
        return exponential(*self.config.motion.rate, progress)

    def sightings(self) -> Iterator[Sighting]:
        own = self.gaussians  # the network moves nothing at the start
        for key, share in training_views(self.supervision, self.mirrored):
            yield Sighting(key, share, Posed(own.means, nn.functional.normalize(own.quats, dim=-1), own.scales_log()))

    def drawn_losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo, Target]:
        self.prepare()
        progress, motion = index / self.config.iterations, self.config.motion
        key = self.draw(self.mirrored)
        noise = float(torch.randn((), generator=self.generator)) * motion.noise * fade(progress, motion.noise_until)
        target, time = self.supervision.target(key), key.view * self.supervision.code_times([key], noise)[0]
        shape = self.model.canonical() if progress < motion.warm_up else self.model.deformed(time)
        rgb, alpha, info = self.render(shape, target, progress)
        return self.image_losses(rgb, alpha, target) | self.skin_losses(self.gaussians.opacities()), info, target


class D3dgsReconstruction:
    """A fitted model with its frame of reference (contracts.Reconstruction)."""

    def __init__(self, model: D3dgsModel, config: D3dgsConfig, root: Root) -> None:
        self.model, self.config, self.root = model.eval().requires_grad_(False), config, root

    @torch.no_grad()
    def at(self, time: float) -> Splats:
        """Return the Gaussians at a time in seconds in the world; the network interpolates between frames."""
        position = self.root.position(time)
        shape = self.model.deformed(torch.tensor(self.root.code_time(time)))
        return self.root.in_world(self.model.gaussians.splats_at(*shape), position)

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world; between frames it interpolates."""
        return self.root.camera(time)

    def diagnostics(self) -> dict[str, float]:
        """Return the number of Gaussians and their mean opacity."""
        own = self.model.gaussians
        return {"gaussians": float(len(own)), "opacity_mean": float(own.opacities().mean())}

    def save(self, folder: Path) -> None:
        """Write the state and the settings into an existing, empty folder."""
        save_fitted(folder, STATE, {"model": self.model.state_dict(), "root": self.root.state()}, self.config)


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
        reference, values = self._start(clip, prior, config, generator)
        supervision = Supervision(clip, reference, config.image_size, device)
        model = D3dgsModel(Gaussians(values, config.canonical.max_scale), config.network, generator).to(device)
        training = D3dgsTraining(model, config, supervision, generator)
        run_training(training, f"{self.name} {fit_digest(config, clip, prior, seed)}", log, workdir)
        return D3dgsReconstruction(model, config, Root.of(clip, reference))

    def load(self, folder: Path, device: torch.device) -> D3dgsReconstruction:
        """Read back what `D3dgsReconstruction.save` wrote."""
        state, config = load_fitted(folder, STATE, self.name, self.Config)
        with read_as(folder, self.name):
            gaussians = Gaussians.from_state(state["model"], config.canonical.max_scale)
            model = D3dgsModel(gaussians, config.network, torch.Generator())
            model.load_state_dict(state["model"])
            return D3dgsReconstruction(model.to(device), config, Root.from_state(state["root"]))

    def _start(
        self, clip: Clip, prior: Prior, config: D3dgsConfig, generator: torch.Generator
    ) -> tuple[Prior, dict[str, Tensor]]:
        """Return the prior whose root and cameras are used, and the initial Gaussians."""
        scene = scene_frame(clip, prior)
        cameras = [scene.cameras[row] for row in match_times(clip, prior)]
        points = random_points(config.canonical.samples, cameras, generator)
        return scene, random_gaussians(points, config.canonical)


class D3dgsStar(D3dgs):
    """The method with the prior's surface, silhouettes and flipped frames (contracts.Method)."""

    name: ClassVar[str] = "d3dgs-star"
    info: ClassVar[MethodInfo] = STAR_INFO
    Config: ClassVar[type[D3dgsConfig]] = D3dgsStarConfig

    def _start(
        self, clip: Clip, prior: Prior, config: D3dgsConfig, generator: torch.Generator
    ) -> tuple[Prior, dict[str, Tensor]]:
        first = prior.transforms[match_times(clip, prior)[0]]
        return prior, surface_gaussians(prior, clip, first, config.canonical, generator)


def random_gaussians(points: Tensor, config: Canonical) -> dict[str, Tensor]:
    """Place round grey Gaussians at points [n, 3], sized by the distance of their neighbours (3DGS); by name."""
    count = len(points)
    near = cKDTree(points.numpy()).query(points.numpy(), k=min(4, count))[0][:, 1:]
    scales = torch.from_numpy(np.sqrt(np.square(near).mean(axis=1))).float().clamp_min(1e-3)
    quats = torch.tensor((1.0, 0.0, 0.0, 0.0)).repeat(count, 1)
    return attributes(points, quats, scales.log()[:, None].expand(-1, 3), 0.5, config)
