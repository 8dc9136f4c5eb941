"""Similarities: the closed form against other packages, the iterated one on animals that are turned, cut or dirty."""

import math
import time

import numpy as np
import pytest
import torch
import trimesh
from animals import UP, animal, floaters, yaw
from scipy.spatial.transform import Rotation
from skimage.transform import estimate_transform
from torch import Tensor

from rewild4d.metrics.alignment import (
    Alignment,
    Similarity,
    Undetermined,
    align,
    align_scale,
    align_sequence,
    cube_starts,
    umeyama,
    yaw_starts,
)

EXACT = {"atol": 1e-9, "rtol": 0}


def cloud(count: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(count, 3)))


def known(seed: int = 0) -> Similarity:
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    return Similarity(1.7, turn, torch.tensor((3.0, -1.0, 0.5), dtype=torch.float64))


def inverse(similarity: Similarity) -> Similarity:
    back = similarity.rotation.T
    return Similarity(1 / similarity.scale, back, -back @ similarity.translation / similarity.scale)


def turned_by(found: Alignment, expected: Tensor) -> float:
    """Degrees between the rotation that was found and another."""
    cosine = (float(torch.trace(found.rotation @ expected.T)) - 1) / 2
    return math.degrees(math.acos(min(1.0, cosine)))


def test_umeyama_recovers_a_similarity_exactly() -> None:
    source = cloud(20)
    found = umeyama(source, known().apply(source))
    torch.testing.assert_close(found.matrix, known().matrix, **EXACT)


def test_apply_and_matrix_are_the_same_map() -> None:
    points = cloud(5)
    homogeneous = torch.cat((points, torch.ones(5, 1)), dim=1) @ known().matrix.T
    torch.testing.assert_close(known().apply(points), homogeneous[:, :3], **EXACT)
    assert known().apply(points.float()).dtype == torch.float32


def noisy_matches() -> tuple[Tensor, Tensor]:
    source = cloud(50)
    return source, known().apply(source) + 0.3 * cloud(50, 1)


def test_umeyama_equals_scikit_image_on_noisy_matches() -> None:
    source, target = noisy_matches()
    oracle = estimate_transform("similarity", source.numpy(), target.numpy())
    np.testing.assert_allclose(umeyama(source, target).matrix.numpy(), oracle.params, atol=1e-9)


def test_umeyama_equals_open3d_on_noisy_matches() -> None:
    o3d = pytest.importorskip("open3d")
    source, target = noisy_matches()
    estimator = o3d.pipelines.registration.TransformationEstimationPointToPoint(with_scaling=True)
    rows = o3d.utility.Vector2iVector(np.repeat(np.arange(50), 2).reshape(-1, 2))
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.numpy())) for points in (source, target)]
    oracle = estimator.compute_transformation(*clouds, rows)
    np.testing.assert_allclose(umeyama(source, target).matrix.numpy(), oracle, atol=1e-6)


def test_weighted_rotation_equals_scipy() -> None:
    source, weights = cloud(30), torch.rand(30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    target = known().apply(source) + 0.5 * cloud(30, 1)
    share = weights / weights.sum()
    oracle, _ = Rotation.align_vectors((target - share @ target).numpy(), (source - share @ source).numpy(), weights)
    torch.testing.assert_close(umeyama(source, target, weights).rotation, torch.from_numpy(oracle.as_matrix()), **EXACT)


def test_a_weight_of_two_is_a_point_listed_twice() -> None:
    source = cloud(6)
    target = known().apply(source) + cloud(6, 1)
    weights = torch.tensor((1.0, 2.0, 1.0, 1.0, 0.0, 1.0))
    rows = torch.tensor((0, 1, 1, 2, 3, 5))
    found = umeyama(source, target, weights)
    torch.testing.assert_close(found.matrix, umeyama(source[rows], target[rows]).matrix, **EXACT)


def test_a_reflection_is_never_fitted() -> None:
    source = cloud(40)
    found = umeyama(source, source * torch.tensor((-1.0, 1.0, 1.0)))
    assert float(torch.linalg.det(found.rotation)) == pytest.approx(1.0)
    assert float((found.apply(source) - source * torch.tensor((-1.0, 1.0, 1.0))).norm(dim=1).mean()) > 0.5


def test_a_plane_is_enough() -> None:
    source = cloud(10) * torch.tensor((1.0, 1.0, 0.0))
    torch.testing.assert_close(umeyama(source, known().apply(source)).matrix, known().matrix, **EXACT)


LINE = torch.arange(5.0)[:, None] * torch.tensor((1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    ("source", "target", "text"),
    [
        (torch.zeros(1, 3), torch.zeros(1, 3), "the source's points lie on one line, so no rotation is unique"),
        (LINE, cloud(5), "the source's points lie on one line, so no rotation is unique"),
        (cloud(5), LINE + 1e6, "the target's points lie on one line, so no rotation is unique"),
        (cloud(4), torch.zeros(4, 3), "the target's points lie on one line, so no rotation is unique"),
        (
            torch.tensor(((1.0, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))),
            torch.tensor(((0, 0, 1.0), (0, 0, -1), (1, 0, 0), (1, 0, 0))),
            "vary together along one line only",
        ),
    ],
)
def test_what_leaves_the_rotation_open_says_so(source: Tensor, target: Tensor, text: str) -> None:
    with pytest.raises(Undetermined, match=text):
        umeyama(source, target)


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"expected the source as points \[n, 3\], got \(4, 2\)"):
        umeyama(torch.zeros(4, 2), cloud(4))
    with pytest.raises(ValueError, match=r"as many target as source points, got \(5, 3\) and \(4, 3\)"):
        umeyama(cloud(4), cloud(5))
    with pytest.raises(ValueError, match="expected finite points in the target, got 1 of 4 with a NaN or an infinity"):
        umeyama(cloud(4), cloud(4).index_fill(0, torch.tensor(2), math.nan))
    with pytest.raises(ValueError, match="expected 4 weights of at least zero and one above it"):
        umeyama(cloud(4), cloud(4), torch.zeros(4))
    with pytest.raises(ValueError, match="got a reflection"):
        align(cloud(9), cloud(9), starts={"mirror": torch.diag(torch.tensor((-1.0, 1.0, 1.0)))})
    with pytest.raises(ValueError, match="at least one start, got none"):
        align(cloud(9), cloud(9), starts={})
    with pytest.raises(ValueError, match=r"a trim in \[0, 1\) and a clamp around 1, got 1 and \(0.5, 2.0\)"):
        align(cloud(9), cloud(9), trim=1)
    with pytest.raises(ValueError, match="one prediction a truth, got 1 and 2 clouds"):
        align_sequence([cloud(9)], [cloud(9)] * 2)
    with pytest.raises(Undetermined, match="no moment at which both"):
        align_sequence([cloud(9), cloud(0)], [cloud(0), cloud(9)])
    with pytest.raises(Undetermined, match="the source's points lie on one line"):
        align(LINE, cloud(9))


def test_starts_are_distinct_rotations() -> None:
    turns = list(cube_starts().values())
    assert len(turns) == 24 and len({tuple(turn.flatten().tolist()) for turn in turns}) == 24
    assert all(float(torch.linalg.det(turn)) == 1 for turn in turns)
    assert list(yaw_starts(3 * UP)) == ["yaw 0", "yaw 90", "yaw 180", "yaw 270"]
    torch.testing.assert_close(yaw_starts(3 * UP)["yaw 90"], yaw(90), **EXACT)
    with pytest.raises(ValueError, match="an up direction"):
        yaw_starts(torch.zeros(3))


def clean_match() -> tuple[Tensor, Tensor, Similarity]:
    """Points, their places, and the similarity from one to the other; the points are not listed in one order."""
    target = animal(800, 0)
    truth = Similarity(1.1, yaw(12), torch.tensor((0.1, 0.05, -0.1), dtype=torch.float64))
    source = inverse(truth).apply(target)[torch.randperm(800, generator=torch.Generator().manual_seed(1))]
    return source, target, truth


def test_points_without_noise_end_at_the_truth_as_trimesh_does() -> None:
    source, target, truth = clean_match()
    found = align(source, target, up=UP)
    torch.testing.assert_close(found.matrix, truth.matrix, atol=1e-6, rtol=0)
    assert found.converged and not found.clamped and found.chamfer < 1e-6
    matrix = found.matrix.numpy()
    oracle, _, _ = trimesh.registration.icp(source.numpy(), target.numpy(), initial=matrix, reflection=False)
    np.testing.assert_allclose(matrix, oracle, atol=1e-6)


def test_points_without_noise_end_at_the_truth_as_open3d_does() -> None:
    o3d = pytest.importorskip("open3d")
    source, target, _ = clean_match()
    found = align(source, target, up=UP)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.numpy())) for points in (source, target)]
    oracle = o3d.pipelines.registration.registration_icp(
        *clouds,
        10.0,
        found.matrix.numpy(),
        o3d.pipelines.registration.TransformationEstimationPointToPoint(with_scaling=True),
    )
    np.testing.assert_allclose(found.matrix.numpy(), oracle.transformation, atol=1e-6)


@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 180, 270])
@pytest.mark.parametrize("cut", [None, "front left"])
def test_a_turned_animal_is_found_again(degrees: int, cut: str | None) -> None:
    source = 0.3 * animal(3000, 1, without=cut) @ yaw(degrees).T + torch.tensor((5.0, 1.0, -2.0))
    found = align(source, animal(3000, 0), up=UP)
    assert turned_by(found, yaw(-degrees)) < 1
    assert found.scale == pytest.approx(1 / 0.3, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_without_a_shared_axis_any_turn_is_found(seed: int) -> None:
    turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    found = align(animal(3000, 1) @ turn.T, animal(3000, 0))
    assert turned_by(found, turn.T) < 1 and found.start.startswith("cube")
    assert found.scale == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("side", [5.0, 50.0, 5000.0])
@pytest.mark.parametrize("cut", [None, "front left"])
def test_floaters_do_not_move_the_scale(side: float, cut: str | None) -> None:
    source = torch.cat((animal(2850, 1, without=cut), floaters(150, side, 2))) @ yaw(180).T
    found = align(source, animal(3000, 0), up=UP)
    assert turned_by(found, yaw(180)) < 1.5
    assert found.scale == pytest.approx(1.0, rel=0.02)


def test_ten_thousand_points_take_less_than_three_seconds_from_all_starts() -> None:
    source, target = animal(10_000, 1) @ yaw(90).T, animal(10_000, 0)
    begin = time.process_time()
    found = align(source, target)
    assert time.process_time() - begin < 3
    assert turned_by(found, yaw(-90)) < 0.5 and found.scale == pytest.approx(1, rel=0.003)


def test_a_mirrored_animal_does_not_score_well() -> None:
    target = animal(3000, 0)
    good = align(animal(3000, 1), target).chamfer
    mirrored = align(animal(3000, 1) * torch.tensor((-1.0, 1.0, 1.0)), target)
    assert mirrored.chamfer > 2.5 * good
    assert float(torch.linalg.det(mirrored.rotation)) == pytest.approx(1.0)


def test_the_clamp_is_kept_and_told() -> None:
    target = animal(2000, 0)
    free = align(0.5 * target, target, up=UP)
    assert free.scale == pytest.approx(2.0) and not free.clamped
    # More than half of the points in one spot: the median radius is far too small, the start far too large.
    crowded = torch.cat((target, 0.05 * animal(2400, 1)))
    bound = align(crowded, target, up=UP, scale_clamp=(1.0, 1.0), even=False).scale / 2
    found = align(crowded, target, up=UP, even=False)
    assert found.clamped and found.scale == pytest.approx(bound) and bound > 1
    assert align(crowded, target, up=UP).scale == pytest.approx(1.0)


def test_the_same_call_gives_the_same_bits() -> None:
    one, other = (align(animal(5000, 1), animal(5000, 0), up=UP, seed=3) for _ in range(2))
    assert torch.equal(one.matrix, other.matrix) and one.iterations == other.iterations


def walk(count: int, seed: int) -> list[Tensor]:
    """An animal that swings a leg and walks three body lengths."""
    moments = []
    for step in range(6):
        moved = torch.tensor((0.0, 0.0, 3.0 * step), dtype=torch.float64)
        moments.append(animal(count, 10 * seed + step, swing=0.2 * step) + moved)
    return moments


def test_a_sequence_has_one_similarity() -> None:
    truths = walk(1500, 0)
    predictions = [inverse(known()).apply(points) for points in walk(1500, 1)]
    found = align_sequence(predictions, truths)
    assert turned_by(found, known().rotation) < 0.5
    assert found.scale == pytest.approx(1.7, rel=0.01)
    torch.testing.assert_close(found.translation, known().translation, atol=0.1, rtol=0)


def test_matches_stay_within_one_moment() -> None:
    """Backwards in time the walk covers the same ground, so that matches between moments would find no fault."""
    truths = walk(1500, 0)
    identity = {"none": torch.eye(3)}
    right, wrong = (align_sequence(order, truths, starts=identity) for order in (walk(1500, 1), walk(1500, 1)[::-1]))
    assert wrong.chamfer > 3 * right.chamfer


def test_an_animal_that_walks_in_place_keeps_its_size() -> None:
    """The walked way is no part of the size, so the start is sound although one side stands still."""
    still = [points - torch.tensor((0.0, 0.0, 3.0 * step)) for step, points in enumerate(walk(1500, 1))]
    slow = [points + torch.tensor((0.0, 0.0, 0.1 * step)) for step, points in enumerate(still)]
    found = align_sequence(slow, still, up=UP)
    assert found.scale == pytest.approx(1.0, rel=0.02)


def front(points: Tensor, share: float = 0.1) -> Tensor:
    """The part of an animal that is nearest to its head."""
    return points[points[:, 2] > points[:, 2].quantile(1 - share)]


def test_points_listed_again_change_nothing() -> None:
    target = animal(2000, 0)
    crowded = torch.cat([target] + [front(target, 0.5)] * 10)
    for source, truth in ((crowded, target), (target, crowded)):
        found = align(source, truth, up=UP)
        assert found.scale == pytest.approx(1.0, abs=1e-6) and found.chamfer < 1e-6


@pytest.mark.parametrize("degrees", [0, 90])
def test_a_denser_head_neither_turns_nor_scales_the_animal(degrees: int) -> None:
    """Six times as many points on the head as on the rest: matched alike, they gave scale 1.23 and a quarter turn."""
    source = torch.cat((animal(2000, 1), front(animal(100_000, 3)))) @ yaw(degrees).T
    found = align(source, animal(3000, 0), up=UP)
    assert turned_by(found, yaw(-degrees)) < 1
    assert found.scale == pytest.approx(1.0, rel=0.01)
    uneven = align(source, animal(3000, 0), up=UP, even=False)
    assert uneven.scale > 1.15


def test_a_scale_that_is_given_is_kept() -> None:
    found = align(0.5 * animal(2000, 1) @ yaw(20).T, animal(2000, 0), up=UP, scale=2.0)
    assert found.scale == 2.0 and not found.clamped and turned_by(found, yaw(-20)) < 1
    with pytest.raises(ValueError, match="expected a finite scale above zero, got -1"):
        align(cloud(9), cloud(9), scale=-1)


CAMERA = torch.tensor((1.0, 2.0, 12.0), dtype=torch.float64)


@pytest.mark.parametrize("scale", [0.55, 1.0, 1.7])
def test_a_scale_about_a_camera_is_found(scale: float) -> None:
    truths = [animal(2000, step, swing=0.1 * step) for step in range(3)]
    sources = [CAMERA + (animal(2000, 7 + step, swing=0.1 * step) - CAMERA) / scale for step in range(3)]
    found = align_scale(sources, truths, CAMERA)
    assert found.scale == pytest.approx(scale, rel=0.003) and not found.clamped
    torch.testing.assert_close(found.rotation, torch.eye(3, dtype=torch.float64), **EXACT)
    torch.testing.assert_close(found.apply(CAMERA[None])[0], CAMERA, **EXACT)


def test_a_scale_about_a_camera_does_not_enlarge_points_below_the_skin() -> None:
    """Centres of Gaussians lie inside; a similarity enlarges them, the scale about a camera moves them in depth."""
    target = animal(3000, 0)
    inner = 0.93 * animal(3000, 1)
    assert align(inner, target, up=UP).scale == pytest.approx(1 / 0.93, rel=0.02)
    assert align_scale([inner], [target], CAMERA).scale == pytest.approx(1.0, abs=0.02)


def test_a_scale_that_is_open_says_so() -> None:
    with pytest.raises(Undetermined, match="half of the points lie at the centre"):
        align_scale([torch.zeros(9, 3)], [cloud(9)], torch.zeros(3))
    with pytest.raises(Undetermined, match="no moment at which both"):
        align_scale([cloud(0)], [cloud(9)], torch.zeros(3))
