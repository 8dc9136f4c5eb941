"""Checkpoints: the full state of a fit, written atomically, tied to what it was made from."""

from pathlib import Path
from typing import Any

import msgspec
import torch

from rewild4d.files import digest, load_tensors, save_tensors
from rewild4d.types import Clip, Prior

NAME = "checkpoint.pt"


def fit_digest(config: msgspec.Struct, clip: Clip, prior: Prior, seed: int) -> str:
    """Identifies a fit: two fits of one digest on one machine give one result."""
    return digest(msgspec.json.encode(config), clip.digest, prior.digest, str(seed), torch.__version__)


def save_checkpoint(folder: Path, identity: str, state: dict[str, Any]) -> None:
    """Write the state to ``folder``/checkpoint.pt; a kill at any moment leaves the previous one."""
    save_tensors({"digest": identity, "state": state}, folder / NAME)


def load_checkpoint(folder: Path, identity: str) -> tuple[dict[str, Any] | None, str | None]:
    """The state of an interrupted fit, or None, and a message where a checkpoint was found but cannot be used.

    Args:
        folder: where it may be.
        identity: from `fit_digest`; a checkpoint of another fit is ignored.
    """
    path = folder / NAME
    if not path.exists():
        return None, None
    content = load_tensors(path, "checkpoint (remove it to start anew)")
    if content.get("digest") != identity:
        return None, f"{path}: is of another configuration, clip, prior or seed; starting anew."
    return content["state"], None
