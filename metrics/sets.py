"""Pairs of feature sets and their distances: stored beside a run, pooled over several.

A distance of one short video has few samples; the features of many videos together give one distance over all of
them. Features are stored as float32, which is what the networks compute.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from rewild4d.errors import UserError, reason, shown
from rewild4d.files import atomic, digest
from rewild4d.foreign.reading import read_arrays
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
        conditions: shared by both.
    """

    kind: str
    prediction: Features
    truth: Features
    conditions: Conditions


class _Network(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file says of one side: the fields of `Features` beside its rows."""

    extractor: str
    digest: str
    resize: str
    frames: int | None = None


class _About(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file says of one kind."""

    conditions: Conditions
    prediction: _Network
    truth: _Network


def distances(compared: Compared) -> list[Distance]:
    """Compute the distances of `KINDS` between two sets.

    Examples:
        >>> groups = torch.zeros(2, dtype=torch.int64)
        >>> x, y = (Features(torch.full((2, 1), a).double(), groups, "i3d-k400", "", "", frames=9) for a in (0.0, 1.0))
        >>> [(one.name, one.value) for one in distances(Compared("fvd_f", x, y, Conditions()))]
        [('FVD-F', 1.0), ('KVD-F', 7.0)]
    """
    x, y, conditions = compared.prediction, compared.truth, compared.conditions
    if compared.kind == "kid_v":
        return [kid(x, y, name="KID-V", conditions=conditions)]
    return feature_distances(x, y, paired=False, suffix=suffix_of(compared.kind), conditions=conditions)


def suffix_of(kind: str) -> str:
    """Return the end of FVD's and KVD's name for a kind of clips.

    Examples:
        >>> suffix_of("fvd_diag")
        '-Diag'
    """
    return KINDS[kind][kind].removeprefix("FVD")


def pool(parts: Sequence[Compared]) -> Compared:
    """Join the sets of several sequences, each part a sequence of its own.

    Args:
        parts: of one kind, from one network and resize rule, clips of one length, on one background and crop.

    Raises:
        ValueError: parts that differ in any of these.

    Examples:
        >>> one = Features(torch.zeros(2, 1), torch.zeros(2, dtype=torch.int64), "toy", "", "")
        >>> part = Compared("kid_v", one, one, Conditions())
        >>> pool([part, part]).truth.groups.tolist()
        [0, 0, 1, 1]
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
    conditions = replace(parts[0].conditions, fps=rates.pop() if len(rates) == 1 else None)
    prediction, truth = (_stack([getattr(part, side) for part in parts]) for side in _SIDES)
    return Compared(parts[0].kind, prediction, truth, conditions)


def write_features(sets: Sequence[Compared], path: Path) -> str:
    """Write sets atomically as an .npz: the rows of each kind and side, float32, and their description as JSON.

    Returns:
        SHA-256 of the file's arrays.

    Raises:
        UserError: the file cannot be written.
    """
    arrays: dict[str, np.ndarray] = {}
    about: dict[str, Any] = {}
    for compared in sets:
        about[compared.kind] = {"conditions": vars(compared.conditions)}
        for side in _SIDES:
            fields = dict(vars(getattr(compared, side)))
            arrays[f"{compared.kind}.{side}"] = fields.pop("values").numpy().astype(np.float32)
            del fields["groups"]
            about[compared.kind][side] = fields
    arrays["about"] = np.array(json.dumps(about, sort_keys=True))
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return _digest(arrays)


def read_features(path: Path, expected: str | None = None) -> dict[str, Compared]:
    """Read the file of `write_features`, by kind; every part is one sequence.

    Args:
        path: of the file.
        expected: digest that `write_features` returned; None accepts any.

    Raises:
        UserError: no such file, not one of ours, or not the one with that digest.
    """
    kind = "the features of a run (.npz)"
    arrays = read_arrays(path, kind)
    try:
        about = msgspec.json.decode(str(arrays["about"]), type=dict[str, _About])
        found = {name: _compared(name, arrays, said) for name, said in about.items()}
    except (ValueError, KeyError, RecursionError, msgspec.MsgspecError) as error:  # described otherwise than here
        raise UserError(f"{path}: expected {kind}, but it cannot be read as one: {reason(error)}.") from error
    if expected is not None and _digest(arrays) != expected:
        raise UserError(f"{path}: expected the features that its record was scored with, but it holds others.")
    return found


def _compared(kind: str, arrays: dict[str, np.ndarray], said: _About) -> Compared:
    if kind not in KINDS:
        raise ValueError(f"it holds sets of the kind '{shown(kind)}'")
    prediction, truth = (_features(arrays[f"{kind}.{side}"], getattr(said, side)) for side in _SIDES)
    return Compared(kind, prediction, truth, said.conditions)


def _features(values: np.ndarray, said: _Network) -> Features:
    if values.ndim != 2 or values.dtype.kind != "f" or not np.isfinite(values).all():
        raise ValueError(f"it holds rows of {values.dtype} of shape {list(values.shape)} or some that are not finite")
    rows = torch.from_numpy(values).double()
    return Features(rows, torch.zeros(len(rows), dtype=torch.int64), **msgspec.structs.asdict(said))


def _stack(parts: Sequence[Features]) -> Features:
    """Join all rows, with a group for each part."""
    groups = torch.cat([torch.full((len(part.values),), group) for group, part in enumerate(parts)])
    return replace(parts[0], values=torch.cat([part.values for part in parts]), groups=groups)


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """Hash names, shapes, types and bytes, but not the container's time stamps."""
    return digest(*(part for name in sorted(arrays) for part in (name, arrays[name])))
