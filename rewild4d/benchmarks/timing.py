"""Measuring several contenders at once: they take turns, so that a machine that slows down slows all of them."""

import statistics
import sys
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
from tqdm import tqdm

Name = TypeVar("Name", bound=Hashable)

BUDGET = 10.0
"""Seconds after which a contender takes no further turn; it always has the first two."""


@dataclass(frozen=True)
class Sample:
    """What a contender took, in milliseconds.

    Attributes:
        median: of all turns.
        minimum: of all turns.
        spread: from the lower to the upper quartile.
        repeats: number of turns.
    """

    median: float
    minimum: float
    spread: float
    repeats: int


def summary(times: list[float]) -> Sample:
    """Sum up one contender's times (milliseconds, at least one)."""
    quartiles = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else [times[0]] * 3
    return Sample(statistics.median(times), min(times), quartiles[2] - quartiles[0], len(times))


def per(sample: Sample, parts: int) -> Sample:
    """The time of one of several equal parts."""
    return Sample(sample.median / parts, sample.minimum / parts, sample.spread / parts, sample.repeats)


def measure(
    contenders: Mapping[Name, Callable[[], object]],
    repeats: int,
    title: str,
    *,
    budget: float = BUDGET,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, Sample]:
    """Time all contenders in rounds; in each round every one has a turn.

    A turn is a call that is not timed, because the last contender left its own data in the caches, and one that is.

    Args:
        contenders: what to call, by name.
        repeats: rounds.
        title: of the progress bar.
        budget: see `BUDGET`.
        clock: gives seconds.

    Returns:
        A sample for each contender.
    """
    times: dict[Name, list[float]] = {name: [] for name in contenders}
    spent = dict.fromkeys(contenders, 0.0)
    with progress(title, repeats) as bar:
        for _ in range(repeats):
            for name, call in contenders.items():
                if spent[name] > budget and len(times[name]) > 1:
                    continue
                begin = clock()
                call()
                between = clock()
                call()
                end = clock()
                times[name].append(1e3 * (end - between))
                spent[name] += end - begin
            bar.update()
    return {name: summary(values) for name, values in times.items()}


@contextmanager
def progress(title: str, total: int) -> Iterator[tqdm]:
    """A bar on standard error, which leaves one line where that is a file."""
    pause = 0.5 if sys.stderr.isatty() else 10.0
    with tqdm(desc=title, total=total, file=sys.stderr, mininterval=pause) as bar:
        yield bar


@contextmanager
def threads(count: int | None) -> Iterator[int]:
    """Compute with so many threads, torch's own number where None; gives the number."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
