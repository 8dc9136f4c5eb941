"""Distances of distributions: exact moments, brute force, SciPy's matrix root, and the traps that were measured."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch
from extractors import LinearNetwork

from rewild4d.metrics import distribution
from rewild4d.metrics.distribution import (
    fid,
    frechet_distance,
    kid,
    kid_subsets,
    kid_v,
    mmd2_interval,
    mmd2_u_statistic,
    mmd2_unbiased,
)
from rewild4d.metrics.samples import Conditions, Features, image_features


def normal(n: int, d: int, seed: int) -> torch.Tensor:
    return torch.randn(n, d, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def whitened(n: int, d: int, seed: int) -> torch.Tensor:
    """A sample whose mean is exactly 0 and whose covariance is exactly I."""
    centred = normal(n, d, seed) - normal(n, d, seed).mean(0)
    return centred @ torch.linalg.inv(torch.linalg.cholesky(centred.T @ centred / (n - 1))).T


def features(values: torch.Tensor, groups: list[int] | None = None) -> Features:
    ids = torch.tensor(groups if groups else [0] * len(values))
    return Features(values, ids, "linear", "0" * 64, "area 4x4")


def brute_force(x: np.ndarray, y: np.ndarray, paired: bool) -> float:
    """MMD^2, one pair of rows at a time."""

    def mean(a: np.ndarray, b: np.ndarray, hollow: bool) -> float:
        values = [
            (float(sum(p * q for p, q in zip(a[i], b[j], strict=True))) / a.shape[1] + 1) ** 3
            for i in range(len(a)) for j in range(len(b)) if not (hollow and i == j)
        ]  # fmt: skip
        return sum(values) / len(values)

    return mean(x, x, True) + mean(y, y, True) - 2 * mean(x, y, paired)


def test_kernel_distance_equals_brute_force() -> None:
    x, y = normal(7, 5, 0), normal(7, 5, 1) + 0.3
    assert mmd2_unbiased(x, y[:6]) == pytest.approx(brute_force(x.numpy(), y[:6].numpy(), False), abs=1e-12)
    assert mmd2_u_statistic(x, y) == pytest.approx(brute_force(x.numpy(), y.numpy(), True), abs=1e-12)


def test_kernel_distance_by_hand() -> None:
    """Two points at 0 and two at 1, D = 1: k(0,0) = 1, k(1,1) = 8, k(0,1) = 1."""
    x, y = torch.zeros(2, 1), torch.ones(2, 1)
    assert mmd2_unbiased(x, y) == mmd2_u_statistic(x, y) == 1 + 8 - 2 * 1


def test_chunks_do_not_change_the_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = normal(23, 6, 0), normal(23, 6, 1)
    whole = mmd2_unbiased(x, y), mmd2_u_statistic(x, y)
    monkeypatch.setattr(distribution, "_ROWS", 4)
    assert (mmd2_unbiased(x, y), mmd2_u_statistic(x, y)) == pytest.approx(whole, abs=1e-12)


def test_two_halves_of_one_sample_are_near_zero() -> None:
    sample = normal(2000, 16, 0)
    halves = mmd2_unbiased(sample[::2], sample[1::2])
    moved = mmd2_unbiased(sample[::2], sample[1::2] + 0.5)
    assert abs(halves) < 0.01 < 0.3 < moved


def test_unbiased_means_zero_on_average_and_sometimes_below() -> None:
    values = [mmd2_unbiased(normal(8, 4, seed), normal(8, 4, 1000 + seed)) for seed in range(400)]
    assert abs(np.mean(values)) < 4 * np.std(values) / math.sqrt(len(values))
    assert min(values) < 0 < max(values)


def test_the_paired_trap() -> None:
    """A perfect prediction: the unbiased estimate keeps k(x_i, x_i) and is negative, the U-statistic is exactly 0."""
    x = normal(48, 64, 0).abs()
    assert mmd2_u_statistic(x, x.clone()) == 0.0
    diagonal = ((x * x).sum(1) / 64 + 1) ** 3
    kernel = (x @ x.T / 64 + 1) ** 3
    away = (kernel.sum() - diagonal.sum()) / (48 * 47)
    assert mmd2_unbiased(x, x.clone()) == pytest.approx(float(2 * away - 2 * kernel.mean()), abs=1e-10)
    assert mmd2_unbiased(x, x.clone()) < 0
    assert mmd2_u_statistic(x.float(), x.float()) == 0.0


def test_shift_of_a_gaussian_is_its_square() -> None:
    """N(0, I) against N(m, I) is |m|^2, exactly so on samples with exact moments."""
    shift = torch.tensor((1.0, -2.0, 0.5, 0.0, 3.0), dtype=torch.float64)
    found = frechet_distance(whitened(40, 5, 0), whitened(60, 5, 1) + shift)
    assert found == pytest.approx(1.0**2 + 2.0**2 + 0.5**2 + 3.0**2, abs=1e-10)


def test_scale_of_a_gaussian() -> None:
    """N(0, I) against N(0, s^2 I) is d (s - 1)^2."""
    assert frechet_distance(whitened(40, 5, 0), 3 * whitened(60, 5, 1)) == pytest.approx(5 * (3 - 1) ** 2, abs=1e-9)


@pytest.mark.parametrize(("n", "m", "d"), [(50, 40, 6), (40, 50, 6), (30, 30, 25)])
def test_low_rank_form_equals_the_matrix_root(n: int, m: int, d: int) -> None:
    x, y = normal(n, d, 0) @ normal(d, d, 2), normal(m, d, 1) @ normal(d, d, 3) + 0.5
    a, b = np.cov(x.numpy(), rowvar=False), np.cov(y.numpy(), rowvar=False)
    root = scipy.linalg.sqrtm(a @ b)
    oracle = float((x.mean(0) - y.mean(0)).square().sum()) + np.trace(a + b - 2 * np.real(root))
    assert frechet_distance(x, y) == pytest.approx(oracle, rel=1e-7)


def test_low_rank_form_with_fewer_samples_than_features() -> None:
    """S_x S_y has the eigenvalues of the small (A B^T)(A B^T)^T, so its root has the sum of their roots as trace."""
    x, y = normal(8, 60, 0), normal(11, 60, 1)
    a, b = ((rows - rows.mean(0)) / math.sqrt(len(rows) - 1) for rows in (x, y))
    eigenvalues = np.linalg.eigvals((a.T @ a @ b.T @ b).numpy()).real.clip(0)
    oracle = float((x.mean(0) - y.mean(0)).square().sum() + a.square().sum() + b.square().sum())
    assert frechet_distance(x, y) == pytest.approx(oracle - 2 * np.sqrt(eigenvalues).sum(), rel=1e-5)
    assert frechet_distance(x, x) == pytest.approx(0, abs=1e-10)


def test_interval_equals_a_resample_by_hand() -> None:
    """Sequence 0 drawn twice, 2 once: rows meet by the product of draws, in their own sequence once a draw."""
    groups = torch.tensor([0, 0, 1, 1, 1, 2, 2])
    x, y = normal(7, 5, 0), normal(7, 5, 1) + 0.3
    drawn = torch.tensor([2.0, 0, 1]).double()
    sums = distribution._kernel_sums(x, y, groups, groups, paired=True)
    ours = float(distribution._mmd2(sums, drawn[None], drawn[None], joint=True))

    def mean(a: torch.Tensor, b: torch.Tensor) -> float:
        total = count = 0.0
        for i in range(7):
            for j in range(7):
                same = groups[i] == groups[j]
                weight = 0.0 if i == j else float(drawn[groups[i]] * (1 if same else drawn[groups[j]]))
                total += weight * (float(a[i] @ b[j]) / 5 + 1) ** 3
                count += weight
        return total / count

    assert ours == pytest.approx(mean(x, x) + mean(y, y) - 2 * mean(x, y), abs=1e-12)


def test_interval_over_sequences_is_wider_than_over_images() -> None:
    """Images of one sequence are alike: ten sequences of ten copies hold ten facts, not a hundred."""
    x, y = (normal(10, 8, seed).repeat_interleave(10, 0) + 0.01 * normal(100, 8, 9 + seed) for seed in (0, 1))
    sequences = torch.arange(10).repeat_interleave(10)
    images = torch.arange(100)
    wide = mmd2_interval(x, y, sequences, sequences)
    narrow = mmd2_interval(x, y, images, images)
    assert wide is not None and narrow is not None
    assert wide[1] - wide[0] > 1.5 * (narrow[1] - narrow[0])
    assert mmd2_interval(x, y, sequences, sequences) == wide
    assert mmd2_interval(x, y, sequences, sequences, seed=1) != wide
    assert mmd2_interval(x, y, images % 4, images % 4) is None, "four sequences bound nothing"


@pytest.mark.parametrize("same_sequences", [True, False])
def test_interval_covers_the_truth(same_sequences: bool) -> None:
    """Equal distributions, the images of a sequence alike: 0 lies inside most intervals of 95 %."""
    sequences = torch.arange(20).repeat_interleave(3)
    inside = 0
    for seed in range(100):
        x, y = (normal(20, 4, s).repeat_interleave(3, 0) + 0.5 * normal(60, 4, s + 7000) for s in (seed, 500 + seed))
        found = mmd2_interval(x, y, sequences, sequences + (0 if same_sequences else 100), resamples=300)
        assert found is not None
        inside += found[0] <= 0 <= found[1]
    assert inside >= 80


def test_subsets_average_to_the_full_set() -> None:
    x, y = normal(60, 4, 0), normal(50, 4, 1) + 0.4
    generator = torch.Generator().manual_seed(0)
    mean, deviation = kid_subsets(x, y, subsets=200, size=20, generator=generator)
    assert abs(mean - mmd2_unbiased(x, y)) < 4 * deviation / math.sqrt(200)
    assert kid_subsets(x[:50], y, subsets=3, size=50)[1] == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="expected a size from 2 to 50, got 51"):
        kid_subsets(x, y, size=51)


def test_kid_says_what_decides_it() -> None:
    x, y = normal(70, 8, 0), normal(80, 8, 1)
    groups = sorted([*range(7)] * 10), sorted([*range(8)] * 10)
    conditions = Conditions(background="white", crop="truth box")
    found = kid(features(x, groups[0]), features(y, groups[1]), conditions=conditions)
    assert found.value == mmd2_unbiased(x, y)
    assert (found.name, found.n, found.m, found.sequences) == ("KID [linear]", 70, 80, 7)
    assert (found.background, found.crop, found.frames, found.fps) == ("white", "truth box", None, None)
    assert (found.extractor, found.digest, found.resize) == ("linear", "0" * 64, "area 4x4")
    assert found.estimator == "unbiased MMD^2, full set"
    assert found.interval is not None and found.interval[0] < found.value < found.interval[1]
    assert found.note == ""


def test_four_images_are_scored_with_a_warning_and_one_is_not() -> None:
    four = kid(features(normal(4, 8, 0)), features(normal(4, 8, 1)))
    assert four.value is not None and four.interval is None and (four.n, four.m) == (4, 4)
    assert "fewer than 64 samples a side" in four.note and "no interval" in four.note
    one = kid(features(normal(1, 8, 0)), features(normal(4, 8, 1)))
    assert one.value is None
    assert one.note == "not computed: at least 2 samples a side are needed, got 1 and 4"
    assert fid(features(normal(1, 8, 0)), features(normal(4, 8, 1))).value is None
    assert "mostly bias" in fid(features(normal(4, 8, 0)), features(normal(4, 8, 1))).note


def test_paired_kid_has_its_own_name_and_needs_pairs() -> None:
    x = features(normal(10, 8, 0), sorted([*range(5)] * 2))
    found = kid(x, x, paired=True)
    assert (found.name, found.value, found.interval) == ("KID-u [linear]", 0.0, (0.0, 0.0))
    with pytest.raises(ValueError, match="expected pairs, row by row of the same sequence, got 10 predictions and 5"):
        kid(x, features(normal(5, 8, 0), [0, 0, 0, 1, 1]), paired=True)


def test_features_of_two_networks_do_not_mix() -> None:
    other = Features(normal(4, 8, 0), torch.zeros(4, dtype=torch.int64), "linear", "1" * 64, "area 4x4")
    with pytest.raises(ValueError, match="expected features of one network"):
        kid(features(normal(4, 8, 0)), other)


def test_only_the_original_network_has_the_plain_name() -> None:
    network = LinearNetwork()
    images = torch.rand(4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    assert kid_v([images], [images], network).name == "KID-V [linear]"
    network.name = "inception-fid"
    assert kid_v([images], [images], network).name == "KID-V"
    assert kid_v([images], [images], network, paired=True).name == "KID-V-u"
    assert kid_v([images], [images], network, paired=True).value == 0.0


def test_image_features_read_any_sizes_and_report_progress() -> None:
    network = LinearNetwork()
    small, large = torch.rand(3, 3, 8, 8), torch.rand(18, 3, 16, 12)
    seen: list[tuple[int, int]] = []
    found = image_features([small, list(large)], network, lambda done, total: seen.append((done, total)))
    torch.testing.assert_close(found.values.float(), torch.cat((network(small), network(large))))
    assert found.values.dtype == torch.float64
    assert found.groups.tolist() == [0] * 3 + [1] * 18
    assert seen == [(3, 21), (19, 21), (21, 21)]


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (torch.full((3, 4, 4), 255.0), r"expected values in \[0, 1\], got 255 to 255"),
        (torch.full((3, 4, 4), math.nan), r"expected values in \[0, 1\], got nan to nan"),
        (torch.zeros(4, 4, 3), r"expected a float image of shape \[3, H, W\], got torch.float32 \(4, 4, 3\)"),
        (torch.zeros(3, 4, 4, dtype=torch.uint8), "got torch.uint8"),
    ],
)
def test_images_of_another_range_or_layout_are_refused(image: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        image_features([[image]], LinearNetwork())


def test_shapes_and_numbers_of_features_are_checked() -> None:
    with pytest.raises(ValueError, match=r"n, m of at least 2, got \(1, 3\) and \(4, 3\)"):
        mmd2_unbiased(torch.zeros(1, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match=r"got \(4, 2\) and \(4, 3\)"):
        frechet_distance(torch.zeros(4, 2), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="expected pairs, got 3 and 4 rows"):
        mmd2_u_statistic(torch.zeros(3, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="expected finite features"):
        mmd2_unbiased(torch.full((2, 3), math.nan), torch.zeros(4, 3))
