"""How long a fit took: over all its starts, less what was lost with each stop."""

import json
import time
from pathlib import Path

from rewild4d.errors import UserError, reason
from rewild4d.files import write_text
from rewild4d.foreign.texts import read_json
from rewild4d.ours.checkpoint import NAME as CHECKPOINT

STAMP = "fit.json"
"""Duration of the fit, written last, beside a saved reconstruction."""
CLOCK = "clock.json"
"""When the fit was started last, and the seconds that its checkpoint held then."""


class Clock:
    """Measures a fit that may go on from a checkpoint.

    Args:
        work: folder of the fit's checkpoints. What an earlier start there saved is counted up to its last checkpoint.
    """

    def __init__(self, work: Path) -> None:
        self.before = _saved(work)
        write_text(work / CLOCK, json.dumps({"seconds": self.before, "started": time.time()}) + "\n")
        self.began = time.perf_counter()

    def seconds(self) -> float:
        """Return the seconds of the fit so far."""
        return self.before + time.perf_counter() - self.began

    def stamp(self, folder: Path) -> None:
        """Write the duration into the folder of a run whose reconstruction is saved."""
        write_text(folder / STAMP, json.dumps({"seconds": self.seconds()}) + "\n")


def _saved(work: Path) -> float:
    """Return the seconds that the checkpoint of an earlier start took; 0 where there is none."""
    clock, checkpoint = work / CLOCK, work / CHECKPOINT
    if not clock.is_file() or not checkpoint.is_file():
        return 0.0
    try:
        found = read_json(clock, "when a fit was started")
        spent, started = float(found["seconds"]), float(found["started"])
    except (UserError, ValueError, KeyError, TypeError, OverflowError):
        return 0.0  # the checkpoint is good without it
    # Without a checkpoint since that start, it only repeated what was lost.
    return spent + max(0.0, checkpoint.stat().st_mtime - started)


def fit_seconds(folder: Path) -> float:
    """Read how long the finished fit in a run's folder took."""
    try:
        found = read_json(folder / STAMP, "the time of a finished fit")
        # The second name is that of runs until 2026-11-28, which counted from their last start.
        return float(found["seconds"] if "seconds" in found else found["seconds_since_last_start"])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise UserError(
            f"{folder / STAMP}: expected the time of a finished fit, got a damaged file ({reason(error)})."
        ) from error
