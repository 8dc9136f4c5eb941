"""Chamfer and F-score: arithmetic on known clouds, other packages as oracles, and what cannot be measured."""

import math
import time

import numpy as np
import pytest
import torch
from animals import UP, animal, floaters, yaw
from scipy.spatial.distance import cdist
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from rewild4d.io.sampling import sample_gaussians, sample_mesh
from rewild4d.metrics.geometry import POINTS, chamfer, compare, compare_sequence, distances, fscore
from rewild4d.types import Splats


def grid(side: int) -> Tensor:
    """The corners of a lattice of unit cells, [side^3, 3]."""
    axis = torch.arange(side, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)


DIAGONAL = 3 * 3**0.5
"""Of grid(4)."""


def test_two_points_one_unit_apart() -> None:
    a, b = torch.zeros(1, 3), torch.tensor(((0.0, 1.0, 0.0),))
    assert chamfer(a, b).to_truth == chamfer(a, b).to_prediction == chamfer(a, b).symmetric == 1
    assert fscore(a, b, 1.0) == 0 and fscore(a, b, 1.0 + 1e-9) == 1  # nearer than the threshold, not as near


def test_the_two_directions_are_kept_apart() -> None:
    prediction, truth = torch.tensor(((0.0, 0, 0),)), torch.tensor(((0.0, 0, 0), (3, 4, 0)))
    found = chamfer(prediction, truth)
    assert (found.to_truth, found.to_prediction, found.symmetric) == (0, (0 + 5) / 2, (0 + 2.5) / 2)
    precision, recall = 1, 1 / 2
    assert fscore(prediction, truth, 1.0) == 2 * precision * recall / (precision + recall)


def test_a_cloud_against_itself() -> None:
    cloud = animal(500, 0)
    found = compare(cloud, cloud, fit="none")
    for name, best in (("chamfer", 0), ("chamfer_relative", 0), ("fscore_1", 1), ("fscore_2", 1), ("fscore_5", 1)):
        assert found.scores[name + "_unaligned"].value == best


def test_a_shift_steps_each_fscore_at_its_own_share_of_the_diagonal() -> None:
    """The lattice is coarse: moved by up to half a cell (9.6 % of the diagonal), each point's nearest is its own."""
    truth = grid(4)
    for percent in (1, 2, 5):
        for factor, expected in ((0.999, 1), (1.001, 0)):
            moved = truth + torch.tensor((percent / 100 * DIAGONAL * factor, 0, 0))
            found = compare(moved, truth, fit="none").scores
            assert found[f"fscore_{percent}_unaligned"].value == expected
            assert found["chamfer_relative_unaligned"].value == pytest.approx(percent / 100 * factor)
            assert found["chamfer_unaligned"].value == pytest.approx(percent / 100 * factor * DIAGONAL)


def test_the_rest_pose_is_what_distances_are_relative_to() -> None:
    truth = grid(4)
    moved = truth + torch.tensor((0.1, 0.0, 0.0))
    assert compare(moved, truth, fit="none", diagonal=20.0).scores["chamfer_relative_unaligned"].value == (
        pytest.approx(0.1 / 20)
    )


@pytest.mark.parametrize("unit", [1000.0, 1e-3])
def test_relative_scores_do_not_know_the_unit(unit: float) -> None:
    prediction, truth = animal(1500, 1) @ yaw(20).T, animal(1500, 0)
    plain = compare(prediction, truth, up=UP).scores
    scaled = compare(unit * prediction, unit * truth, up=UP).scores
    mixed = compare(unit * prediction, truth, up=UP).scores
    for name in ("chamfer_relative", "fscore_1", "fscore_2", "fscore_5"):
        assert scaled[name].value == pytest.approx(mixed[name].value, rel=1e-12)
        assert mixed[name].value == pytest.approx(plain[name].value, rel=1e-6)
    assert scaled["chamfer"].value == pytest.approx(unit * plain["chamfer"].value, rel=1e-6)
    assert mixed["chamfer"].value == pytest.approx(plain["chamfer"].value, rel=1e-6)


def test_distances_equal_scipy_and_scikit_learn() -> None:
    prediction, truth = animal(700, 1) + 0.03, animal(500, 0)
    table = cdist(prediction.numpy(), truth.numpy())
    found = distances(prediction, truth)
    np.testing.assert_allclose(found.to_truth, table.min(1), atol=1e-9)
    np.testing.assert_allclose(found.to_prediction, table.min(0), atol=1e-9)
    pairs = ((prediction.numpy(), truth.numpy()), (truth.numpy(), prediction.numpy()))
    oracle = [NearestNeighbors(n_neighbors=1).fit(there).kneighbors(here)[0] for here, there in pairs]
    assert chamfer(prediction, truth).to_truth == pytest.approx(np.mean(oracle[0]), abs=1e-6)
    assert chamfer(prediction, truth).to_prediction == pytest.approx(np.mean(oracle[1]), abs=1e-6)
    precision, recall = np.mean(table.min(1) < 0.05), np.mean(table.min(0) < 0.05)
    assert fscore(prediction, truth, 0.05) == pytest.approx(2 * precision * recall / (precision + recall))


def test_distances_equal_open3d() -> None:
    o3d = pytest.importorskip("open3d")
    prediction, truth = animal(700, 1) + 0.03, animal(500, 0)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.numpy())) for points in (prediction, truth)]
    oracle = clouds[0].compute_point_cloud_distance(clouds[1]), clouds[1].compute_point_cloud_distance(clouds[0])
    assert chamfer(prediction, truth).to_truth == pytest.approx(np.mean(oracle[0]), abs=1e-6)
    assert chamfer(prediction, truth).to_prediction == pytest.approx(np.mean(oracle[1]), abs=1e-6)


def test_a_perfect_shape_scores_its_floor() -> None:
    """The floor is what another sampling of the truth gets; a prediction that is one gets the same within 5 %."""
    truth, second = animal(3000, 0), animal(3000, 2)
    found = compare(animal(3000, 1), truth, up=UP, second=second)
    for name in ("chamfer", "chamfer_relative", "chamfer_to_truth"):
        assert found.scores[name].value == pytest.approx(found.scores[name].floor, rel=0.05)
    assert found.scores["fscore_1"].value == pytest.approx(found.scores["fscore_1"].floor, abs=0.03)
    assert "independent sampling of the truth with 3000 points" in found.note
    direct = distances(second, truth).chamfer.symmetric
    assert found.scores["chamfer"].floor == pytest.approx(direct)


def test_the_floor_falls_with_the_number_of_points() -> None:
    """In a surface, nearest neighbours are nearer by the square root of the density."""
    floors = [compare(animal(n, 1), animal(n, 0), fit="none").scores["chamfer_unaligned"].floor for n in (1000, 4000)]
    assert floors[0] is not None and floors[1] is not None
    assert floors[0] / floors[1] == pytest.approx(4**0.5, rel=0.1)


def test_a_mirrored_animal_does_not_score_well() -> None:
    truth, second = animal(6000, 0), animal(6000, 2)
    mirrored = compare(animal(6000, 1) * torch.tensor((-1.0, 1.0, 1.0)), truth, second=second).scores
    assert mirrored["fscore_1"].floor > 0.95 and mirrored["fscore_1"].value < 0.6
    assert mirrored["chamfer_relative"].value > 3 * mirrored["chamfer_relative"].floor


def test_a_missing_leg_and_floaters_cost_what_they_should() -> None:
    truth = animal(3000, 0)
    whole, cut = (compare(animal(3000, 1, without=leg), truth, up=UP).scores for leg in (None, "front left"))
    assert cut["chamfer_to_prediction"].value > 1.5 * whole["chamfer_to_prediction"].value  # the leg is not there
    assert cut["chamfer_to_truth"].value < 1.1 * whole["chamfer_to_truth"].value  # what is there is right
    dirty = torch.cat((animal(2850, 1), floaters(150, 50.0, 0) + 100.0))
    found = compare(dirty, truth, up=UP).scores
    assert found["fscore_5"].value == pytest.approx(2 * 0.95 * 1 / (0.95 + 1), abs=0.005)
    assert found["chamfer_to_prediction"].value < 1.15 * whole["chamfer_to_prediction"].value


def test_per_frame_alignment_hides_drift_and_has_its_own_name() -> None:
    truths = [animal(1500, step) for step in range(4)]
    drift = [0.1 * step * torch.tensor((0.0, 0.0, 1.0)) for step in range(4)]
    predictions = [animal(1500, 10 + step) + drift[step] for step in range(4)]
    headline = compare_sequence(predictions, truths, up=UP)
    seconds = [animal(1500, 20 + step) for step in range(4)]
    framewise = compare_sequence(predictions, truths, up=UP, fit="frame", seconds=seconds)
    assert len(headline.alignments) == 1 and len(framewise.alignments) == 4
    assert list(framewise.scores) == [name + "_framewise" for name in headline.scores]
    one, other = headline.scores["chamfer"], framewise.scores["chamfer_framewise"]
    assert other.value == pytest.approx(other.floor, rel=0.05) and one.value > 1.2 * other.value
    assert one.value == math.fsum(one.per_item) / 4


def test_a_sequence_is_the_mean_of_its_moments() -> None:
    shift = torch.tensor((1.0, 0, 0), dtype=torch.float64)
    truths = [grid(6), grid(6) + 40 * shift]
    found = compare_sequence([truths[0], truths[1] + 0.2 * shift], truths, fit="none").scores["chamfer_unaligned"]
    assert found.per_item == pytest.approx((0.0, 0.2)) and found.value == pytest.approx((0 + 0.2) / 2)


@pytest.mark.parametrize("cloud", [torch.zeros(1, 3), torch.arange(9.0)[:, None] * torch.ones(1, 3)])
def test_what_cannot_be_aligned_is_not_computed_but_can_be_compared(cloud: Tensor) -> None:
    found = compare(cloud, animal(200, 0)).scores
    assert {score.value for score in found.values()} == {None}
    reason = "not computed: the prediction's points lie on one line, so no rotation is unique"
    assert {score.note for score in found.values()} == {reason}
    assert compare(cloud, animal(200, 0), fit="none").scores["chamfer_unaligned"].value > 0


def test_a_truth_of_one_point_has_no_diagonal() -> None:
    found = compare(torch.zeros(1, 3), torch.ones(1, 3), fit="none")
    assert found.scores["chamfer_unaligned"].value == pytest.approx(3**0.5)
    for name in ("chamfer_relative_unaligned", "fscore_1_unaligned"):
        assert found.scores[name].value is None
        assert found.scores[name].note == "not computed: the truth's diagonal is zero"
    assert found.scores["chamfer_unaligned"].floor is None and "the truth has one point" in found.note


def test_an_empty_prediction_recalls_nothing() -> None:
    found = compare_sequence([torch.zeros(0, 3)] * 2, [animal(100, 0)] * 2).scores
    assert found["fscore_5"].value == 0 and found["chamfer"].value is None
    assert found["chamfer"].note == "not computed: the prediction has no points"
    half = compare_sequence([torch.zeros(0, 3), animal(500, 1)], [animal(500, 0)] * 2, up=UP).scores
    first, second = half["chamfer"].per_item
    assert first is None and second > 0 and half["chamfer"].value is None, "the moment that is there is not the mean"
    assert half["chamfer"].note == "not computed: the prediction has no points at 1 of 2 moments"
    assert half["fscore_5"].value == pytest.approx((0 + 1) / 2)
    line = torch.linspace(0, 1, 9)[:, None] * torch.ones(1, 3)
    framewise = compare_sequence([line, animal(500, 1)], [animal(500, 0)] * 2, fit="frame", up=UP).scores
    reason = "the prediction's points lie on one line, so no rotation is unique at 1 of 2 moments"
    assert {score.value for score in framewise.values()} == {None}
    assert {score.note for score in framewise.values()} == {f"not computed: {reason}"}


def test_bad_clouds_are_named() -> None:
    good, broken = animal(50, 0), animal(50, 0).index_fill(0, torch.tensor(7), math.inf)
    with pytest.raises(ValueError, match="finite points in the prediction, got 1 of 50 with a NaN or an infinity"):
        compare(broken, good)
    with pytest.raises(ValueError, match=r"coordinates up to 1e\+100 in the prediction, got [0-9.]+e\+200"):
        compare(good.double() * 1e200, good)
    for diagonal in (math.inf, math.nan, -1.0):
        with pytest.raises(ValueError, match="a finite diagonal that is not negative"):
            compare(good, good, diagonal=diagonal)
    with pytest.raises(ValueError, match="finite points in the truth, got 1 of 50"):
        chamfer(good, broken)
    with pytest.raises(ValueError, match="at least one point in the truth, got none"):
        fscore(good, torch.zeros(0, 3), 0.1)
    with pytest.raises(ValueError, match="at least one point in the prediction, got none"):
        chamfer(torch.zeros(0, 3), good)
    with pytest.raises(ValueError, match=r"the prediction as points \[n, 3\], got \(3,\)"):
        compare(torch.zeros(3), good)
    with pytest.raises(ValueError, match="one prediction a truth, got 2 and 1 clouds"):
        compare_sequence([good, good], [good])


def test_a_million_points_are_drawn_from_and_said_so() -> None:
    prediction, truth = animal(1_000_000, 1), animal(40_000, 0)
    begin = time.process_time()
    found = compare(prediction, truth, up=UP)
    assert time.process_time() - begin < 20
    assert f"prediction of 1000000 points, {POINTS} of them drawn with seed 0" in found.note
    assert f"truth of 40000 points, {POINTS} of them drawn" in found.note
    assert found.scores["fscore_1"].value > 0.99


def test_a_million_equal_points_are_compared_at_once() -> None:
    begin = time.process_time()
    found = chamfer(torch.ones(1_000_000, 3), torch.zeros(1000, 3))
    assert found.to_truth == found.to_prediction == pytest.approx(3**0.5)
    assert time.process_time() - begin < 5


def square() -> tuple[Tensor, Tensor]:
    """A unit square of two triangles and a triangle of twice its area far away."""
    vertices = torch.tensor(((0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (10, 0, 0), (12, 0, 0), (10, 2, 0)))
    return vertices, torch.tensor(((0, 1, 2), (0, 2, 3), (4, 5, 6)))


def test_meshes_are_sampled_by_area() -> None:
    points = sample_mesh(*square(), 30_000, 0)
    near = points[points[:, 0] <= 1]
    assert len(near) / 30_000 == pytest.approx(1 / (1 + 2), abs=0.01)
    torch.testing.assert_close(near.mean(0), torch.tensor((0.5, 0.5, 0.0)).double(), atol=0.01, rtol=0)
    torch.testing.assert_close(near.var(0)[:2], torch.full((2,), 1 / 12).double(), atol=0.002, rtol=0)
    assert points[:, :2].min() >= 0 and not points[:, 2].any()
    assert torch.equal(points, sample_mesh(*square(), 30_000, 0))
    assert not torch.equal(points, sample_mesh(*square(), 30_000, 1))
    with pytest.raises(ValueError, match="triangles with an area, got 1 triangles without"):
        sample_mesh(torch.zeros(3, 3), torch.tensor(((0, 1, 2),)), 5, 0)


def test_a_gaussian_counts_with_its_centre_if_it_is_opaque_enough() -> None:
    generator = torch.Generator().manual_seed(0)
    splats = Splats(
        means=torch.rand(1000, 3, generator=generator),
        quats=torch.tensor(((1.0, 0, 0, 0),)).expand(1000, 4),
        scales=torch.ones(1000, 3),
        opacities=torch.arange(1000) / 1000,
        colors=torch.zeros(1000, 1, 3),
    )
    assert torch.equal(sample_gaussians(splats, 1000, 0, opacity=0.5), splats.means[500:].double())
    drawn = sample_gaussians(splats, 100, 0, opacity=0.5)
    known = {tuple(row) for row in splats.means[500:].double().tolist()}
    assert len({tuple(row) for row in drawn.tolist()} & known) == 100
    assert torch.equal(drawn, sample_gaussians(splats, 100, 0, opacity=0.5))
    assert len(sample_gaussians(splats, 100, 0, opacity=1.1)) == 0
