"""Score a mesh or a cloud in a file: one similarity, then Chamfer distance and F-scores."""

import sys
import time
from pathlib import Path
from typing import Literal

import msgspec
import torch

from rewild4d.errors import UserError
from rewild4d.evaluation.reports import SCHEMA, Report
from rewild4d.io.ply import is_mesh, read_surface
from rewild4d.machine import code_version, machine
from rewild4d.metrics.geometry import POINTS, compare

UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def score_clouds(
    prediction: Path, truth: Path, *, up: Literal["y", "z"] | None = None, points: int = POINTS, seed: int = 0
) -> Report:
    """Compare two .ply files.

    Args:
        prediction: a mesh, sampled over its surface, Gaussians, whose centres count, or points.
        truth: the same.
        up: axis that points up in both files, for the alignment's starts.
        points: sampled from a mesh; of a larger cloud so many are drawn.
        seed: of all draws.

    Raises:
        UserError: a file that cannot be read, or points that cannot be compared.
    """
    started = time.monotonic()
    shape = read_surface(prediction, points, seed)
    # Only a mesh can be sampled twice: of points, `compare` makes two draws that share none.
    sampled = is_mesh(truth)
    target = read_surface(truth, points if sampled else sys.maxsize, seed + 1)
    independent = read_surface(truth, points, seed + 2) if sampled else None
    try:
        found = compare(
            shape, target, up=torch.tensor(UP[up]) if up else None, second=independent, points=points, seed=seed
        )
    except ValueError as error:
        raise UserError(f"{prediction} against {truth}: {error}.") from error
    floors = [f"{name} {item.floor:.4g}" for name, item in found.scores.items() if item.floor is not None]
    notes = [
        f"aligned by scale {fit.scale:.4g} ({'at its bound, ' if fit.clamped else ''}start {fit.start}, "
        f"{fit.iterations} iterations)" for fit in found.alignments if fit is not None
    ]  # fmt: skip
    return Report(
        schema=SCHEMA,
        kind="geometry",
        inputs={"prediction": str(prediction), "truth": str(truth)},
        settings={"up": up or "unknown", "points": str(points), "seed": str(seed), "diagonal": f"{found.diagonal:.6g}"},
        scores={name: msgspec.structs.replace(item, floor=None) for name, item in found.scores.items()},
        distances=[],
        networks={},
        items=[str(prediction)],
        notes=[*notes, found.note, *([f"floor of each: {', '.join(floors)}"] if floors else [])],
        code=code_version(),
        machine=machine(torch.device("cpu"), "none"),
        seconds=round(time.monotonic() - started, 3),
    )
