"""Score a fitted reconstruction for its record."""

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from rewild4d.contracts import DatasetReader, Reconstruction, Verdict
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.placing import scale_of
from rewild4d.evaluation.protocol import Protocol
from rewild4d.evaluation.refining import ready_to_score
from rewild4d.evaluation.trust import result_verdict
from rewild4d.metrics.score import Score
from rewild4d.priors.judge import prior_verdict
from rewild4d.progress import Progress
from rewild4d.running import provenance
from rewild4d.types import Clip, Truth
from rewild4d.visualize.original_view import original_frames
from rewild4d.visualize.run_pictures import save_pictures


def score(
    reconstruction: Reconstruction, clip: Clip, truth: Truth, shown: Clip, *, protocol: Protocol, method: str,
    prior: str, quality: Mapping[str, float], reader: DatasetReader, folder: Path, device: torch.device, title: str,
) -> tuple[dict[str, Any], float]:  # fmt: skip
    """Refine where the method asks for it, evaluate, draw.

    Args:
        reconstruction: of ``shown``.
        clip: all frames of the video.
        truth: from the data set.
        shown: the frames of the clip that the method saw.
        protocol: what is measured.
        method: its name.
        prior: the value of `--prior`.
        quality: figures of the prior's fit.
        reader: of the data set.
        folder: of the run; gets pictures and features.
        device: that computes.
        title: of the progress bars.

    Returns:
        Fields of the record; seconds that refinement and evaluation took.
    """
    begin = time.perf_counter()
    with closing(Progress(f"{title}: refine on held-out frames")) as log:
        reconstruction, clip, truth = ready_to_score(reconstruction, clip, truth, shown, log)
    with closing(Progress(f"{title}: evaluate")) as log:
        found = evaluate(reconstruction, clip, truth, protocol, log, device)
    seconds = time.perf_counter() - begin
    originals = original_frames(reader, clip, protocol.selection)
    pictures = save_pictures(reconstruction, clip, truth, folder, originals, scale_of(found.alignments))
    return {
        "status": "ok",
        "error": "",
        "pictures": pictures,
        **found.keep(folder),
        "diagnostics": provenance.diagnostics(reconstruction, shown, protocol.background),
        "marks": provenance.marks(method, prior, reconstruction),
        "verdicts": _verdicts(reconstruction, clip, shown, quality, found.scores, reader),
    }, seconds


def _verdicts(
    reconstruction: Reconstruction, clip: Clip, shown: Clip, quality: Mapping[str, float], scores: Mapping[str, Score],
    reader: DatasetReader,
) -> list[Verdict]:  # fmt: skip
    """Judge the masks of a film, a fitted prior and the result."""
    judge: Callable[[str], Verdict] | None = getattr(reader, "judge_masks", None)
    verdicts = [
        judge(clip.name) if judge else None,
        prior_verdict(quality, len(clip.frames) - len(shown.frames), len(clip.frames)),
        result_verdict(reconstruction, shown, scores, quality.get("mask_iou")),
    ]
    return [verdict for verdict in verdicts if verdict is not None]
