"""Whether the numbers of a record can be right, told from the record alone."""

import math
import re
from collections.abc import Iterator
from datetime import datetime
from statistics import fmean

from rewild4d.leaderboard.records import RunRecord
from rewild4d.metrics.as_published import RMSE_PSNR_CAP
from rewild4d.metrics.image import PSNR_CAP
from rewild4d.metrics.names import RIGID, SCALE, SILHOUETTES
from rewild4d.metrics.score import Score

MEAN_TOLERANCE = 1e-3
"""A mean may differ from that of its items, whose digits are cut, by this part of the largest item."""
RANGES = {
    "psnr_black": (-math.inf, RMSE_PSNR_CAP), "psnrm": (-math.inf, RMSE_PSNR_CAP), "psnr_pooled": (-math.inf, math.inf),
    "psnr": (0.0, PSNR_CAP), "pck": (0.0, 1.0), "kt": (0.0, 1.0), "mpjve": (0.0, math.inf), "accel": (0.0, math.inf),
    "ssim": (-1.0, 1.0), "lpips": (0.0, math.inf), "fscore": (0.0, 1.0),
    "chamfer": (0.0, math.inf), "kid": (-1.0, math.inf), "fvd": (0.0, math.inf),
    **dict.fromkeys(SILHOUETTES, (0.0, 1.0)),
}  # fmt: skip
"""Beginning of a score's name -> least and largest value that its definition allows; the first that fits counts, and
colours are in [0, 1]. KID is an unbiased estimate, which may be below zero."""


def implausible(record: RunRecord) -> list[str]:
    """Say what in a record cannot be, a sentence each; of metrics of other packages nothing is known but that."""
    faults = [*_run(record)]
    own = {name: score for name, score in record.scores.items() if name not in record.metrics}
    for name, score in own.items():
        faults += [f"{name}: {fault}" for fault in _score(name, score)]
    asked = set(record.protocol["scores"]) if record.status == "ok" else set()
    if given := sorted(asked ^ set(own)):
        faults.append(f"expected the scores of its protocol and no others; of one alone: {', '.join(given)}.")
    return faults


def _run(record: RunRecord) -> Iterator[str]:
    if not re.fullmatch("[0-9a-f]{16}", record.run_id):
        yield "expected a run id of sixteen hexadecimal digits."
    if not 0 <= record.seed < 2**63:
        yield f"expected a seed from 0 to 2^63 - 1, got {record.seed}."
    if record.status not in ("ok", "failed"):
        yield "expected the status 'ok' or 'failed'."
    for name in ("clip", "truth"):
        if not re.fullmatch("[0-9a-f]{64}", record.data.get(name, "")):
            yield f"expected a SHA-256 of the {name}."
    if not record.code.get("sources"):
        yield "expected a digest of the code."
    timing = record.timing
    if min(timing.fit_seconds, timing.evaluate_seconds, timing.peak_memory_mib) < 0:
        yield "expected times and memory of at least 0."
    try:
        datetime.fromisoformat(timing.started)
    except ValueError:
        yield "expected the moment at which it started."


def _score(name: str, score: Score) -> Iterator[str]:
    values = [value for value in score.per_item if value is not None]
    if score.value is None:
        if not score.note:
            yield "no value, and no note that says why."
        return
    least, most = _range(name)
    for value in (score.value, *values):
        if not least <= value <= most or not math.isfinite(value):
            yield f"expected values from {least:g} to {most:g}, got {value:g}."
            break
    if score.count < max(1, len(values)):
        yield f"expected a count of at least its {max(1, len(values))} values, got {score.count}."
    if values and abs(fmean(values) - score.value) > MEAN_TOLERANCE * max(map(abs, values)):
        yield f"the mean of its {len(values)} values is {fmean(values):.6g}, but it says {score.value:.6g}."
    if score.floor is not None and _is_better(score.value, score.floor, score.better):
        yield f"{score.value:.6g} is better than what a perfect result would get, {score.floor:.6g}."


def _range(name: str) -> tuple[float, float]:
    if name == SCALE:
        return 0.0, math.inf
    bare = name.removesuffix(RIGID)
    return next((found for start, found in RANGES.items() if bare.startswith(start)), (-math.inf, math.inf))


def _is_better(value: float, than: float, better: str) -> bool:
    """Compare beyond the last digits; 'higher', 'lower', or nothing that could be better."""
    slack = 1e-9 * max(1.0, abs(than))
    return {"higher": value > than + slack, "lower": value < than - slack}.get(better, False)
