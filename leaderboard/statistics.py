"""Means and spreads over seeds and cases, ranks, paired differences."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Cases = Mapping[str, Mapping[int, float]]
"""Case -> seed -> value."""
DRAWS = 10_000
"""Draws of the bootstrap; ten thousand settle two digits of the ends of a 95 % interval."""


@dataclass(frozen=True)
class Estimate:
    """A mean over cases of the mean over seeds.

    Attributes:
        mean: of the cases.
        spread: standard deviation over seeds of the mean over cases, None where fewer than two seeds are complete.
        seeds: how many seeds every case has.
    """

    mean: float
    spread: float | None
    seeds: int


@dataclass(frozen=True)
class Difference:
    """How much higher one method is than another, over the same cases.

    Attributes:
        mean: of the cases' differences.
        interval: ends of the 95 % interval, None where there is one case and one seed.
        cases: how many cases.
    """

    mean: float
    interval: tuple[float, float] | None
    cases: int


def estimate(values: Cases) -> Estimate:
    """Compute mean and spread; every case counts once, however many seeds it has.

    Args:
        values: at least one case, each with at least one seed.
    """
    mean = statistics.fmean(statistics.fmean(seeds.values()) for seeds in values.values())
    common = set.intersection(*(set(seeds) for seeds in values.values()))
    per_seed = [statistics.fmean(seeds[seed] for seeds in values.values()) for seed in sorted(common)]
    return Estimate(mean, statistics.stdev(per_seed) if len(per_seed) > 1 else None, len(per_seed))


def paired(values: Cases, reference: Cases) -> Difference:
    """Compute the difference to a reference, case by case, with a bootstrap interval.

    Cases are drawn with replacement, then the seeds of either side within each drawn one (a case that is drawn twice
    gets new seeds the second time), so that the interval holds both what another set of animals and what another set
    of seeds would change. With one case only the seeds vary.

    Args:
        values: of one method.
        reference: of the other; cases that only one side has are left out.

    Raises:
        ValueError: no case in common.
    """
    shared = [case for case in values if case in reference]
    if not shared:
        raise ValueError("expected at least one case in common, got none")
    sides = [[np.array(list(side[case].values())) for case in shared] for side in (values, reference)]
    mean = float(np.mean([a.mean() - b.mean() for a, b in zip(*sides, strict=True)]))
    if len(shared) == 1 and all(len(side[0]) == 1 for side in sides):
        return Difference(mean, None, 1)
    generator = np.random.default_rng(0)
    total = np.zeros(DRAWS)
    for _ in shared:
        rows = generator.integers(len(shared), size=DRAWS)
        total += _redrawn(sides[0], rows, generator) - _redrawn(sides[1], rows, generator)
    low, high = np.quantile(total / len(shared), (0.025, 0.975))
    return Difference(mean, (float(low), float(high)), len(shared))


def _redrawn(side: Sequence[np.ndarray], rows: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw again the seeds of each drawn case (rows [draws] into side, [seeds] a case), and average them, [draws]."""
    means = np.empty(len(rows))
    for row, seeds in enumerate(side):
        places = np.flatnonzero(rows == row)
        picks = generator.integers(len(seeds), size=(len(places), len(seeds)))
        means[places] = seeds[picks].mean(axis=1)
    return means


def ranks(estimates: Sequence[Estimate | None], better: str, digits: int) -> list[str]:
    """Mark entries as "best", "second" or "" (all others, and those without a value).

    An entry that the spread over seeds does not tell apart from the one before it is not ranked behind it: where the
    lead of the best is within the larger of the two spreads nobody is best, and all those within it are second.

    Args:
        estimates: of the competitors.
        better: "higher", "lower", or "" where nothing is ranked.
        digits: printed after the point; what prints alike is alike.
    """
    sign = -1 if better == "higher" else 1
    known = sorted((sign * round(e.mean, digits), i, e.spread or 0.0) for i, e in enumerate(estimates) if e is not None)
    marks = [""] * len(estimates)
    if len(known) < 2 or not better:
        return marks
    first = _leaders(known)
    if len(first) == 1:
        marks[first[0]] = "best"
        first = _leaders(known[1:])
    for index in first:
        marks[index] = "second"
    return marks


def _leaders(ordered: Sequence[tuple[float, int, float]]) -> list[int]:
    """List the indices of the first (value, index, spread) and of all within the spread of it."""
    best, _, spread = ordered[0]
    return [index for value, index, other in ordered if value - best <= max(spread, other)]
