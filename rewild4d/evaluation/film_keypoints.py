"""Score the keypoints of a film under every definition of `metrics.definitions`, from arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import TYPE_CHECKING

import numpy as np

from rewild4d.errors import UserError
from rewild4d.metrics.convex import convex_map, mixed
from rewild4d.metrics.definitions import AIM, KEYPOINTS, TRANSFER
from rewild4d.metrics.keypoints import (
    Bools,
    accel,
    area_lengths,
    box_lengths,
    joint_rows,
    mask_boxes,
    mpjve,
    pck,
    transferred,
    usual_step,
)
from rewild4d.metrics.score import Score
from rewild4d.metrics.tallies import Floats, FrameSums

if TYPE_CHECKING:
    from rewild4d.types import Frame

PUBLISHED_FPS = 30.0
"""Frame rate that 4DEquine's Accel has for every data set."""
HALVES = 6
"""Annotated frames without which there are no two halves to fit a map to."""


@dataclass(frozen=True)
class Annotated:
    """The annotated keypoints of a film and the lengths by which distances are divided.

    Attributes:
        names: of the joints.
        true: pixels of each frame's square image; anything where not counted, float64, [T, K, 2].
        counted: what is annotated and counts, bool, [T, K].
        placed: and what a network placed without being sure of it, which counts for Animal-in-Motion, [T, K].
        present: frames that are annotated, with or without a joint that counts, bool, [T].
        areas: square root of the true masks' areas, pixels, [T].
        boxes: longer sides of the true masks' boxes, pixels, [T].
        side: of the square images in pixels.
        times: of the frames in seconds, ascending, [T].
    """

    names: tuple[str, ...]
    true: Floats
    counted: Bools
    placed: Bools
    present: Bools
    areas: Floats
    boxes: Floats
    side: float
    times: Floats

    def only(self, rows: np.ndarray) -> Annotated:
        """Return some of the frames, in their order."""
        return Annotated(
            self.names, self.true[rows], self.counted[rows], self.placed[rows], self.present[rows], self.areas[rows],
            self.boxes[rows], self.side, self.times[rows],
        )  # fmt: skip

    def counts_for(self, name: str) -> Bools:
        """Return what counts for a score: every joint for those of Animal-in-Motion, as its evaluator has it."""
        return self.placed if (KEYPOINTS | TRANSFER)[name].source == AIM else self.counted

    @property
    def rows(self) -> np.ndarray:
        """Frames in which a joint counts for any score, ascending."""
        return np.flatnonzero(self.placed.any(axis=1))


@dataclass(frozen=True)
class Part:
    """Predicted keypoints of some frames of a film.

    Attributes:
        rows: consecutive frames of the film, [t].
        points: pixels, finite where the joints count, [t, K, 2].
        counted: joints of which there is a prediction, [K].
        trained: seconds of the frames that a map was fitted to.
    """

    rows: np.ndarray
    points: Floats
    counted: Bools
    trained: tuple[float, ...] = ()


def annotated(frames: Sequence[Frame], known: Sequence[str] | None = None) -> Annotated | None:
    """Gather the keypoints of a film's frames; None where there are none.

    Args:
        frames: square images with true masks, in the order of time.
        known: joints that are asked for, in this order; all in the order of the first annotated frame where None.

    Raises:
        UserError: images that are not square or not of one size, or a joint that is not annotated.
    """
    first = next((frame.keypoints for frame in frames if frame.keypoints is not None), None)
    if first is None:
        return None
    names = tuple(first.names if known is None else known)
    sizes = {tuple(frame.mask.shape[1:]) for frame in frames}
    (height, width), *others = sizes
    if others or height != width:
        raise UserError(f"keypoints: expected square images of one size, got {sorted(sizes)}.")
    true, counted = np.full((len(frames), len(names), 2), np.nan), np.zeros((len(frames), len(names)), dtype=bool)
    placed = counted.copy()
    for row, found in enumerate(frame.keypoints for frame in frames):
        if found is not None:
            try:
                order = joint_rows(found.names, names)
            except ValueError as error:
                raise UserError(f"keypoints of frame {row}: {error}.") from error
            true[row], counted[row] = found.points[order].double().numpy(), found.visible[order].numpy()
            placed[row] = counted[row] if found.confidence is None else True
    masks = np.stack([frame.mask[0].numpy() >= 0.5 for frame in frames])
    present = np.array([frame.keypoints is not None for frame in frames])
    lengths = area_lengths(masks), box_lengths(mask_boxes(masks))
    times = np.array([frame.time for frame in frames])
    return Annotated(names, true, counted, placed, present, *lengths, float(width), times)


def mapped(truth: Annotated, points: Floats, halves: bool) -> list[Part]:
    """Predict keypoints as convex mixtures of tracked points (`metrics.convex`).

    Args:
        truth: of the film.
        points: tracked in the annotated frames, `Annotated.rows`, pixels, [len(rows), V, 2].
        halves: fit a map to the first half of the annotated frames and score the second with it, and the reverse, so
            that no frame is scored by a map that was fitted to it; else one map is fitted to all and scored on all.

    Raises:
        ValueError: too few annotated frames for halves.
    """
    rows = truth.rows
    if halves and len(rows) < HALVES:
        raise ValueError(f"two halves need at least {HALVES} annotated frames, and there are {len(rows)}")
    middle = len(rows) // 2
    splits = [(slice(middle, None), slice(0, middle)), (slice(0, middle), slice(middle, None))]
    parts = []
    for train, test in splits if halves else [(slice(None), slice(None))]:
        shown = truth.only(rows[train])
        weights = convex_map(points[train], shown.true, shown.placed)
        usable: Bools = np.asarray(np.isfinite(weights).all(axis=1), dtype=bool)
        span = np.arange(rows[test][0], rows[test][-1] + 1)
        predicted = np.full((len(span), len(truth.names), 2), np.nan)
        predicted[rows[test] - span[0]] = mixed(weights, points[test])
        parts.append(Part(span, predicted, usable, tuple(shown.times.tolist())))
    return parts


def score_keypoints(truth: Annotated, parts: Sequence[Part], source: str) -> dict[str, Score]:
    """Compute every score of `metrics.definitions.KEYPOINTS`.

    Args:
        truth: of the film.
        parts: that together hold each annotated frame once; velocities do not cross from one to the next.
        source: one of `metrics.definitions.KEYPOINT_SOURCES`, the end of the scores' names.

    Raises:
        ValueError: a predicted keypoint that counts and is not finite.
    """
    step = usual_step(truth.counted) or 1
    fps = _rate(truth, step)
    shown = [(truth.only(part.rows), part) for part in parts]
    note = _note(truth, parts, step, fps)
    scores = {}
    for name in KEYPOINTS:
        tallies = [
            _tally(name, some, part.points, some.counts_for(name) & part.counted, step, fps) for some, part in shown
        ]
        by_frame = name.endswith("_crop") or name.startswith("accel")
        scores[f"{name}_{source}"] = _score(name, reduce(add, tallies), by_frame, note)
    return scores


def score_transfer(truth: Annotated, points: Floats, seen: Bools) -> dict[str, Score]:
    """Compute keypoint transfer from the first annotated frame to the last.

    Args:
        truth: of the film.
        points: tracked in the annotated frames, `Annotated.rows`, pixels, [len(rows), V, 2].
        seen: which of them are visible in the first of these frames, [V].
    """
    rows = truth.rows
    if len(rows) < 2:
        return _untransferred("it takes two annotated frames")
    both: Bools = np.logical_and(truth.placed[rows[0]], truth.placed[rows[-1]])
    if not both.any():
        return _untransferred("no joint is annotated both in the first and in the last annotated frame")
    if not seen.any():
        return _untransferred("no point of the reconstruction is visible in the first annotated frame")
    last = truth.only(rows[-1:])
    moved = np.full((1, len(both), 2), np.nan)
    moved[0, both] = transferred(points[0], seen, truth.true[rows[0], both], points[-1])
    note = f"from {truth.times[rows[0]]:.2f} to {truth.times[rows[-1]]:.2f} s"
    return {
        name: _score(name, pck(moved, last.true, both[None], last.areas, threshold_of(name)), False, note)
        for name in TRANSFER
    }


def _untransferred(reason: str) -> dict[str, Score]:
    return {name: without(name, reason) for name in TRANSFER}


def threshold_of(name: str) -> float:
    """Return the threshold in a score's name.

    Examples:
        >>> threshold_of("pck@0.15_crop")
        0.15
    """
    return float(name.partition("@")[2].partition("_")[0])


def without(name: str, reason: str) -> Score:
    """Return a score that could not be computed."""
    defined = (KEYPOINTS | TRANSFER)[name]
    return Score(None, defined.unit, defined.better, 0, note=f"not computed: {reason}")


def _tally(name: str, part: Annotated, points: Floats, counted: Bools, step: int, fps: float) -> FrameSums:
    """Return the sums and counts behind a score; of those with a mean over frames, of annotated frames alone."""
    if name == "mpjve":
        return mpjve(points, part.true, counted, part.side, step)
    if name.startswith("accel"):
        rate = PUBLISHED_FPS if name.endswith("30fps") else fps
        found = accel(points, part.true, counted, part.side, rate, step)
        standing = np.array(
            [part.present[start : start + 2 * step + 1 : step].all() for start in range(len(found.sums))]
        )
    else:
        lengths = {"mask_area": part.areas, "box": part.boxes, "crop": np.full(len(part.true), part.side)}
        found = pck(points, part.true, counted, lengths[name.partition("_")[2]], threshold_of(name))
        standing = part.present
    return FrameSums(found.sums[standing], found.counts[standing]) if len(standing) else found


def _rate(truth: Annotated, step: int) -> float:
    """Return how many steps between annotated frames a second has; 1 where there is no step."""
    gaps = truth.times[step:] - truth.times[:-step]
    return 1 / float(np.median(gaps)) if len(gaps) else 1.0


def _score(name: str, tally: FrameSums, by_frame: bool, note: str) -> Score:
    """Return the mean that a score's definition takes: of the frames' means, with 0 for an empty one, or of all."""
    defined = (KEYPOINTS | TRANSFER)[name]
    value = tally.mean_of_frames(empty=0.0) if by_frame else tally.pooled()
    if value is None:
        needs = {"mpjve": "two", "accel": "three", "accel_at_30fps": "three"}.get(name)
        several = f"no joint is annotated in {needs} evenly spaced frames"
        return without(name, several if needs else "no annotated joint has a prediction")
    return Score(value, defined.unit, defined.better, tally.total, note=note)


def _note(truth: Annotated, parts: Sequence[Part], step: int, fps: float) -> str:
    told = [f"{len(truth.rows)} annotated frames, {int(truth.counted.sum())} joints"]
    if len(truth.rows) > 1:
        told.append(f"{fps:.4g} steps a second from one to the next")
    usable = np.all([part.counted for part in parts], axis=0)
    missing = [name for name, kept in zip(truth.names, usable, strict=True) if not kept]
    if missing:
        told.append(f"without what the map's frames hardly show: {', '.join(missing)}")
    maps = [part.trained for part in parts if part.trained]
    return "; ".join([*told, *(f"map fitted to {len(at)} frames, {at[0]:.2f} to {at[-1]:.2f} s" for at in maps)])
