"""Which records belong together: runs of one method with one set of settings, the latest of each."""

import hashlib
import json
import re
import statistics
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple, TypeVar

from rewild4d.leaderboard.records import RunRecord

T = TypeVar("T")

_BUILT_IN = re.compile(r"(builtin-v\d+)-[0-9a-f]{12}")
"""A folder of the built-in animals: their version, then a digest of the sources that made them."""
_WITHOUT_PRIOR = ("empty",)
"""Lower bounds without Gaussians: no prior changes their scores."""


class Variant(NamedTuple):
    """A method with its settings.

    Attributes:
        label: method, with what tells it from other variants of it: preset, settings, prior, version of the code.
        records: all its runs, of one version of code and weights (`version_of`).
    """

    label: str
    records: tuple[RunRecord, ...]


def grouped(records: Iterable[RunRecord], key: Callable[[RunRecord], T]) -> dict[T, list[RunRecord]]:
    """Group records by a key, in the order in which the keys are met."""
    groups: dict[T, list[RunRecord]] = defaultdict(list)
    for record in records:
        groups[key(record)].append(record)
    return dict(groups)


def by_protocol(records: Iterable[RunRecord]) -> list[list[RunRecord]]:
    """Group records by data set and protocol, in their names' order."""
    groups = grouped(records, lambda record: (record.dataset, record.protocol["name"]))
    return [group for _, group in sorted(groups.items())]


def latest(records: Sequence[RunRecord]) -> tuple[list[RunRecord], list[str]]:
    """Choose the records that may stand in one table, and say in sentences which are left out.

    Of equal runs by several versions of the code the latest one counts, and a lower bound is one run whatever preset it
    was run beside. Of a case whose data has changed, and of a protocol that has, only the runs on the latest one count.
    The built-in animals of one version, and folders that were rendered by one recipe, are the same data on every
    processor, although the last digits of its arithmetic, and with them some pixels, differ.
    """
    remarks = []
    kept: list[RunRecord] = []
    rounded: dict[str, list[str]] = defaultdict(list)
    records, older = _on_one_protocol(records)
    remarks += older
    spread = _spread(records)
    cases = grouped(records, lambda record: (record.dataset, record.protocol["name"], record.case))
    for (_, protocol, case), runs in cases.items():
        newest = max(runs, key=_age)
        same = [run for run in runs if comparable(run, newest)]
        if len(same) < len(runs):
            remarks.append(f"{protocol}, {case}: {len(runs) - len(same)} older records of other data left out.")
        if len({_digests(run) for run in same}) > 1:
            rounded[protocol].append(case)
        last = {(_identity(run), run.seed): run for run in sorted(same, key=lambda run: (spread(run), _age(run)))}
        kept += [run for run in same if last[_identity(run), run.seed] is run]
    remarks += [
        f"{protocol}: {', '.join(found)} rendered on several kinds of processor, equal up to rounding."
        for protocol, found in rounded.items()
    ]
    versions = {record.code.get("sources", "") for record in kept if record.code}
    if len(versions) > 1:
        remarks.append(f"Runs of {len(versions)} versions of the code; no mean is over two of them.")
    return kept, remarks


def _spread(records: Sequence[RunRecord]) -> Callable[[RunRecord], int]:
    """Return how many cases the version of a lower bound's run has: of doubled ones the version with most stays, so
    that its row is of one version. Of methods nothing: the latest run counts."""
    keys = {id(run): (run.protocol["name"], _identity(run), version_of(run)) for run in records if is_floor(run)}
    cases = Counter(key for key, _ in {(keys[id(run)], run.case) for run in records if id(run) in keys})
    return lambda run: cases[keys[id(run)]] if id(run) in keys else 0


def _on_one_protocol(records: Sequence[RunRecord]) -> tuple[list[RunRecord], list[str]]:
    """Leave out records of a protocol that has changed under its name since, and say so."""
    kept, remarks = [], []
    for (_, name), group in grouped(records, lambda run: (run.dataset, run.protocol["name"])).items():
        newest = max(group, key=_age).protocol.get("digest")
        same = [run for run in group if run.protocol.get("digest") == newest]
        gone = sorted({run.case for run in group} - {run.case for run in same})
        if gone:
            remarks.append(f"{name}: records of {', '.join(gone)} by another protocol of that name left out.")
        kept += [run for run in group if run.case not in gone]
    return kept, remarks


def variants(records: Sequence[RunRecord]) -> list[Variant]:
    """Group records by method, preset, settings, prior and version, in the order in which they are met."""
    groups = grouped(records, _identity).values()
    firsts = [group[0] for group in groups]
    return [
        Variant(_label(group[0], firsts) + version, part)
        for group in groups
        for version, (part,) in by_version([tuple(group)]).items()
    ]


def by_version(conditions: Sequence[Sequence[RunRecord]]) -> dict[str, tuple[tuple[RunRecord, ...], ...]]:
    """Split the records of one row where those of a condition are of several versions of code or weights.

    Args:
        conditions: records of the row, under each condition.

    Returns:
        End of the row's label (" [code 1a2b3c4d]") -> its records under each condition; "" -> all of them where no
        mean would be over two versions.
    """
    if all(len({version_of(run) for run in found}) <= 1 for found in conditions):
        return {"": tuple(map(tuple, conditions))}
    versions = dict.fromkeys(version_of(run) for found in conditions for run in found)
    return {
        f" [{version or 'code unknown'}]": tuple(
            tuple(run for run in found if version_of(run) == version) for found in conditions
        )
        for version in versions
    }


def version_of(record: RunRecord) -> str:
    """Name the versions of what made a result beside its settings: our code, another's, weights of the prior."""
    parts = {
        "code": record.code.get("sources"), "method": record.code.get("method"),
        "program": record.code.get("program_digest"), "prior weights": record.prior.get("weights"),
    }  # fmt: skip
    return ", ".join(f"{name} {digest[:8]}" for name, digest in parts.items() if digest)


def is_floor(record: RunRecord) -> bool:
    """Tell whether the record's protocol names its method as a floor."""
    return record.method in record.protocol.get("floors", ())


def scores_of(records: Sequence[RunRecord]) -> tuple[str, ...]:
    """List the scores of a protocol's records: those that it asks for, then those of other packages' metrics."""
    asked = dict.fromkeys(records[0].protocol["scores"])
    return tuple(asked | dict.fromkeys(name for record in records for name in record.metrics))


def marks(records: Sequence[RunRecord]) -> tuple[str, ...]:
    """List what the records say beside their numbers, each sentence once."""
    return tuple(dict.fromkeys(mark for record in records for mark in record.marks))


def row_kind(records: Sequence[RunRecord]) -> str:
    """Name the kind of a row of records: "method", "unranked" where it had what the others had not, or "floor"."""
    if marks(records):
        return "unranked"
    return "floor" if records and is_floor(records[0]) else "method"


def coverage_text(records: Sequence[RunRecord]) -> str:
    """Say how much of an image is animal and how much of it was shown, averaged over the cases."""
    by_case = {record.case: record.coverage for record in records if record.coverage}
    parts = []
    for key, text in (("foreground", "of a scored image is animal"), ("seen_surface", "of its surface ever shown")):
        values = [found[key] for found in by_case.values() if key in found]
        if values:
            parts.append(f"{100 * statistics.fmean(values):.0f} % {text}")
    return ", ".join(parts) or "coverage unknown"


def _age(record: RunRecord) -> tuple[str, str]:
    return record.timing.started, record.run_id


def comparable(run: RunRecord, other: RunRecord) -> bool:
    """Tell whether two runs of a case are of one protocol and of one data set."""
    recipe = _recipe(run)
    same = _digests(run) == _digests(other) or (recipe is not None and recipe == _recipe(other))
    return same and run.protocol.get("digest") == other.protocol.get("digest")


def _recipe(record: RunRecord) -> str | None:
    """Name what the data was rendered from, if it was."""
    built_in = _BUILT_IN.fullmatch(PurePath(record.data.get("root", "")).name)
    return built_in[1] if built_in else record.data.get("recipe") or None


def _digests(record: RunRecord) -> tuple[Any, Any]:
    """Return the digests of every pixel, camera and time that the method saw, and of the truth."""
    return record.data.get("clip"), record.data.get("truth")


def _settings(record: RunRecord) -> dict[str, Any]:
    """Flatten all that tells variants of a method apart: {"deform.enabled": False, ...}."""
    if record.method in _WITHOUT_PRIOR and is_floor(record):
        return _config(record)
    fit = json.dumps(record.prior.get("config"), sort_keys=True).encode()
    seen = record.prior.get("keypoints", "none")
    return _config(record) | {
        "--prior": record.prior.get("choice", record.prior.get("name")),
        "prior fit": hashlib.sha256(fit).hexdigest()[:4],
        **({"--use-keypoints": seen} if seen != "none" else {}),
    }


def _config(record: RunRecord) -> dict[str, Any]:
    """Flatten the method's settings; a program of others is told by its name, not by where its file lies."""
    left_out = ("file", "program") if "program" in record.code else ()
    return {name: value for name, value in flat(record.config).items() if name not in left_out}


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings: {"deform": {"enabled": True}} -> {"deform.enabled": True}."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


def _identity(record: RunRecord) -> str:
    return json.dumps([_method(record), _preset(record), _settings(record)], sort_keys=True)


def _method(record: RunRecord) -> str:
    """Return the method's name, with that of the program of others that it ran."""
    return ": ".join(filter(None, (record.method, record.code.get("program"))))


def _preset(record: RunRecord) -> str:
    """Return the preset of a method; a lower bound has none, it is named after the rows that it was run beside."""
    return "" if is_floor(record) else record.preset


def _label(record: RunRecord, others: Sequence[RunRecord]) -> str:
    """Name the method, its preset where there are several, and the settings and prior that tell it from the others."""
    kin = [other for other in others if _method(other) == _method(record)]
    peers = [_settings(other) for other in kin if _preset(other) == _preset(record)]
    preset = f" ({record.preset})" if len(set(map(_preset, kin))) > 1 else ""
    changed = []
    for name, value in _settings(record).items():
        counts = Counter(json.dumps(peer.get(name)) for peer in peers).most_common(2)
        alone = len(counts) == 1
        usual = counts[0][0] if alone or counts[0][1] > counts[1][1] else None
        if not alone and json.dumps(value) != usual:
            changed.append(f"{name}={json.dumps(value)}")
        elif name == "--prior" and record.prior.get("choice", "template") != "template":
            changed.append(f"{name}={json.dumps(PurePath(value).name)}")
    return _method(record) + preset + (f" [{', '.join(changed)}]" if changed else "")
