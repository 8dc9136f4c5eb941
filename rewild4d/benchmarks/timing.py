"""Time several contenders alternately, so that a slowdown of the machine affects all of them."""

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
"""Seconds after which a contender that was timed twice is not timed again."""


@dataclass(frozen=True)
class Sample:
    """A contender's times in milliseconds."""

    median: float
    minimum: float
    spread: float  # interquartile range
    repeats: int  # number of times


def summary(times: list[float]) -> Sample:
    """Summarise one contender's times (milliseconds, at least one)."""
    quartiles = statistics.quantiles(times, n=4, method="inclusive") if len(times) > 1 else [times[0]] * 3
    return Sample(statistics.median(times), min(times), quartiles[2] - quartiles[0], len(times))


def per(sample: Sample, parts: int) -> Sample:
    """Divide a sample by a number of equal parts."""
    return Sample(sample.median / parts, sample.minimum / parts, sample.spread / parts, sample.repeats)


def measure(
    contenders: Mapping[Name, Callable[[], object]],
    repeats: int,
    title: str,
    *,
    budget: float = BUDGET,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, Sample]:
    """Time each contender once a round, until it has spent its ``budget`` in seconds.

    An untimed call precedes each timed one to fill the caches.
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
    """Show a progress bar on standard error."""
    pause = 0.5 if sys.stderr.isatty() else 10.0
    with tqdm(desc=title, total=total, file=sys.stderr, mininterval=pause) as bar:
        yield bar


@contextmanager
def threads(count: int | None) -> Iterator[int]:
    """Set torch's number of threads (None keeps it); yield the number."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield torch.get_num_threads()
    finally:
        torch.set_num_threads(before)
