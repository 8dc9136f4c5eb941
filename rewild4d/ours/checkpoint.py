"""Checkpoints: the full state of a fit, written atomically, tied to its inputs."""

import logging
from pathlib import Path
from typing import Any

import msgspec
import torch

from rewild4d.files import digest, load_tensors, save_tensors
from rewild4d.types import Clip, Prior

logger = logging.getLogger(__name__)
NAME = "checkpoint.pt"


def fit_digest(config: msgspec.Struct, clip: Clip, prior: Prior, seed: int) -> str:
    """Identify a fit: equal digests give equal results on one machine."""
    return digest(msgspec.json.encode(config), clip.digest, prior.digest, str(seed), torch.__version__)


def save_checkpoint(folder: Path, identity: str, state: dict[str, Any]) -> None:
    """Write the state to ``folder``/checkpoint.pt; a kill at any moment leaves the previous one."""
    save_tensors({"digest": identity, "state": state}, folder / NAME)


def load_checkpoint(folder: Path | None, identity: str) -> dict[str, Any] | None:
    """Return the state of the interrupted fit ``identity`` (from `fit_digest`), or None; warn of another fit's."""
    if folder is None or not (path := folder / NAME).exists():
        return None
    content = load_tensors(path, "checkpoint (remove it to start anew)")
    if content.get("digest") != identity:
        logger.warning("%s: is of another configuration, clip, prior or seed; starting anew.", path)
        return None
    return content["state"]
