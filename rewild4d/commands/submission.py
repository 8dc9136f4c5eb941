"""`leaderboard submit`, `verify` and `add`: a bundle of runs for the board, what can be checked of it, and its records
among others."""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from rewild4d.commands.shared import check_timeout, require_writable, require_writable_file
from rewild4d.config import parse_flags
from rewild4d.errors import UserError, bounded

if TYPE_CHECKING:
    from rewild4d.commands.verifying import Bundle
    from rewild4d.leaderboard.collect import Found
    from rewild4d.leaderboard.submission import About

SUBMIT = """Put runs into one file for the board: the records without absolute paths, with small pictures where the
data's licence allows them, SHA-256 of every file, who gives them and under which licence. It is verified before it is
written."""
VERIFY = """Check a bundle: layout, digests, names, values, cases, pictures, paths; with --data also scores, computed
again from the predictions of some runs. Says what was verified, what was not, and each thing that is wrong."""
ADD = """Verify a bundle and, where nothing is wrong, put its records and pictures into a folder of their own that
`leaderboard build` and `table` read."""


@dataclass(frozen=True, kw_only=True)
class SubmitOptions:
    """Flags of `leaderboard submit`.

    Attributes:
        runs: folders of runs, or of single runs.
        out: the bundle, a .zip file.
        about: TOML file with any of name, licence, date, title, contact, url, partial; flags win over it.
        name: who gives the runs, as the board names them.
        licence: of records and pictures, one that allows to pass them on ("CC BY 4.0").
        date: on which they are given, YYYY-MM-DD; today (UTC) where it is left out.
        title: of the runs, as a heading.
        contact: address for questions, which will be public.
        url: of a paper, or of the method's code.
        partial: why a method lacks cases or seeds, where one does.
        predictions: put the reconstructions inside, so that others can score them.
        timeout: seconds that ffmpeg may take to make one film smaller.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    out: Path
    about: Path | None = None
    name: str = ""
    licence: str = ""
    date: str = ""
    title: str = ""
    contact: str = ""
    url: str = ""
    partial: str = ""
    predictions: bool = False
    timeout: float = 120.0


@dataclass(frozen=True, kw_only=True)
class VerifyOptions:
    """Flags of `leaderboard verify`.

    Attributes:
        bundle: the .zip file.
        data: folder of the data of its runs; without it nothing is scored again.
        dataset: whose folder that is, where the bundle has runs on several data sets.
        sample: how many runs are scored again, picked by chance; 0 for all.
        device: that scores: auto, cpu or cuda.
        rasterizer: auto, numba (CPU), triton or gsplat (CUDA), or reference.
        timeout: seconds that ffmpeg may take to read one film.
    """

    bundle: tyro.conf.Positional[Path]
    data: Path | None = None
    dataset: str = ""
    sample: int = 3
    device: str = "auto"
    rasterizer: str = "auto"
    timeout: float = 120.0


@dataclass(frozen=True, kw_only=True)
class AddOptions(VerifyOptions):
    """Flags of `leaderboard add`.

    Attributes:
        results: folder of results; the bundle's records go to a folder in it that has the bundle's name.
    """

    results: Path


def submit(arguments: list[str]) -> int:
    """Write a bundle."""
    options = parse_flags(SubmitOptions, arguments, prog="rewild4d-bench leaderboard submit", description=SUBMIT)
    check_timeout(options.timeout)
    if not options.runs:
        raise UserError("leaderboard submit: expected the folder of at least one run, got none.")
    if options.out.suffix != ".zip":
        raise UserError(f"--out {options.out}: expected the name of a .zip file.")
    about = _about(options)
    require_writable_file(options.out)
    from rewild4d.leaderboard.bundle import write_bundle
    from rewild4d.leaderboard.records import find_records
    from rewild4d.leaderboard.submission import assemble

    found = [pair for folder in options.runs for pair in find_records(folder)]
    if not found:
        raise UserError(f"{' '.join(map(str, options.runs))}: expected run records, found none.")
    with tempfile.TemporaryDirectory() as scratch:
        folder, packed = Path(scratch) / "files", Path(scratch) / options.out.name
        cases, remarks = _cases(found)
        made = assemble(found, folder, about, cases, predictions=options.predictions, timeout=options.timeout)
        write_bundle(folder, packed)
        bundle = _examined(packed, Path(scratch) / "again", options.timeout)
        if status := _print_findings(bundle, options.out):
            return status
        _moved(packed, options.out)
    for line in (*remarks, *made.remarks):
        print(line, file=sys.stderr)
    print(_described(bundle, options.out))
    return 0


def verify(arguments: list[str]) -> int:
    """Check a bundle."""
    options = parse_flags(VerifyOptions, arguments, prog="rewild4d-bench leaderboard verify", description=VERIFY)
    with tempfile.TemporaryDirectory() as scratch:
        return _print_verified(_verified(options, Path(scratch) / "files"))


def add(arguments: list[str]) -> int:
    """Check a bundle and put its records into a folder of results."""
    options = parse_flags(AddOptions, arguments, prog="rewild4d-bench leaderboard add", description=ADD)
    require_writable(options.results)
    from rewild4d.leaderboard.submission import keep

    with tempfile.TemporaryDirectory() as scratch:
        bundle = _verified(options, Path(scratch) / "files")
        if (status := _print_verified(bundle)) or bundle.submission is None:
            return status
        target = (options.results / options.bundle.stem).absolute()
        keep(bundle.folder, target, bundle.submission, len(bundle.rescored), options.timeout)
    print(f"added: {target}")
    return 0


def _about(options: SubmitOptions) -> About:
    """Combine flags and the TOML file.

    Raises:
        UserError: the file cannot be read or has other fields, or something needed is missing.
    """
    import msgspec

    from rewild4d.foreign.texts import read_toml
    from rewild4d.leaderboard.submission import About, require_about

    said: dict[str, Any] = {}
    if options.about is not None:
        said = read_toml(options.about, "who gives a result, in TOML", dict[str, str])
        if unknown := sorted({*said} - {*About.__struct_fields__}):
            known = ", ".join(About.__struct_fields__)
            raise UserError(f"{options.about}: expected only {known}, got '{unknown[0]}'.")
    said |= {name: text for name in About.__struct_fields__ if (text := getattr(options, name))}
    today = datetime.now(UTC).date().isoformat()
    return require_about(msgspec.convert({"name": "", "licence": "", "title": "", "date": today, **said}, About))


def _cases(found: list[Found]) -> tuple[dict[str, list[str]], list[str]]:
    """List all cases of the data of each protocol, where the data is still there; and say where it is not."""
    from rewild4d.evaluation.protocol import find_protocol
    from rewild4d.running.rescoring import reader_of

    cases: dict[str, list[str]] = {}
    remarks: list[str] = []
    records = dict(found)
    asked = {(one.dataset, one.protocol["name"], one.data.get("root", "")): run for run, one in found}
    for (dataset, name, _), run in sorted(asked.items()):
        try:
            listed = reader_of(run, records[run], None).cases(find_protocol(dataset, name).selection)
        except UserError as error:
            remarks.append(f"{name}: which cases its data have is not known here ({bounded(str(error)).rstrip('.')}).")
            continue
        cases[name] = sorted({*cases.get(name, ()), *listed})
    return cases, remarks


def _examined(path: Path, folder: Path, timeout: float) -> Bundle:
    """Unpack a bundle and look at all that needs no data."""
    from rewild4d.commands.verifying import examine, look_at_cases

    folder.mkdir(parents=True)
    bundle = examine(path, folder, timeout)
    look_at_cases(bundle, {})
    return bundle


def _verified(options: VerifyOptions, folder: Path) -> Bundle:
    """Unpack a bundle and look at all of it.

    Raises:
        UserError: it is no bundle; flags that cannot be.
    """
    check_timeout(options.timeout)
    if options.sample < 0:
        raise UserError(f"--sample: expected a number of at least 0, got {options.sample}.")
    if options.data is not None and not options.data.exists():
        raise UserError(f"--data {options.data}: expected the folder of the data, but there is none.")
    from rewild4d.commands import spot_checks
    from rewild4d.commands.verifying import examine, look_at_cases

    folder.mkdir()
    bundle = examine(options.bundle, folder, options.timeout)
    known: dict[str, list[str]] = {}
    if options.data is None:
        bundle.unverified.append("scores: none was computed again (--data names the data for it)")
    elif bundle.records:
        dataset, data = _dataset(bundle, options.dataset), options.data.absolute()
        runs, known = spot_checks.runs_here(bundle, data, dataset)
        spot_checks.score_some(bundle, runs, data, options.sample, options.device, options.rasterizer)
    look_at_cases(bundle, known)
    return bundle


def _dataset(bundle: Bundle, named: str) -> str:
    """Return the data set whose folder was named."""
    there = sorted({record.dataset for record in bundle.records.values()})
    if (named and named not in there) or (not named and len(there) > 1):
        raise UserError(f"--dataset: expected one of the data sets of the bundle ({', '.join(there)}), got '{named}'.")
    return named or there[0]


def _print_verified(bundle: Bundle) -> int:
    print(_described(bundle, bundle.path))
    for line in bundle.verified:
        print(f"verified: {line}")
    for line in bundle.unverified:
        print(f"not verified: {line}")
    return _print_findings(bundle, bundle.path)


def _print_findings(bundle: Bundle, path: Path) -> int:
    for finding in bundle.findings:
        print(f"rewild4d-bench: {path}: {bounded(finding)}", file=sys.stderr)
    return 2 if bundle.findings else 0


def _described(bundle: Bundle, path: Path) -> str:
    import hashlib

    from rewild4d.commands.verifying import counted

    size, digest = path.stat().st_size / 1e6, hashlib.sha256(path.read_bytes()).hexdigest()
    saved = sum(bool(bundle.predictions(run)) for run in bundle.records)
    runs = counted(len(bundle.records), "run")
    return f"{path}: {runs}, {saved} of them with predictions, {size:.1f} MB, SHA-256 {digest}"


def _moved(source: Path, target: Path) -> None:
    from rewild4d.files import atomic

    with atomic(target) as temporary:
        shutil.copyfile(source, temporary)
