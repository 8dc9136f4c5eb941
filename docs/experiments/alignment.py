"""Measure what alignments do to finished runs under cameras that know the scale (alignment.md).

python docs/experiments/alignment.py runs        # a folder that `run --out` named, such as that of `make bench`
"""

import sys
from pathlib import Path

import torch

from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.contracts import Reconstruction
from rewild4d.evaluation import measuring, placing
from rewild4d.evaluation.geometry_scores import score_geometry
from rewild4d.evaluation.image_scores import measure
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.leaderboard.records import FILE, read_record
from rewild4d.registry import load_method
from rewild4d.running.rescoring import reader_of
from rewild4d.types import Truth

EACH = 23
"""Every so manieth held-out image is drawn: 20 of 460."""


def psnr(reconstruction: Reconstruction, truth: Truth, placement: Placement) -> float:
    """Compute the mean PSNR of some held-out images after a placement."""
    frames = [truth.held_out[i] for i in range(0, len(truth.held_out), EACH)]
    drawn = list(measuring._render_frames(reconstruction, frames, placement))
    values = measure("psnr", measuring._beside(frames, drawn, 1.0), {})
    return sum(value or 0.0 for value in values) / len(values)


def row(run: Path) -> str:
    """Measure one run: a line of the table."""
    record = read_record(run / FILE)
    protocol = find_protocol(record.dataset, record.protocol["name"])
    clip, truth = reader_of(run, record, None).load(record.case, protocol.selection)
    reconstruction = load_method(record.method).load(run / "reconstruction", torch.device("cpu"))
    names, points = ("chamfer_relative", "fscore_1"), protocol.points or 0
    (old, _), (new, found) = (
        score_geometry(reconstruction, truth, clip.times, names, points, even=even) for even in (False, True)
    )
    placed = placing.free_scale(reconstruction, clip, truth, points)
    similarity = Placement(torch.tensor(found[0]["matrix"], dtype=torch.float64))
    drawn = [psnr(reconstruction, truth, one) for one in (IDENTITY, placed.scale, placed.rigid, similarity)]
    shapes = [f"{one[name].value:.5f}" for name in names for one in (old, new)]
    scales = [f"{found[0]['scale']:.4f}", f"{placed.found.scale:.4f}" if placed.found else ""]
    return " | ".join([record.case, record.method, *shapes, *scales, *(f"{value:.2f}" for value in drawn)])


if __name__ == "__main__":
    print("case | method | CD | CD evenly | F@1 | F@1 evenly | similarity | scale | PSNR | scaled | rigid | similar")
    for path in sorted(Path(sys.argv[1]).rglob(FILE)):
        if read_record(path).method != "empty":
            print(row(path.parent), flush=True)
