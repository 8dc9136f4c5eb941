"""`ours` as a method of the benchmark."""

from pathlib import Path
from typing import ClassVar

import torch

from rewild4d.contracts import Log, MethodInfo
from rewild4d.ours import INFO
from rewild4d.ours.config import Config as OursConfig
from rewild4d.ours.evidence import sees_one_side
from rewild4d.ours.fit import train
from rewild4d.ours.motion import Root
from rewild4d.ours.reconstruction import OursReconstruction, load_reconstruction
from rewild4d.ours.schedule import for_clip_of_ours
from rewild4d.types import Clip, Prior


class Ours:
    """Part-aware canonical Gaussians with mirrored supervision (contracts.Method)."""

    info: ClassVar[MethodInfo] = INFO
    Config: ClassVar[type[OursConfig]] = OursConfig

    def fit(
        self,
        clip: Clip,
        prior: Prior,
        *,
        config: OursConfig,
        seed: int,
        device: torch.device,
        log: Log,
        workdir: Path | None,
    ) -> OursReconstruction:
        """Reconstruct from the clip and the prior; see contracts.Method."""
        filmed, one_sided = clip.guessed_cameras, sees_one_side(prior)
        config = for_clip_of_ours(config, len(clip.frames), filmed=filmed, one_sided=one_sided)
        root = Root.of(clip, prior)
        model = train(clip, prior, config, seed, device, log, workdir)
        return OursReconstruction(model, config, root)

    def load(self, folder: Path, device: torch.device) -> OursReconstruction:
        """Read a saved reconstruction."""
        return load_reconstruction(folder, device)
