"""Keypoints of a film: arithmetic that a reader can check in the head, and transcriptions of the papers' formulas."""

import numpy as np
import pytest
from scipy.optimize import minimize

from rewild4d.metrics.convex import LEAST, convex_map, mixed
from rewild4d.metrics.keypoints import (
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
from rewild4d.metrics.tallies import FrameSums, worst_mean

RNG = np.random.default_rng(0)


def everything(points: np.ndarray) -> np.ndarray:
    return np.ones(points.shape[:2], dtype=bool)


def random_film(frames: int = 7, joints: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    true = RNG.uniform(0, 64, (frames, joints, 2))
    return true + RNG.normal(0, 4, true.shape), true, RNG.random((frames, joints)) < 0.7


def test_a_keypoint_is_correct_below_a_share_of_the_length_and_not_at_it() -> None:
    true = np.zeros((1, 3, 2))
    off = np.array([[[3.0, 4.0], [0.0, 4.9], [0.0, 5.1]]])  # 5, 4.9 and 5.1 pixels
    found = pck(true + off, true, everything(true), np.array([50.0]), 0.1)
    assert (found.sums.tolist(), found.counts.tolist(), found.pooled()) == ([1.0], [3], 1 / 3)


def test_the_same_prediction_has_another_pck_by_area_box_and_crop() -> None:
    mask = np.zeros((1, 100, 100), dtype=bool)
    mask[0, 10:26, 20:84] = True  # 64 x 16 pixels: the root of the area is 32
    true = np.zeros((1, 1, 2))
    lengths = area_lengths(mask), box_lengths(mask_boxes(mask)), np.array([100.0])
    assert [float(length[0]) for length in lengths] == [32.0, 64.0, 100.0]
    off = np.array([[[0.0, 5.0]]])  # above 3.2, below 6.4 and 10
    assert [pck(true + off, true, everything(true), length, 0.1).pooled() for length in lengths] == [0.0, 1.0, 1.0]


def test_means_over_joints_and_over_frames_differ_where_frames_show_unequally_many() -> None:
    found = FrameSums(np.array([3.0, 0.0, 0.0]), np.array([3, 1, 0]))
    assert found.pooled() == 3 / 4
    assert found.mean_of_frames() == (1 + 0) / 2
    assert found.mean_of_frames(empty=0.0) == (1 + 0 + 0) / 3
    assert found.per_frame() == [1.0, 0.0, None]


def test_without_a_visible_joint_there_is_no_number() -> None:
    predicted, true, _ = random_film()
    nothing = np.zeros(true.shape[:2], dtype=bool)
    lengths = np.full(len(true), 64.0)
    for found in (pck(predicted, true, nothing, lengths, 0.1), mpjve(predicted, true, nothing, 64.0),
                  accel(predicted, true, nothing, 64.0, 10.0)):  # fmt: skip
        assert (found.total, found.pooled(), found.mean_of_frames(), found.mean_of_frames(empty=0.0)) == (
            0,
            *[None] * 3,
        )


def test_an_empty_mask_counts_no_keypoint_of_its_frame() -> None:
    masks = np.zeros((2, 8, 8), dtype=bool)
    masks[1, :4, :4] = True
    assert area_lengths(masks).tolist() == [0.0, 4.0] and box_lengths(mask_boxes(masks)).tolist() == [0.0, 4.0]
    true = np.zeros((2, 1, 2))
    assert pck(true, true, everything(true), area_lengths(masks), 0.1).counts.tolist() == [0, 1]


def test_one_frame_has_no_velocity_and_two_have_no_acceleration() -> None:
    true = np.zeros((2, 1, 2))
    assert len(mpjve(true[:1], true[:1], everything(true[:1]), 64.0).sums) == 0
    assert accel(true, true, everything(true), 64.0, 10.0).pooled() is None
    assert accel(true[:1], true[:1], everything(true[:1]), 64.0, 10.0, step=5).pooled() is None


def test_a_predicted_nan_that_counts_is_an_error_and_one_that_does_not_is_never_read() -> None:
    predicted, true, _ = random_film()
    counted, lengths = everything(true), np.full(len(true), 64.0)
    predicted[4, 2] = np.nan
    for call in (lambda: pck(predicted, true, counted, lengths, 0.1), lambda: mpjve(predicted, true, counted, 64.0),
                 lambda: accel(predicted, true, counted, 64.0, 10.0)):  # fmt: skip
        with pytest.raises(
            ValueError, match=r"expected finite predicted keypoints, got \[nan nan\] of frame 4, joint 2"
        ):
            call()
    counted[4, 2] = False
    assert pck(predicted, true, counted, lengths, 0.1).total == counted.sum()
    true[0, 0] = np.inf
    with pytest.raises(ValueError, match="expected finite true keypoints"):
        mpjve(predicted, true, counted, 64.0)


def test_joints_in_another_order_are_found_by_their_names() -> None:
    predicted, true, counted = random_film(joints=3)
    ours, theirs = ("nose", "neck", "tail"), ("tail", "nose", "neck")
    rows = joint_rows(theirs, ours)
    shuffled = true[:, joint_rows(ours, theirs)]
    assert np.array_equal(shuffled[:, rows], true)
    lengths = np.full(len(true), 40.0)
    again = pck(predicted, shuffled[:, rows], counted, lengths, 0.1)
    assert again.pooled() == pck(predicted, true, counted, lengths, 0.1).pooled()
    with pytest.raises(ValueError, match="expected the joint 'paw' among tail, nose, neck"):
        joint_rows(theirs, ("paw",))


def test_pck_of_both_papers_equals_a_transcription() -> None:
    predicted, true, counted = random_film()
    lengths, hits, shares = RNG.uniform(20, 60, len(true)), [], []
    for p, g, visible, length in zip(predicted, true, counted, lengths, strict=True):
        near = [np.hypot(*(p[k] - g[k])) < 0.1 * length for k in range(len(p))]
        hits += [ok for ok, seen in zip(near, visible, strict=True) if seen]
        shares.append(np.mean([ok for ok, seen in zip(near, visible, strict=True) if seen]) if visible.any() else 0.0)
    found = pck(predicted, true, counted, lengths, 0.1)
    assert found.pooled() == pytest.approx(np.mean(hits))
    assert found.mean_of_frames(empty=0.0) == pytest.approx(np.mean(shares))


def test_velocity_errors_equal_a_transcription_in_coordinates_from_minus_one_to_one() -> None:
    predicted, true, _ = random_film()
    p, g = (points / 64 * 2 - 1 for points in (predicted, true))
    wanted = np.linalg.norm((p[1:] - p[:-1]) - (g[1:] - g[:-1]), axis=-1).mean()
    assert mpjve(predicted, true, everything(true), 64.0).pooled() == pytest.approx(wanted)


def test_a_constant_offset_has_no_error_of_velocity_or_acceleration() -> None:
    predicted, true, counted = random_film()
    assert mpjve(true + 3, true, counted, 64.0).pooled() == pytest.approx(0, abs=1e-12)
    assert accel(true + 3, true, counted, 64.0, 30.0).pooled() == pytest.approx(0, abs=1e-9)


def test_acceleration_equals_a_transcription_and_grows_with_the_square_of_the_frame_rate() -> None:
    predicted, true, counted = random_film()
    p, g = predicted / 64 - 0.5, true / 64 - 0.5
    errors = np.linalg.norm((p[:-2] - 2 * p[1:-1] + p[2:]) - (g[:-2] - 2 * g[1:-1] + g[2:]), axis=2)
    visible = counted[:-2] & counted[1:-1] & counted[2:]
    frames = (errors * visible).sum(1) / np.maximum(visible.sum(1), 1)
    slow, published = (accel(predicted, true, counted, 64.0, fps) for fps in (10.0, 30.0))
    assert published.mean_of_frames(empty=0.0) == pytest.approx(frames.mean() * 30**2)
    assert (published.pooled() or 0) / (slow.pooled() or 0) == pytest.approx(9)


def test_velocities_over_a_step_are_those_of_every_second_frame() -> None:
    predicted, true, counted = random_film()
    counted[1::2] = False
    half = mpjve(predicted[::2], true[::2], counted[::2], 64.0)
    assert mpjve(predicted, true, counted, 64.0, step=2).pooled() == pytest.approx(half.pooled())
    assert usual_step(counted) == 2 and usual_step(counted[:1]) is None


def test_a_keypoint_goes_with_the_nearest_visible_point() -> None:
    points, target = np.array([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0]]), np.array([[0.0, 5.0], [1.0, 6.0], [9.0, 7.0]])
    keypoint = np.array([[1.2, 0.0]])
    assert transferred(points, np.array([True, True, True]), keypoint, target).tolist() == [[1.0, 6.0]]
    assert transferred(points, np.array([True, False, True]), keypoint, target).tolist() == [[0.0, 5.0]]
    with pytest.raises(ValueError, match="no point of the reconstruction is visible"):
        transferred(points, np.zeros(3, dtype=bool), keypoint, target)
    with pytest.raises(ValueError, match="expected finite target"):
        transferred(points, np.ones(3, dtype=bool), keypoint, target * np.nan)


def test_a_convex_map_finds_the_mixture_that_made_the_keypoints() -> None:
    points = RNG.uniform(0, 64, (12, 4, 2))
    weights = np.array([[0.5, 0.25, 0.25, 0.0], [0.0, 0.0, 0.1, 0.9]])
    found = convex_map(points, mixed(weights, points), np.ones((12, 2), dtype=bool))
    assert found == pytest.approx(weights, abs=1e-6)


def test_a_convex_map_is_the_least_squares_solution_under_both_constraints() -> None:
    points, keypoints = RNG.uniform(0, 64, (10, 5, 2)), RNG.uniform(0, 64, (10, 1, 2))
    found = convex_map(points, keypoints, np.ones((10, 1), dtype=bool))[0]
    assert (found >= 0).all() and found.sum() == pytest.approx(1)

    def cost(weights: np.ndarray) -> float:
        return float(np.square(np.einsum("v,fvd->fd", weights, points) - keypoints[:, 0]).sum())

    oracle = minimize(
        cost, np.full(5, 0.2), method="SLSQP", bounds=[(0, 1)] * 5, options={"ftol": 1e-12, "maxiter": 500},
        constraints={"type": "eq", "fun": lambda weights: weights.sum() - 1},
    )  # fmt: skip
    assert cost(found) == pytest.approx(oracle.fun, rel=1e-6) and cost(found) <= oracle.fun * (1 + 1e-6)


def test_a_joint_that_too_few_training_frames_show_has_no_row() -> None:
    points, counted = RNG.uniform(0, 64, (8, 4, 2)), np.ones((8, 2), dtype=bool)
    counted[LEAST - 1 :, 1] = False
    found = convex_map(points, points[:, :2], counted)
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()
    with pytest.raises(ValueError, match="expected finite points and keypoints"):
        convex_map(points * np.nan, points[:, :2], counted)


def test_the_mean_of_the_worst_frames_needs_twenty_of_them() -> None:
    values = [float(value) for value in range(40)]
    assert worst_mean(values, "higher") == (0 + 1) / 2 and worst_mean(values, "lower") == (39 + 38) / 2
    assert worst_mean(values[:20], "higher") == 0.0 and worst_mean(values[:19], "higher") is None


def test_clips_that_are_put_together_pool_their_joints() -> None:
    both = FrameSums(np.array([1.0]), np.array([2])) + FrameSums(np.array([3.0]), np.array([2]))
    assert both.pooled() == 4 / 4
