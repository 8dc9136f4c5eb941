"""A submission: records of somebody's runs, with who gives them and the digests of all that belongs to them.

A bundle holds what `leaderboard collect` keeps of the runs, `submission.json`, and the runs' reconstructions where they
were asked for.
"""

import contextlib
import datetime
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from rewild4d import __version__
from rewild4d.errors import UserError, shown
from rewild4d.files import replaced_folder, write_text
from rewild4d.leaderboard.collect import HINT, MARKER, Collection, Found, collect, is_open
from rewild4d.leaderboard.media import publish
from rewild4d.leaderboard.predictions import copy_predictions
from rewild4d.leaderboard.privacy import texts_with_paths
from rewild4d.leaderboard.records import FILE, RunRecord, find_records
from rewild4d.leaderboard.variants import grouped, is_floor, variants

SUBMISSION = "submission.json"
SCHEMA = 1
MOST_TEXT = 400
"""Characters of one field of `About`."""
MOST_BYTES = 1e9
"""Of a bundle's records and pictures, before they are packed."""


class About(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Who gives a result, when, and under which licence.

    Attributes:
        name: of the person or the group, as the board names them.
        licence: of records and pictures, one that allows to pass them on.
        date: on which they are given, YYYY-MM-DD.
        title: of the runs, as a heading.
        contact: an address for questions, which will be public; "" for none.
        url: of a paper, or of the code of the method; "" for none.
        partial: why a method lacks cases or seeds; "" where none does.
    """

    name: str
    licence: str
    date: str
    title: str
    contact: str = ""
    url: str = ""
    partial: str = ""


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One run of a submission: which one, and the digests that its record has.

    Attributes:
        folder: in the bundle.
        digests: of code, protocol, clip, truth, and of each network of the metrics, by name.
    """

    folder: str
    run_id: str
    protocol: str
    case: str
    method: str
    seed: int
    digests: dict[str, str]


class Submission(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What `submission.json` holds.

    Attributes:
        schema: version of this layout.
        about: who, when, which licence.
        made_with: version of this package.
        cases: protocol -> all cases that its data has.
        runs: of the bundle, in the order of their folders.
        files: name -> SHA-256, of every other file.
    """

    schema: int
    about: About
    made_with: str
    cases: dict[str, list[str]]
    runs: list[Run]
    files: dict[str, str]


def require_about(about: About) -> About:
    """Return what is said of a submission, if it says all that is needed.

    Raises:
        UserError: a field is empty, too long, on several lines, or names a path; the date or the licence is none.
    """
    if fault := next(faults_of(about), ""):
        raise UserError(fault)
    return about


def faults_of(about: About) -> Iterator[str]:
    """Say what is wrong with who gives a result, a sentence each."""
    for name, text in msgspec.to_builtins(about).items():
        if not text.strip() and name in ("name", "licence", "date", "title"):
            yield f"--{name}: expected a text, got none."
        elif len(text) > MOST_TEXT or not text.isprintable():
            yield f"--{name}: expected one line of at most {MOST_TEXT} characters, got {len(text)}."
        elif next(texts_with_paths(text), ""):
            yield f"--{name}: expected no path of a machine, got '{shown(text)}'."
    with contextlib.suppress(ValueError):
        if len(about.date) == len("2026-01-31") and datetime.date.fromisoformat(about.date):
            if about.licence.strip() and not is_open(about.licence):
                yield (
                    "--licence: expected one that allows to pass things on (CC0, CC BY, CC BY-SA, MIT, Apache, BSD), "
                    f"got '{shown(about.licence)}'."
                )
            return
    yield f"--date: expected a date as 2026-01-31, got '{shown(about.date)}'."


def assemble(
    found: Sequence[Found],
    folder: Path,
    about: About,
    cases: Mapping[str, Sequence[str]],
    *,
    predictions: bool,
    timeout: float,
) -> Collection:
    """Write the files of a bundle into a folder.

    Args:
        found: records with the folders that hold them.
        folder: new or empty.
        about: who gives them.
        cases: protocol -> all cases that its data has, where the data is here.
        predictions: copy the reconstructions that lie beside the records too.
        timeout: seconds that reading and coding one film may take.

    Raises:
        UserError: as `collect` and `copy_predictions`.
    """
    made = collect(found, folder, title=about.title, limit=MOST_BYTES, timeout=timeout)
    made.remarks = [remark.replace(HINT, "") for remark in made.remarks]  # a bundle has no such flag
    sources = {record.run_id: source for source, record in found}
    kept = find_records(folder)
    if predictions:
        without = [record for place, record in kept if not copy_predictions(sources[record.run_id], place)]
        if without:
            made.remarks.append(f"{len(without)} of {len(kept)} runs have no reconstruction beside their record.")
    runs = [run_of(place.relative_to(folder).as_posix(), record) for place, record in kept]
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    all_cases = {name: sorted(listed) for name, listed in sorted(every_case([r for _, r in kept], cases).items())}
    files = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    said = Submission(schema=SCHEMA, about=about, made_with=__version__, cases=all_cases, runs=runs, files=files)
    write_text(folder / SUBMISSION, json.dumps(msgspec.to_builtins(said), indent=1, ensure_ascii=False) + "\n")
    return made


def run_of(folder: str, record: RunRecord) -> Run:
    """Describe a run as `submission.json` does."""
    digests = {
        "code": record.code.get("sources", ""), "protocol": record.protocol.get("digest", ""),
        "clip": record.data.get("clip", ""), "truth": record.data.get("truth", ""),
        **{f"network {name}": digest for name, digest in sorted(record.networks.items())},
    }  # fmt: skip
    return Run(
        folder=folder, run_id=record.run_id, protocol=record.protocol["name"], case=record.case, method=record.method,
        seed=record.seed, digests=digests,
    )  # fmt: skip


def every_case(records: Sequence[RunRecord], known: Mapping[str, Sequence[str]]) -> dict[str, set[str]]:
    """Return all cases of each protocol: those that are known, and those that any record has."""
    groups = grouped(records, lambda record: record.protocol["name"])
    return {name: {*known.get(name, ()), *(record.case for record in group)} for name, group in groups.items()}


def lacking(records: Sequence[RunRecord], cases: Mapping[str, Sequence[str]]) -> list[str]:
    """Say which methods lack cases or seeds, a sentence each; lower bounds are not asked.

    Args:
        records: of a submission.
        cases: protocol -> all cases of its data.
    """
    said = []
    for protocol, group in grouped(records, lambda record: record.protocol["name"]).items():
        every = sorted({*cases.get(protocol, ()), *(record.case for record in group)})
        for label, runs in variants([record for record in group if not is_floor(record)]):
            groups: dict[frozenset[str], list[int]] = {}
            for seed in sorted({run.seed for run in runs}):
                groups.setdefault(frozenset(run.case for run in runs if run.seed == seed), []).append(seed)
            for there, seeds in groups.items():
                if absent := [case for case in every if case not in there]:
                    listed = ", ".join(absent[:5]) + ", ..." * (len(absent) > 5)
                    count = f"{len(there)} of {len(every)} cases"
                    named = f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
                    said.append(f"{protocol}, {label}, {named}: {count}; missing: {listed}.")
    return said


def keep(folder: Path, target: Path, submission: Submission, rescored: int, timeout: float) -> None:
    """Put what was verified of an unpacked bundle where pages and tables read it: all but its reconstructions.

    Args:
        folder: of the unpacked bundle.
        target: a folder that is not there, is empty, or holds an earlier collection, which is replaced.
        submission: what the bundle says of itself.
        rescored: number of runs whose predictions were scored again.
        timeout: seconds that reading one film may take.

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    about, count = submission.about, len(submission.runs)
    status = f"scores of {rescored} of {count} runs reproduced" if rescored else "as submitted, none reproduced"
    title = f"{about.title} (submitted by {about.name}, {about.date}, {about.licence}; {status})"
    with replaced_folder(target, MARKER, "an earlier collection") as building:
        for source, record in find_records(folder):
            place = building / source.relative_to(folder)
            place.mkdir(parents=True)
            shutil.copyfile(source / FILE, place / FILE)
            for name in record.pictures:
                publish(source / name, source, place / name, timeout)
        shutil.copyfile(folder / SUBMISSION, building / SUBMISSION)
        write_text(building / MARKER, json.dumps({"title": title, "runs": count}, indent=1, ensure_ascii=False) + "\n")
