"""Compute distances between two sets of images by the features of a network: KID, KID-V, FID. Arithmetic is float64.

Two estimators of the kernel distance, never mixed, each under its own name:
  KID, KID-V      unbiased MMD^2 over the full sets (Gretton et al. 2012, eq. 3; kernel of Binkowski et al. 2018).
                  For sets that are not paired: novel views against the frames of the input video.
  KID-u, KID-V-u  the U-statistic (Gretton et al. 2012, eq. 4), which leaves k(x_i, y_i) out as well. For paired sets,
                  renders against true images from the same cameras: there the first estimator turns negative as the
                  prediction becomes perfect, and this one becomes exactly 0.
Values are not multiplied by 1000. Negative values are possible and stay: clipping would bias the mean.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from rewild4d.metrics.samples import (
    Conditions,
    Distance,
    Features,
    ImageExtractor,
    Images,
    describe,
    image_features,
    not_computed,
)

VIEWS = 16
"""Azimuths of KID-V, uniform over a full circle: 2 pi i / 16 (`rewild4d.cameras.orbit.orbit_cameras`)."""
FEW_IMAGES = 64
"""With fewer images a side, the noise of KID is as large as the effect of a visible blur."""
LEAST_SEQUENCES = 5
"""A bootstrap over fewer sequences has too few different draws for an interval."""
_ROWS = 2048


def kid(
    prediction: Features,
    truth: Features,
    *,
    paired: bool = False,
    name: str = "KID",
    conditions: Conditions = Conditions(),
    few: int = FEW_IMAGES,
    seed: int = 0,
) -> Distance:
    """Compute the kernel distance: MMD^2 over the full sets, k(a, b) = (a.b / D + 1)^3, with a bootstrap interval.

    Args:
        prediction: features of the predicted images.
        truth: features of the true images; with ``paired``, row i is the truth of row i.
        paired: compute the U-statistic; "-u" is added to the name.
        name: "KID", "KID-V", "KVD", ...
        conditions: background, crop and fps that both sets share.
        few: below this many rows a side the note warns.
        seed: of the bootstrap.

    Returns:
        The distance; its value is None with fewer than two images on a side.

    Examples:
        >>> groups = torch.zeros(2, dtype=torch.int64)
        >>> x, y = (Features(torch.full((2, 1), value).double(), groups, "toy", "", "none") for value in (0.0, 1.0))
        >>> found = kid(x, y)
        >>> found.name, found.value
        ('KID [toy]', 7.0)
    """
    if paired and not torch.equal(prediction.groups, truth.groups):
        sizes = f"{len(prediction.values)} predictions and {len(truth.values)} truths"
        raise ValueError(f"expected pairs, row by row of the same sequence, got {sizes}")
    x, y, value, interval = prediction.values, truth.values, None, None
    notes = [reason] if (reason := not_computed(prediction, truth)) else []
    if not notes:
        value = (mmd2_u_statistic if paired else mmd2_unbiased)(x, y)
        interval = mmd2_interval(x, y, prediction.groups, truth.groups, paired=paired, seed=seed)
        if min(len(x), len(y)) < few:
            notes.append(f"fewer than {few} samples a side: its noise is as large as what tells methods apart")
        if interval is None:
            notes.append(f"no interval: that needs at least {LEAST_SEQUENCES} sequences")
    return describe(
        f"{name}-u" if paired else name, value, prediction, truth, notes=notes, conditions=conditions,
        interval=interval, estimator="U-statistic, full set, paired" if paired else "unbiased MMD^2, full set",
    )  # fmt: skip


def kid_v(
    renders: Sequence[Images],
    reference: Sequence[Images],
    extractor: ImageExtractor,
    *,
    paired: bool = False,
    conditions: Conditions = Conditions(),
    seed: int = 0,
) -> Distance:
    """Compute KID-V: KID of novel views, `VIEWS` uniform azimuths around the animal at one elevation.

    Args:
        renders: one entry a sequence: the renders of all views (of one time or of several), [16 T, 3, H, W].
        reference: one entry a sequence: the frames of the input video, or with ``paired`` the true images of the same
            cameras and times in the same order (then KID-V-u), [m, 3, H, W].
        extractor: [B, 3, H, W] in [0, 1] -> [B, D].
        paired, conditions, seed: see `kid`.

    Examples:
        >>> from rewild4d.metrics.samples import MeanColor
        >>> kid_v([torch.zeros(16, 3, 4, 4)], [torch.ones(10, 3, 4, 4)], MeanColor()).value
        7.0
    """
    prediction, truth = (image_features(sets, extractor) for sets in (renders, reference))
    return kid(prediction, truth, paired=paired, name="KID-V", conditions=conditions, seed=seed)


def fid(prediction: Features, truth: Features, *, conditions: Conditions = Conditions()) -> Distance:
    """Compute the Fréchet distance of image features (Heusel et al. 2017). Biased: compare equal n and m only.

    Examples:
        >>> groups = torch.zeros(2, dtype=torch.int64)
        >>> x, y = (Features(torch.tensor([[a], [a + 2.0]]).double(), groups, "toy", "", "none") for a in (0.0, 3.0))
        >>> round(fid(x, y).value, 6)
        9.0
    """
    return frechet(prediction, truth, name="FID", conditions=conditions)


def frechet(prediction: Features, truth: Features, *, name: str, conditions: Conditions = Conditions()) -> Distance:
    """Compute `frechet_distance` of two sets with its conditions; None with fewer than two rows on a side."""
    x, y, value = prediction.values, truth.values, None
    notes = [reason] if (reason := not_computed(prediction, truth)) else []
    if not notes:
        value, width = frechet_distance(x, y), x.shape[1]
        if min(len(x), len(y)) <= width:
            notes.append(f"no more samples than the {width} features: mostly bias, compare equal n and m only")
    return describe(name, value, prediction, truth, estimator="Fréchet, N-1", notes=notes, conditions=conditions)


def mmd2_unbiased(x: Tensor, y: Tensor) -> float:
    """Compute the unbiased MMD^2 with the cubic polynomial kernel (Gretton et al. 2012, eq. 3).

    mean_{i != j} k(x_i, x_j) + mean_{i != j} k(y_i, y_j) - 2 mean_{i, j} k(x_i, y_j), k(a, b) = (a.b / D + 1)^3.

    Args:
        x: features, at least two rows, [n, D].
        y: features, at least two rows, [m, D].

    Examples:
        >>> mmd2_unbiased(torch.zeros(2, 1), torch.ones(3, 1))  # 1 + 8 - 2 * 1
        7.0
    """
    return _mmd2_of_sets(x, y, paired=False)


def mmd2_u_statistic(x: Tensor, y: Tensor) -> float:
    """Compute the U-statistic of MMD^2 for pairs (x_i, y_i) (Gretton et al. 2012, eq. 4): exactly 0 for equal sets.

    mean_{i != j} [k(x_i, x_j) + k(y_i, y_j) - k(x_i, y_j) - k(x_j, y_i)], k(a, b) = (a.b / D + 1)^3.

    Args:
        x: features, at least two rows, [n, D].
        y: features, row i belongs to row i of x, [n, D].

    Examples:
        >>> x = torch.tensor([[0.0], [1.0]])
        >>> mmd2_u_statistic(x, x), mmd2_unbiased(x, x)  # the second keeps k(x_i, x_i)
        (0.0, -3.5)
    """
    if len(x) != len(y):
        raise ValueError(f"expected pairs, got {len(x)} and {len(y)} rows")
    return _mmd2_of_sets(x, y, paired=True)


def _mmd2_of_sets(x: Tensor, y: Tensor, *, paired: bool) -> float:
    once = torch.ones(1, 1, dtype=torch.float64)
    groups = (torch.zeros(len(rows), dtype=torch.int64) for rows in (x, y))
    return float(_mmd2(_kernel_sums(x, y, *groups, paired=paired), once, once, joint=True))


def mmd2_interval(
    x: Tensor,
    y: Tensor,
    groups_x: Tensor,
    groups_y: Tensor,
    *,
    paired: bool = False,
    resamples: int = 1000,
    level: float = 0.95,
    seed: int = 0,
) -> tuple[float, float] | None:
    """Bootstrap MMD^2 over whole sequences (percentiles), since the images of one sequence are alike.

    Where both sides hold the same sequences one draw serves both; otherwise each side is drawn on its own. A sequence
    that is drawn twice counts twice, but its copies are never compared with each other.

    Args:
        x: features, [n, D].
        y: features, [m, D].
        groups_x: sequence of each row, int64, [n].
        groups_y: sequence of each row, int64, [m].
        paired: the U-statistic instead of the unbiased estimate.
        resamples: number of draws.
        level: share of the draws inside the interval.
        seed: of the draws.

    Returns:
        Lower and upper end; None with fewer than `LEAST_SEQUENCES` on a side.

    Examples:
        >>> mmd2_interval(torch.zeros(5, 1), torch.ones(5, 1), torch.arange(5), torch.arange(5))
        (7.0, 7.0)
    """
    (names_x, rows_x), (names_y, rows_y) = (ids.unique(return_inverse=True) for ids in (groups_x, groups_y))
    if min(len(names_x), len(names_y)) < LEAST_SEQUENCES:
        return None
    sums = _kernel_sums(x, y, rows_x, rows_y, paired=paired)
    generator = torch.Generator().manual_seed(seed)
    weights_x = _draws(len(names_x), resamples, generator)
    joint = torch.equal(names_x, names_y)
    weights_y = weights_x if joint else _draws(len(names_y), resamples, generator)
    values = _mmd2(sums, weights_x, weights_y, joint=joint)
    tails = torch.tensor(((1 - level) / 2, (1 + level) / 2), dtype=torch.float64)
    low, high = torch.nanquantile(values, tails).tolist()  # one image drawn alone has no pair: NaN
    return low, high


def kid_subsets(
    prediction: Tensor,
    truth: Tensor,
    *,
    subsets: int = 100,
    size: int = 1000,
    generator: torch.Generator | None = None,
) -> tuple[float, float]:
    """Compute KID as torchmetrics and torch-fidelity do, for comparison with published numbers only.

    Mean and population standard deviation of the unbiased MMD^2 over random subsets. The deviation is no error bar:
    subsets overlap, and at ``size`` == n they are all the same.

    Args:
        prediction: features, [n, D].
        truth: features, [m, D].
        subsets: number of subsets.
        size: rows of a subset, drawn without replacement from each side, the truth's first.
        generator: of the draws; torch's own where None.

    Examples:
        >>> kid_subsets(torch.zeros(4, 1), torch.ones(4, 1), subsets=3, size=2)
        (7.0, 0.0)
    """
    if not 2 <= size <= min(len(prediction), len(truth)):
        raise ValueError(f"expected a size from 2 to {min(len(prediction), len(truth))}, got {size}")
    values = []
    for _ in range(subsets):
        y, x = (rows[torch.randperm(len(rows), generator=generator)[:size]] for rows in (truth, prediction))
        values.append(mmd2_unbiased(x, y))
    found = torch.tensor(values, dtype=torch.float64)
    return float(found.mean()), float(found.std(correction=0))


def frechet_distance(x: Tensor, y: Tensor) -> float:
    """Compute the Fréchet distance of Gaussians with the sets' means and covariances over N-1 (Dowson and Landau 1982).

    |mu_x - mu_y|^2 + tr(S_x) + tr(S_y) - 2 tr (S_x S_y)^(1/2), where the last trace is the nuclear norm of A B^T over
    sqrt((n-1)(m-1)) with A, B the centred features: exact, without the matrix root of a singular product.

    Args:
        x: features, at least two rows, [n, D].
        y: features, at least two rows, [m, D].

    Examples:
        >>> round(frechet_distance(torch.tensor([[0.0], [2.0]]), torch.tensor([[3.0], [5.0]])), 6)
        9.0
    """
    _require_rows(x, y)
    a, b = (_aligned(rows) for rows in (x, y))
    shift = float((a.mean(0) - b.mean(0)).square().sum())
    a, b = ((rows - rows.mean(0)) / (len(rows) - 1) ** 0.5 for rows in (a, b))
    # |A B^T|_* is |R_a R_b^T|_* for A = Q_a R_a: never larger than D x D.
    a, b = (torch.linalg.qr(rows, mode="r").R if len(rows) > rows.shape[1] else rows for rows in (a, b))
    cross = float(torch.linalg.svdvals(a @ b.T).sum())
    return max(0.0, shift + float(a.square().sum()) + float(b.square().sum()) - 2 * cross)


def _mmd2(sums: Sequence[tuple[Tensor, Tensor]], weights_x: Tensor, weights_y: Tensor, *, joint: bool) -> Tensor:
    """Compute MMD^2 from sums over pairs of groups, for each row of the groups' draws, [R, G] and [R, H] -> [R].

    A pair of groups counts by the product of their draws; a group with itself once a draw.
    """
    draws = ((weights_x, weights_x, True), (weights_y, weights_y, True), (weights_x, weights_y, joint))
    means = []
    for (total, count), (left, right, one_side) in zip(sums, draws, strict=True):
        found, counted = (torch.einsum("rg,gh,rh->r", left, m, right) for m in (total, count))
        if one_side:
            copies = left * (left - 1)
            found, counted = found - copies @ total.diagonal(), counted - copies @ count.diagonal()
        means.append(found / counted)
    return means[0] + means[1] - 2 * means[2]


def _kernel_sums(
    x: Tensor, y: Tensor, groups_x: Tensor, groups_y: Tensor, *, paired: bool
) -> tuple[tuple[Tensor, Tensor], ...]:
    """Sum the kernel over each pair of groups and count the entries, for (x, x), (y, y) and (x, y)."""
    _require_rows(x, y)
    x, y = _aligned(x), _aligned(y)
    return (
        _pair_sums(x, x, groups_x, groups_x, hollow=True),
        _pair_sums(y, y, groups_y, groups_y, hollow=True),
        _pair_sums(x, y, groups_x, groups_y, hollow=paired),
    )


def _pair_sums(a: Tensor, b: Tensor, groups_a: Tensor, groups_b: Tensor, *, hollow: bool) -> tuple[Tensor, Tensor]:
    """Sum the kernel and count entries [G, H] over two sets; hollow: without the entries (i, i). Chunked for memory."""
    member_a, member_b = (torch.nn.functional.one_hot(ids).double() for ids in (groups_a, groups_b))
    total = torch.zeros(member_a.shape[1], member_b.shape[1], dtype=torch.float64)
    count = member_a.sum(0)[:, None] * member_b.sum(0)
    for start in range(0, len(a), _ROWS):
        kernel = (a[start : start + _ROWS] @ b.T / a.shape[1] + 1) ** 3
        if hollow:
            kernel.diagonal(start).zero_()
        total += member_a[start : start + _ROWS].T @ (kernel @ member_b)
    return total, count - member_a.T @ member_b if hollow else count


def _draws(groups: int, resamples: int, generator: torch.Generator) -> Tensor:
    """Count how often each group is drawn in each of the resamples, [R, G]."""
    drawn = torch.randint(groups, (resamples, groups), generator=generator)
    return torch.nn.functional.one_hot(drawn, groups).sum(1).double()


def _aligned(rows: Tensor) -> Tensor:
    """Copy to float64: equal sets then take the same path through the matrix product, bit for bit."""
    return rows.detach().to("cpu", torch.float64, copy=True).contiguous()


def _require_rows(x: Tensor, y: Tensor) -> None:
    if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1] or min(len(x), len(y)) < 2:
        shapes = f"{tuple(x.shape)} and {tuple(y.shape)}"
        raise ValueError(f"expected features [n, D] and [m, D] with n, m of at least 2, got {shapes}")
    require_finite(x, y)


def require_finite(x: Tensor, y: Tensor) -> None:
    """Raise ValueError where two sets of features hold a NaN or an infinite value."""
    if not bool(x.isfinite().all() and y.isfinite().all()):
        raise ValueError("expected finite features, got a NaN or an infinite value")
