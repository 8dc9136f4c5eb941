"""Score by metrics of other packages (entry point `rewild4d.metrics`): whatever they do, a fit is never lost."""

import math
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
import torch

from rewild4d.contracts import Metric, MetricInfo, NotComputed, Tally
from rewild4d.errors import UserError, reason, shown
from rewild4d.machine import package_sources
from rewild4d.metrics.names import ALL
from rewild4d.metrics.score import Score
from rewild4d.registry import load_metric, names, package_of


@dataclass(frozen=True)
class Source:
    """What a metric may ask for.

    Attributes:
        items: gives them from the first on.
        count: how many.
        absent: why there are none, or "".
        word: what one of them is called.
    """

    items: Callable[[], Iterable[Any]]
    count: int
    absent: str
    word: str


class _Again:
    """An iterable that starts anew with every loop."""

    def __init__(self, items: Callable[[], Iterable[Any]]) -> None:
        self._items = items

    def __iter__(self) -> Any:
        return iter(self._items())


def metric_names() -> list[str]:
    """Return the names of the metrics of other packages, but for those that are a score of ours."""
    return [name for name in names("metrics") if name not in ALL]


def find_metric(name: str) -> tuple[Metric, MetricInfo]:
    """Return a metric of another package, and what it says of itself.

    Raises:
        UserError: no such metric, the name is a score of ours, the package cannot be imported, or ``info`` is no
            `MetricInfo`.
    """
    if name in ALL:
        raise UserError(f"metric '{name}': expected a name that none of our scores has.")
    metric = load_metric(name)
    info = getattr(metric, "info", None)
    if not isinstance(info, MetricInfo):
        raise UserError(f"metric '{name}': expected `info`, a contracts.MetricInfo, got {shown(type(info).__name__)}.")
    try:
        return metric, msgspec.convert(asdict(info), MetricInfo)
    except msgspec.ValidationError as error:
        raise UserError(f"metric '{name}': expected a contracts.MetricInfo, but {reason(error)}.") from error


def score_plugged(sources: Mapping[str, Source]) -> tuple[dict[str, Score], dict[str, dict[str, str]]]:
    """Score by every metric that an installed package adds.

    Args:
        sources: "images", "points" (`MetricInfo.needs`).

    Returns:
        The scores by the names of the entry points, and what the record says of each: title, definition, package,
        version, digest of the package's sources.
    """
    scores, about = {}, {}
    for name in metric_names():
        about[name] = package_of("metrics", name)
        try:
            metric, info = find_metric(name)
        except (Exception, SystemExit) as error:
            scores[name] = _failed(name, Score(None, "1", "", 0), error)
            continue
        module = type(metric).__module__.partition(".")[0]
        about[name] |= {"title": info.title, "definition": info.definition, "sources": package_sources(module)}
        scores[name] = _score(name, metric, info, sources[info.needs])
    return scores, about


def measure(metric: Metric, info: MetricInfo, source: Source) -> Score:
    """Measure one case by a metric.

    Raises:
        NotComputed: it has no value.
        UserError: what the metric returned is not what `contracts.Metric` says; and whatever it raises itself.
    """
    if source.absent:
        raise NotComputed(source.absent)
    with torch.no_grad():
        tallies = [_tally(found) for found in metric.measure(_Again(source.items))]
    if len(tallies) not in (1, source.count):
        raise UserError(f"expected an entry for each {source.word} ({source.count}) or one, got {len(tallies)}.")
    present = [tally for tally in tallies if tally is not None]
    if not present:
        raise NotComputed(f"no {source.word} in which it is defined")
    value = math.fsum(tally.total for tally in present) / sum(tally.count for tally in present)
    items = [None if tally is None else tally.total / tally.count for tally in tallies]
    left = len(tallies) - len(present)
    note = f"{left} {source.word}s left out: not defined there" if left else ""
    of_items = items if len(items) == source.count else []
    return Score(value, info.unit, info.better, sum(tally.count for tally in present), of_items, note)


def _score(name: str, metric: Metric, info: MetricInfo, source: Source) -> Score:
    empty = Score(None, info.unit, info.better, 0)
    try:
        return measure(metric, info, source)
    except NotComputed as error:
        return msgspec.structs.replace(empty, note=f"not computed: {reason(error)}")
    except (Exception, SystemExit) as error:
        return _failed(name, empty, error)


def _failed(name: str, empty: Score, error: BaseException) -> Score:
    """Tell the terminal all and the record one sentence."""
    said = reason(error) if isinstance(error, UserError) else f"{type(error).__name__}: {reason(error)}"
    if isinstance(error, UserError):
        print(f"metric '{name}': not computed: {said}", file=sys.stderr)
    else:
        traceback.print_exception(error, file=sys.stderr)
    return msgspec.structs.replace(empty, note=f"not computed: {said}")


def _tally(found: Any) -> Tally | None:
    """Check one entry of what a metric returned; a count of 0 has no value."""
    if found is None:
        return None
    total, count = (found.total, found.count) if isinstance(found, Tally) else (found, 1)
    try:
        if math.isfinite(total) and count >= 0 and int(count) == count:
            return Tally(float(total), int(count)) if count else None
    except (TypeError, ValueError):
        pass
    raise UserError(f"expected a finite number, a contracts.Tally or None, got {shown(found)}.")
