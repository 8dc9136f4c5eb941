"""Two sets as features, and every distance that is computed from them: kept beside a run, pooled over several.

A distance of one short video leans on few samples; the same features of many videos, put together, give one distance
over all of them (METRICS, sections 4 and 5). Features are stored as float32, which is what the networks compute.
"""

import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.files import atomic, digest
from rewild4d.metrics.distribution import kid
from rewild4d.metrics.names import KINDS
from rewild4d.metrics.samples import Conditions, Distance, Features
from rewild4d.metrics.video import feature_distances

FILE = "features.npz"
_SIDES = ("prediction", "truth")


@dataclass(frozen=True)
class Compared:
    """Two sets of images or clips that are not paired.

    Attributes:
        kind: one of `metrics.names.KINDS`.
        prediction: features of the renders.
        truth: features of the reference.
        conditions: that both share.
    """

    kind: str
    prediction: Features
    truth: Features
    conditions: Conditions


def distances(compared: Compared) -> list[Distance]:
    """The distances of `KINDS` between two sets."""
    x, y, conditions = compared.prediction, compared.truth, compared.conditions
    if compared.kind == "kid_v":
        return [kid(x, y, name="KID-V", conditions=conditions)]
    return feature_distances(x, y, paired=False, suffix=suffix_of(compared.kind), conditions=conditions)


def suffix_of(kind: str) -> str:
    """ "-F" or "-Diag": what stands behind FVD and KVD."""
    return KINDS[kind][kind].removeprefix("FVD")


def pool(parts: Sequence[Compared]) -> Compared:
    """The sets of several sequences as one, each part a sequence of its own.

    Args:
        parts: of one kind, from one network and resize rule, clips of one length, on one background and crop.

    Raises:
        ValueError: parts that do not belong together; the text says in what they differ.
    """
    for name, values in (
        ("kinds", {part.kind for part in parts}),
        ("networks", {(s.extractor, s.digest, s.resize) for p in parts for s in (p.prediction, p.truth)}),
        ("lengths of clips", {s.frames for p in parts for s in (p.prediction, p.truth)}),
        ("backgrounds or crops", {(part.conditions.background, part.conditions.crop) for part in parts}),
    ):
        if len(values) != 1:
            raise ValueError(f"expected sets that can be pooled, got {len(values)} different {name}")
    rates = {part.conditions.fps for part in parts}
    conditions = Conditions(
        parts[0].conditions.background, parts[0].conditions.crop, rates.pop() if len(rates) == 1 else None
    )
    return Compared(
        parts[0].kind,
        _stack([part.prediction for part in parts]),
        _stack([part.truth for part in parts]),
        conditions,
    )


def write_features(sets: Sequence[Compared], path: Path) -> str:
    """Write sets atomically as an .npz: for each kind and side the rows, float32, and what they are, as JSON.

    Returns:
        SHA-256 of all that the file holds.

    Raises:
        UserError: the file cannot be written.
    """
    arrays: dict[str, np.ndarray] = {}
    about: dict[str, Any] = {}
    for compared in sets:
        about[compared.kind] = {"conditions": asdict(compared.conditions)}
        for side in _SIDES:
            features: Features = getattr(compared, side)
            arrays[f"{compared.kind}.{side}"] = features.values.numpy().astype(np.float32)
            about[compared.kind][side] = _about(features)
    arrays["about"] = np.array(json.dumps(about, sort_keys=True))
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return _digest(arrays)


def read_features(path: Path, expected: str | None = None) -> dict[str, Compared]:
    """What `write_features` wrote, by kind; every part is one sequence.

    Args:
        path: of the file.
        expected: what `write_features` returned; None takes what is there.

    Raises:
        UserError: no such file, not one of ours, or not the one with that digest.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays["about"]))
        found = {kind: _compared(kind, arrays, said) for kind, said in about.items()}
    except FileNotFoundError as error:
        raise UserError(f"{path}: expected the features of a run, but there is no such file.") from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: expected the features of a run (.npz), but it cannot be read ({error}).") from error
    if expected is not None and _digest(arrays) != expected:
        raise UserError(f"{path}: expected the features that its record was scored with, but it holds others.")
    return found


def _compared(kind: str, arrays: dict[str, np.ndarray], said: dict[str, Any]) -> Compared:
    prediction, truth = (_features(arrays[f"{kind}.{side}"], said[side]) for side in _SIDES)
    return Compared(kind, prediction, truth, Conditions(**said["conditions"]))


def _about(features: Features) -> dict[str, Any]:
    return {
        "extractor": features.extractor, "digest": features.digest, "resize": features.resize,
        "frames": features.frames,
    }  # fmt: skip


def _features(values: np.ndarray, said: dict[str, Any]) -> Features:
    if values.ndim != 2:
        raise ValueError(f"rows of shape {values.shape}")
    rows = torch.from_numpy(values).double()
    return Features(rows, torch.zeros(len(rows), dtype=torch.int64), **said)


def _stack(parts: Sequence[Features]) -> Features:
    """All rows, and a group for each part."""
    first = parts[0]
    groups = torch.cat([torch.full((len(part.values),), group) for group, part in enumerate(parts)])
    values: Tensor = torch.cat([part.values for part in parts])
    return Features(values, groups, first.extractor, first.digest, first.resize, first.frames)


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 over names, shapes, types and bytes; the container's time stamps do not count."""
    return digest(*(part for name in sorted(arrays) for part in (name, arrays[name])))
