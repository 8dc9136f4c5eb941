"""What `leaderboard verify` holds a bundle against: itself, what is known here, and new scores of its predictions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import msgspec

from rewild4d.errors import UserError, reason, shown, unknown_name
from rewild4d.evaluation.protocol import Protocol, load_protocols
from rewild4d.foreign.texts import read_json
from rewild4d.leaderboard.bundle import unpack
from rewild4d.leaderboard.collect import MARKER, RUN_BYTES, is_open, title_of
from rewild4d.leaderboard.media import publish
from rewild4d.leaderboard.plausible import implausible
from rewild4d.leaderboard.predictions import FOLDER, paths_in
from rewild4d.leaderboard.privacy import texts_with_paths
from rewild4d.leaderboard.records import FILE, RunRecord, read_record
from rewild4d.leaderboard.submission import SCHEMA, SUBMISSION, Run, Submission, faults_of, lacking, run_of
from rewild4d.machine import code_version
from rewild4d.metrics.weights import table
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.registry import load_dataset, load_method, names, require_name
from rewild4d.running.provenance import FROM_TRUTH


@dataclass
class Bundle:
    """An unpacked bundle, and what became of it.

    Attributes:
        path: of the zip file.
        folder: where it was unpacked.
        files: name of each file that it holds -> SHA-256.
        submission: what it says of itself; None where that cannot be read.
        records: folder in the bundle -> record of the run, of those that can be read.
        findings: what is wrong, a sentence each.
        verified: what was looked at and is right.
        unverified: what was not looked at, and why.
        rescored: folders of the runs whose predictions were scored again.
    """

    path: Path
    folder: Path
    files: dict[str, str] = field(default_factory=dict)
    submission: Submission | None = None
    records: dict[str, RunRecord] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    verified: list[str] = field(default_factory=list)
    unverified: list[str] = field(default_factory=list)
    rescored: list[str] = field(default_factory=list)

    @contextmanager
    def looking(self, right: str = "") -> Iterator[list[str]]:
        """Take findings in the block, an UserError too; where there are none, note what is right."""
        found: list[str] = []
        with self.catching(found):
            yield found
        self.findings += found
        if right and not found:
            self.verified.append(right)

    @contextmanager
    def catching(self, found: list[str]) -> Iterator[None]:
        """Take a UserError of the block for a finding that names files as the bundle does."""
        try:
            yield
        except UserError as error:
            found.append(str(error).replace(f"{self.folder}/", ""))

    def predictions(self, run: str) -> list[str]:
        """List the files of a run's reconstruction."""
        return [name for name in self.files if name.startswith(f"{run}/{FOLDER}/")]


def counted(number: int, one: str, many: str = "") -> str:
    """Write a number of things."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def examine(path: Path, folder: Path, timeout: float) -> Bundle:
    """Unpack a bundle and look at all that needs no data.

    Args:
        path: of the bundle.
        folder: empty; its files go there.
        timeout: seconds that reading one film may take.

    Raises:
        UserError: it is no bundle at all.
    """
    bundle = Bundle(path, folder)
    bundle.files, bundle.findings = unpack(path, folder)
    if SUBMISSION in bundle.files:
        with bundle.looking():
            bundle.submission = read_json(folder / SUBMISSION, "what a bundle says of itself", Submission)
            if bundle.submission.schema != SCHEMA:
                raise UserError(f"{SUBMISSION}: expected schema {SCHEMA}, got {bundle.submission.schema}.")
    elif not bundle.findings:
        bundle.findings.append(f"expected a file {SUBMISSION}, got none.")
    if bundle.submission is None or not bundle.files:
        return bundle
    _read(bundle, bundle.submission)
    _digests(bundle, bundle.submission)
    _texts(bundle, bundle.submission)
    _names(bundle)
    _values(bundle)
    _pictures(bundle, timeout)
    _predictions(bundle)
    return bundle


def _read(bundle: Bundle, submission: Submission) -> None:
    """Read the records that the bundle names, and hold them against what it says of them."""
    with bundle.looking(f"{counted(len(submission.runs), 'record')}, in the layout of schema 1") as found:
        if not submission.runs:
            found.append("expected at least one run, got none.")
        for run in submission.runs:
            name = f"{run.folder}/{FILE}"
            if name not in bundle.files:
                found.append(f"'{shown(name, 200)}' is missing: {SUBMISSION} names that run.")
                continue
            with bundle.catching(found):
                record = read_record(bundle.folder / name)
                if run_of(run.folder, record) != run:
                    found.append(f"{run.folder}: {SUBMISSION} says something else of it than its record.")
                bundle.records[run.folder] = record
        ids = Counter(record.run_id for record in bundle.records.values())
        found += [f"expected every run once, got {one} {count} times." for one, count in ids.items() if count > 1]


def _digests(bundle: Bundle, submission: Submission) -> None:
    """Hold every file against its digest; files that nothing names are findings too."""
    with bundle.looking(f"SHA-256 of {counted(len(submission.files), 'file')}, and no other file is inside") as found:
        for name, digest in submission.files.items():
            if name not in bundle.files and PurePosixPath(name).name != FILE:  # records were missed already
                found.append(f"'{shown(name, 200)}' is missing: {SUBMISSION} names it.")
            elif bundle.files.get(name, digest) != digest:
                found.append(f"'{name}' is not the file that was submitted: its SHA-256 is another.")
        for name in sorted({*bundle.files} - {SUBMISSION}):
            if name not in submission.files or not _belongs(bundle, name):
                found.append(f"'{name}' is a stray file: it belongs to no run.")


def _belongs(bundle: Bundle, name: str) -> bool:
    """Tell whether a file is one that a bundle has: of the collection, a record, its pictures, its reconstruction."""
    if name == MARKER:
        return True
    for run, record in bundle.records.items():
        if name.startswith(f"{run}/{FOLDER}/") or name in {f"{run}/{beside}" for beside in (FILE, *record.pictures)}:
            return True
    return PurePosixPath(name).name == FILE and any(name == f"{run.folder}/{FILE}" for run in _runs(bundle))


def _runs(bundle: Bundle) -> list[Run]:
    return bundle.submission.runs if bundle.submission else []


def _texts(bundle: Bundle, submission: Submission) -> None:
    """Look at who gives it, and for paths of a machine in all texts."""
    about = submission.about
    with bundle.looking(f"given by {about.name} on {about.date} under {about.licence}") as found:
        found += [f"{SUBMISSION}: {fault.removeprefix('--')}" for fault in faults_of(about)]
        if MARKER in bundle.files and title_of(bundle.folder) != about.title:
            found.append(f"{MARKER}: expected the title that {SUBMISSION} has.")
    with bundle.looking("no path of a machine in any record") as found:
        texts = {SUBMISSION: submission, **bundle.records}
        for place, tree in texts.items():
            if path := next(texts_with_paths(msgspec.to_builtins(tree)), ""):
                found.append(f"{place}: expected no path of a machine, got '{shown(path, 100)}'.")


def _names(bundle: Bundle) -> None:
    """Hold protocols, data sets, methods, marks and networks against those that are known here."""
    known, asked = load_protocols(), {record.protocol["name"] for record in bundle.records.values()}
    methods = {record.method for record in bundle.records.values()}
    right = (
        f"settings of {counted(len(asked), 'protocol')}, names of {counted(len(methods), 'method')}: as they are here"
    )
    with bundle.looking(right) as found:
        for run, record in bundle.records.items():
            for kind, name in (("methods", record.method), ("datasets", record.dataset)):
                faults: list[str] = []
                with bundle.catching(faults):
                    require_name(kind, name)
                found += [f"{run}: {fault}" for fault in faults]
            found += [f"{run}: {fault}" for fault in _protocol_faults(record, known)]
            if record.method in names("methods") and (absent := _marks(record) - {*record.marks}):
                found.append(f"{run}: expected the mark '{shown(absent.pop())}', which its row needs, got none.")
            for network, digest in record.networks.items():
                pinned = table().networks.get(network.replace("_", "-"))
                if pinned and pinned.sha256 != digest:
                    found.append(f"{run}: expected the weights of {network} that are known here, got others.")
    here = code_version()["sources"]
    others = sorted({record.code.get("sources", "") for record in bundle.records.values()} - {here})
    if others:
        bundle.unverified.append(f"the code that made it ({', '.join(others)}): this one is {here}")


def _protocol_faults(record: RunRecord, known: dict[str, Protocol]) -> Iterator[str]:
    name = record.protocol["name"]
    if name not in known:
        yield str(unknown_name("protocol", name, known))
        return
    try:
        given = msgspec.convert({key: value for key, value in record.protocol.items() if key != "digest"}, Protocol)
    except msgspec.ValidationError as error:
        yield f"expected the settings of protocol '{name}', but {reason(error)}."
        return
    if (given, record.protocol.get("digest")) != (known[name], known[name].digest):
        yield f"expected the settings of protocol '{name}' as they are here, got others."
    if record.dataset != known[name].dataset:
        yield f"protocol '{name}' is for the data set '{known[name].dataset}', not for '{shown(record.dataset)}'."


def _marks(record: RunRecord) -> set[str]:
    """Return the marks that a run has by its method and its prior."""
    info, choice = load_method(record.method).info, record.prior.get("choice", "template")
    found = {info.mark} if info.mark else set()
    if info.uses_prior and PriorChoice(choice, STANDARD).is_from_truth:
        found.add(FROM_TRUTH)
    return found


def _values(bundle: Bundle) -> None:
    """Look at numbers, seeds and cases."""
    count = sum(len(record.scores) for record in bundle.records.values())
    with bundle.looking(f"{counted(count, 'score')}: finite, in range, equal to the means of their items") as found:
        found += [f"{run}: {fault}" for run, record in bundle.records.items() for fault in implausible(record)]
    failed = [run for run, record in bundle.records.items() if record.status == "failed"]
    if failed:
        bundle.unverified.append(f"{counted(len(failed), 'run')} that failed: {', '.join(failed[:3])}")


def look_at_cases(bundle: Bundle, known: dict[str, list[str]]) -> None:
    """Say which methods lack cases or seeds: a finding, unless the submission says why.

    Args:
        bundle: with its records.
        known: protocol -> all cases of the data that are here; what the bundle says itself counts too.
    """
    if bundle.submission is None:
        return
    every = {name: [*bundle.submission.cases.get(name, ()), *known.get(name, ())] for name in
             {*bundle.submission.cases, *known}}  # fmt: skip
    said, why = lacking(list(bundle.records.values()), every), bundle.submission.about.partial
    if why:
        bundle.unverified += [f"{sentence.rstrip('.')} (said: {why})" for sentence in said]
    else:
        bundle.findings += said
    if not said:
        source = "of the data here" if known else "that the submission names"
        bundle.verified.append(f"every method has all cases {source}")


def _pictures(bundle: Bundle, timeout: float) -> None:
    """Decode all pictures, and refuse those of data that may not be passed on."""
    count = sum(len(record.pictures) for record in bundle.records.values())
    right = f"{counted(count, 'picture or film', 'pictures and films')}: can be decoded, of open data" if count else ""
    with bundle.looking(right) as found:
        for run, record in bundle.records.items():
            licence = record.data.get("licence", "")
            if (stated := _stated_licence(record.dataset)) not in ("", licence):
                found.append(f"{run}: expected the licence of its data set, '{shown(stated)}', got '{shown(licence)}'.")
            if record.pictures and not is_open(licence):
                found.append(f"{run}: expected no pictures of data that may not be passed on ('{shown(licence)}').")
            with bundle.catching(found):
                _decode(bundle.folder / run, record, timeout)
    if count:
        bundle.unverified.append("that the pictures show these runs: look at them")


def _stated_licence(dataset: str) -> str:
    """Return the licence that all data of a data set has; "" where each animal has its own."""
    stated = getattr(load_dataset(dataset), "licence", "") if dataset in names("datasets") else ""
    return stated if isinstance(stated, str) else ""


def _decode(run: Path, record: RunRecord, timeout: float) -> None:
    """Decode the pictures of a run, which have to be small.

    Raises:
        UserError: one is damaged, another kind of file, or has more in it than an image; they are too large together.
    """
    size = 0
    for name in record.pictures:
        if not (run / name).is_file():
            continue  # missed already
        size += (run / name).stat().st_size
        copy = run / f".copy{Path(name).suffix}"
        publish(run / name, run, copy, timeout)
        bare = copy.read_bytes()
        copy.unlink()
        if copy.suffix == ".webp" and bare != (run / name).read_bytes():
            raise UserError(f"{run / name}: expected an image and nothing else, got more.")
    if size > RUN_BYTES:
        raise UserError(f"{run}: expected pictures of at most {RUN_BYTES / 1e3:.0f} kB, got {size / 1e3:.0f} kB.")


def _predictions(bundle: Bundle) -> None:
    """Look for paths of a machine in the reconstructions."""
    files = [name for run in bundle.records for name in bundle.predictions(run)]
    if files:
        with bundle.looking(f"no path of a machine in {counted(len(files), 'file')} of predictions") as found:
            for name in files:
                with bundle.catching(found):
                    if path := next(paths_in(bundle.folder / name), ""):
                        found.append(f"'{name}': expected no path of a machine, got '{shown(path, 100)}'.")
