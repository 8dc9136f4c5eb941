"""Score keypoints of a film: PCK by three lengths, keypoint transfer, errors of velocity and of acceleration.

Papers of animals in videos print "PCK@0.1" and mean different numbers: distances are divided by the square root of the
mask's area, by a crop's side or by a box; all joints count or visible ones; the mean is over joints or over frames.
So a threshold, a length a frame and the joints that count are arguments here, and `FrameSums` give either mean.

Keypoints are (column, row) in pixels of each frame's image, float, [T, K, 2], in one order of joints (`joint_rows`).
``counted`` says which joints of which frames count, bool, [T, K]: what does not is never read and may be NaN.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rewild4d.metrics.tallies import Floats, FrameSums

Bools = NDArray[np.bool_]


def joint_rows(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Return where each wanted joint stands among ``names``: another order, or a set of fewer joints.

    Raises:
        ValueError: a wanted joint that is not there.

    Examples:
        >>> joint_rows(("nose", "neck", "left_eye"), ("left_eye", "nose"))
        [2, 0]
    """
    missing = [name for name in wanted if name not in names]
    if missing:
        raise ValueError(f"expected the joint '{missing[0]}' among {', '.join(names)}")
    return [list(names).index(name) for name in wanted]


def area_lengths(masks: Bools) -> Floats:
    """Return the square root of each mask's area in pixels, [T, h, w] -> [T]; 0 for an empty mask.

    Examples:
        >>> area_lengths(np.ones((1, 4, 9), dtype=bool)).tolist()
        [6.0]
    """
    return np.sqrt(_masks(masks).sum(axis=(1, 2), dtype=np.float64))


def mask_boxes(masks: Bools) -> Floats:
    """Return the box around each mask as left, top, width, height in pixels, [T, h, w] -> [T, 4]; 0 for an empty one.

    Examples:
        >>> mask = np.zeros((1, 8, 8), dtype=bool)
        >>> mask[0, 2:4, 1:6] = True
        >>> mask_boxes(mask).tolist()
        [[1.0, 2.0, 5.0, 2.0]]
    """
    boxes = np.zeros((len(_masks(masks)), 4))
    for box, mask in zip(boxes, masks, strict=True):
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        if len(rows):
            box[:] = columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1
    return boxes


def box_lengths(boxes: Floats) -> Floats:
    """Return the longer side of each box (left, top, width, height), [T, 4] -> [T].

    Examples:
        >>> box_lengths(np.array([[5.0, 5.0, 30.0, 40.0]])).tolist()
        [40.0]
    """
    if boxes.ndim != 2 or boxes.shape[1] != 4:
        raise ValueError(f"expected boxes [T, 4], got {boxes.shape}")
    return np.asarray(boxes[:, 2:].max(axis=1), dtype=np.float64)


def pck(predicted: Floats, true: Floats, counted: Bools, lengths: Floats, threshold: float) -> FrameSums:
    """Count keypoints that are nearer to the truth than a threshold times a length (Yang & Ramanan 2013).

        correct = |p - g| < threshold * length of the frame

    Definitions in use: Animal-in-Motion (scripts/run_benchmark.py at 904a443) takes `area_lengths` and all 17 joints,
    `FrameSums.pooled`; 4DEquine (eval_pose.py and amr/utils/pck_accuracy.py at 7f272d8) the side of a square crop and
    joints of confidence above 0.5, `FrameSums.mean_of_frames` with 0 for a frame without any; boxes, `box_lengths`.

    Args:
        predicted: finite where they count, [T, K, 2].
        true: [T, K, 2].
        counted: [T, K].
        lengths: pixels; frames of length 0 (an empty mask) count nothing, [T].
        threshold: share of the length, above zero.

    Returns:
        Correct keypoints and counted ones, a frame each.

    Raises:
        ValueError: other shapes, or a keypoint that counts and is not finite.

    Examples:
        >>> true, off = np.zeros((1, 2, 2)), np.array([[[3.0, 4.0], [0.0, 9.0]]])
        >>> pck(true + off, true, np.ones((1, 2), bool), np.array([60.0]), 0.1).pooled()
        0.5
    """
    counted = _checked(predicted, true, counted)
    if lengths.shape != counted.shape[:1] or not (lengths >= 0).all() or not threshold > 0:
        raise ValueError(f"expected lengths [T] of at least 0 and a threshold above 0, got {lengths} and {threshold}")
    counted = counted & (lengths > 0)[:, None]
    near = _norms(predicted - true, counted) < threshold * lengths[:, None]
    return _tally((near & counted).astype(np.float64), counted)


def transferred(points: Floats, seen: Bools, keypoints: Floats, target: Floats) -> Floats:
    """Carry keypoints from one frame to another with the nearest visible points of a reconstruction.

    KT of Animal-in-Motion (scripts/run_benchmark.py at 904a443): from the first frame of a sequence to the last, there
    scored by `pck` with the last frame's `area_lengths`.

    Args:
        points: points of the reconstruction in the one frame, pixels, [V, 2].
        seen: which of them are visible there, [V].
        keypoints: of the one frame, [K, 2].
        target: the same points in the other frame, [V, 2].

    Returns:
        The keypoints in the other frame, [K, 2].

    Raises:
        ValueError: other shapes, no visible point, or a value that is not finite.

    Examples:
        >>> points = np.array([[0.0, 0.0], [10.0, 0.0]])
        >>> transferred(points, np.array([True, True]), np.array([[8.0, 1.0]]), points + 5).tolist()
        [[15.0, 5.0]]
    """
    if points.shape != target.shape or points.ndim != 2 or seen.shape != points.shape[:1]:
        raise ValueError(f"expected points [V, 2] twice and seen [V], got {points.shape}, {target.shape}, {seen.shape}")
    if not seen.any():
        raise ValueError("no point of the reconstruction is visible in the first frame")
    for name, values in (("points", points[seen]), ("keypoints", keypoints), ("target", target[seen])):
        if not np.isfinite(values).all():
            raise ValueError(f"expected finite {name}, got a NaN or an infinite value")
    rows = np.flatnonzero(seen)
    distances = np.linalg.norm(points[rows][None] - keypoints[:, None], axis=-1)
    return target[rows[distances.argmin(axis=1)]]


def mpjve(predicted: Floats, true: Floats, counted: Bools, side: float, step: int = 1) -> FrameSums:
    """Compute the mean per-joint velocity error, in halves of the image's side a step.

        e[t] = |(p[t + 1] - p[t]) - (g[t + 1] - g[t])| * 2 / side

    Coordinates are in [-1, 1], and nothing is divided by time. Source: Animal-in-Motion, scripts/run_benchmark.py at
    904a443 (`FrameSums.pooled`).

    Args:
        predicted: finite where they count, [T, K, 2].
        true: [T, K, 2].
        counted: [T, K]; a pair counts where both of its frames do.
        side: of the square image in pixels.
        step: frames from one annotated frame to the next.

    Returns:
        Of each pair of frames, [T - step]; of a single frame nothing.

    Raises:
        ValueError: as `pck`.

    Examples:
        >>> true = np.zeros((3, 1, 2))
        >>> still = np.array([[[0.0, 0.0]], [[0.0, 8.0]], [[0.0, 8.0]]])
        >>> mpjve(still, true, np.ones((3, 1), bool), side=16.0).per_frame()
        [1.0, 0.0]
    """
    counted = _checked(predicted, true, counted)
    both = counted[step:] & counted[:-step]
    error = predicted - true
    return _tally(_norms(error[step:] - error[:-step], both) * (2 / side), both)


def accel(predicted: Floats, true: Floats, counted: Bools, side: float, fps: float, step: int = 1) -> FrameSums:
    """Compute the error of accelerations, in sides of the image a second squared.

        e[t] = |(p[t] - 2 p[t + 1] + p[t + 2]) - (g[t] - 2 g[t + 1] + g[t + 2])| / side * fps^2

    Source: 4DEquine, eval_pose.py at 7f272d8 (`FrameSums.mean_of_frames` with 0 for a triple without a joint). There
    ``fps`` is 30 for all data sets, those of 10 frames a second included: the published variant is this with 30.

    Args:
        predicted: finite where they count, each frame in its own crop, [T, K, 2].
        true: [T, K, 2].
        counted: [T, K]; a triple counts where all three of its frames do.
        side: of the square crop in pixels.
        fps: steps in a second, above zero.
        step: frames from one annotated frame to the next.

    Returns:
        Of each triple of frames, [T - 2 step]; of fewer than three frames nothing.

    Raises:
        ValueError: as `pck`.

    Examples:
        >>> jumps = np.array([0.0, 0.0, 1.0])[:, None, None] * np.array([0.0, 1.0])
        >>> accel(jumps, np.zeros((3, 1, 2)), np.ones((3, 1), bool), side=10.0, fps=10.0).pooled()
        10.0
    """
    counted = _checked(predicted, true, counted)
    if not fps > 0:
        raise ValueError(f"expected a frame rate above 0, got {fps}")
    last = max(len(counted) - 2 * step, 0)
    first, middle, end = (slice(start, start + last) for start in (0, step, 2 * step))
    error, all_three = predicted - true, counted[first] & counted[middle] & counted[end]
    bends = error[first] - 2 * error[middle] + error[end]
    return _tally(_norms(bends, all_three) * (fps**2 / side), all_three)


def usual_step(counted: Bools) -> int | None:
    """Return the commonest distance between neighbouring annotated frames, in frames; None for fewer than two.

    Data sets annotate every frame, or every fifth; velocities are only comparable over one distance.

    Examples:
        >>> usual_step(np.array([[True], [False], [True], [False], [True], [True]]))
        2
    """
    gaps = np.diff(np.flatnonzero(counted.any(axis=1)))
    return int(np.bincount(gaps).argmax()) if len(gaps) else None


def _checked(predicted: Floats, true: Floats, counted: Bools) -> Bools:
    """Return which keypoints count, after shapes and values were looked at."""
    if predicted.shape != true.shape or true.ndim != 3 or true.shape[2] != 2 or counted.shape != true.shape[:2]:
        shapes = f"{predicted.shape}, {true.shape} and {counted.shape}"
        raise ValueError(f"expected predicted and true keypoints [T, K, 2] and counted [T, K], got {shapes}")
    for name, values in (("predicted", predicted), ("true", true)):
        wrong = np.argwhere(counted & ~np.isfinite(values).all(axis=2))
        if len(wrong):
            frame, joint = wrong[0]
            raise ValueError(
                f"expected finite {name} keypoints, got {values[frame, joint]} of frame {frame}, joint {joint}"
            )
    return np.asarray(counted, dtype=bool)


def _norms(vectors: Floats, counted: Bools) -> Floats:
    """Return lengths of the vectors that count, 0 for others, [T, K, 2] -> [T, K]."""
    return np.linalg.norm(np.where(counted[..., None], vectors, 0.0), axis=2)


def _tally(values: Floats, counted: Bools) -> FrameSums:
    return FrameSums(np.where(counted, values, 0.0).sum(axis=1), counted.sum(axis=1, dtype=np.int64))


def _masks(masks: Bools) -> Bools:
    if masks.ndim != 3 or masks.dtype != bool:
        raise ValueError(f"expected boolean masks [T, h, w], got {masks.dtype} {masks.shape}")
    return masks
