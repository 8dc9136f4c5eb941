"""Checkpoints, the full state of a fit tied to its inputs, and saved reconstructions; both are written atomically."""

import logging
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import torch

from rewild4d.errors import UserError
from rewild4d.files import atomic, digest, load_tensors, save_tensors
from rewild4d.foreign.texts import read_json
from rewild4d.types import Clip, Prior

logger = logging.getLogger(__name__)
NAME, CONFIG = "checkpoint.pt", "config.json"
C = TypeVar("C", bound=msgspec.Struct)


def fit_digest(config: msgspec.Struct, clip: Clip, prior: Prior, seed: int) -> str:
    """Identify a fit: equal digests give equal results on one machine."""
    return digest(msgspec.json.encode(config), clip.digest, prior.digest, str(seed), torch.__version__)


def save_checkpoint(folder: Path, identity: str, state: dict[str, Any]) -> None:
    """Write the state to ``folder``/checkpoint.pt; a kill at any time leaves the previous one."""
    save_tensors({"digest": identity, "state": state}, folder / NAME)


def load_checkpoint(folder: Path | None, identity: str) -> dict[str, Any] | None:
    """Return the state of the interrupted fit ``identity`` (from `fit_digest`), or None; warn of another fit's."""
    if folder is None or not (path := folder / NAME).exists():
        return None
    content = load_tensors(path, "checkpoint (remove it to start anew)")
    if not isinstance(content, dict) or not {"digest", "state"} <= content.keys():
        raise UserError(f"{path}: expected a checkpoint (remove it to start anew), got something else.")
    if content["digest"] != identity:
        logger.warning("%s: is of another configuration, clip, prior or seed; starting anew.", path)
        return None
    return content["state"]


def save_fitted(folder: Path, name: str, state: dict[str, Any], config: msgspec.Struct) -> None:
    """Write the state of a reconstruction to the file ``name`` of an existing folder, and its settings beside it."""
    save_tensors(state, folder / name)
    with atomic(folder / CONFIG) as path:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=2))


def load_fitted(folder: Path, name: str, method: str, config_type: type[C]) -> tuple[dict[str, Any], C]:
    """Read what `save_fitted` wrote for a method.

    Raises:
        UserError: a file is missing, or is not what `save_fitted` writes for this method.
    """
    for file in (name, CONFIG):
        if not (folder / file).is_file():
            raise UserError(f"{folder}: expected a reconstruction by '{method}', but it has no {file}.")
    config = read_json(folder / CONFIG, f"a reconstruction by '{method}'", config_type)
    return load_tensors(folder / name), config
