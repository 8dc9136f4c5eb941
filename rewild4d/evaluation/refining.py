"""Prepare a reconstruction for scoring: as fitted, or refined on the scored frames."""

from rewild4d.cameras.recropping import add_cameras
from rewild4d.contracts import Log, Reconstruction
from rewild4d.types import Clip, Truth


def ready_to_score(
    reconstruction: Reconstruction, clip: Clip, truth: Truth, shown: Clip, log: Log
) -> tuple[Reconstruction, Clip, Truth]:
    """Return a reconstruction, its clip and its truth as they are scored.

    Frames without a camera get the reconstruction's. A held-out frame without one is a time of the input view; a
    reconstruction that can be `refined` (contracts.Reconstruction) is fitted to those, and to nothing else.

    Args:
        reconstruction: of ``shown``.
        clip: all frames of the video.
        truth: from the data set.
        shown: the frames of the clip that the method saw.
        log: progress.

    Raises:
        ValueError: a refined reconstruction without marks.
    """
    clip, placed = add_cameras(reconstruction, clip, truth, shown)
    refine = getattr(reconstruction, "refined", None)
    if refine is None or not len(truth.held_out) or truth.held_out[0].camera is not None:
        return reconstruction, clip, placed
    refined = refine([frame for frame in placed.held_out if frame.camera is not None], log)
    if not getattr(refined, "marks", ()):
        raise ValueError(f"{type(reconstruction).__name__}.refined: expected marks that say so, got none.")
    return refined, clip, placed
