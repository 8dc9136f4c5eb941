"""Run records: one JSON file a run, strict to read, written atomically, traceable from any table cell."""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from rewild4d.contracts import Verdict
from rewild4d.errors import UserError, reason
from rewild4d.files import digest, regular_inside, write_text
from rewild4d.foreign.texts import read_json
from rewild4d.metrics.score import Distance, Score

SCHEMA = 1
FILE = "record.json"
MOST_BYTES = 64 << 20
"""Of a record's file."""


class Timing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that may differ between two runs with one seed on one machine."""

    started: str
    fit_seconds: float
    evaluate_seconds: float
    peak_memory_mib: float


class RunRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a run was and what it found.

    Attributes:
        schema: version of this layout.
        run_id: digest of all that decides the result: method, config, data, prior, protocol, seed, code, device.
        status: "ok" or "failed"; ``error`` then holds the message.
        config: every setting of the method, defaults included.
        data: digests of the clip and of the truth, and the folder they came from.
        prior: name, provenance, digest and the quality of its fit; what the run asked for ("choice", "config").
        protocol: name, digest and settings.
        coverage: what the numbers lean on (see rewild4d.evaluation.coverage).
        items: label of each held-out image, as in ``Score.per_item`` of image scores.
        distances: between sets of novel views and the input video, with all that decides their values.
        alignments: by which shapes were laid on the truth.
        networks: SHA-256 of the weights of the metric networks that scores leaned on.
        metrics: of each score that is another package's: its title, definition, package, version and a digest of the
            package's sources.
        verdicts: whether masks, prior and result can be trusted, and why; older records have none.
        features: SHA-256 of what `metrics.sets.FILE` beside the record holds: the features that ``distances`` were
            computed from, for scores pooled over cases; "" where there is no such file.
        diagnostics: what the method says of itself (Gaussians, joint motion, ...), and ``input_psnr_db``, the mean PSNR
            of the frames that it was shown, full frame, dB: a fit, not a score.
        marks: what a table has to say beside the numbers, such as "upper bound: ..."; such rows compete with nobody.
        pictures: files written beside the record, relative to it.
        machine: see `rewild4d.machine.machine`; records from before there was a choice do not name the rasterizer.
    """

    schema: int
    run_id: str
    method: str
    dataset: str
    case: str
    seed: int
    preset: str
    status: str
    error: str
    scores: dict[str, Score]
    coverage: dict[str, float]
    config: dict[str, Any]
    data: dict[str, str]
    prior: dict[str, Any]
    protocol: dict[str, Any]
    diagnostics: dict[str, Any]
    items: list[str]
    pictures: list[str]
    code: dict[str, str]
    machine: dict[str, str]
    timing: Timing
    marks: list[str] = []
    distances: list[Distance] = []
    alignments: list[dict[str, Any]] = []
    networks: dict[str, str] = {}
    features: str = ""
    verdicts: list[Verdict] = []
    metrics: dict[str, dict[str, str]] = {}


class _Protocol(msgspec.Struct):
    """What every table asks of a record's protocol; the rest is for people."""

    name: str
    title: str
    scores: list[str]
    floors: list[str] = []
    selection: dict[str, Any] = {}


class _Prior(msgspec.Struct):
    """What tables and `evaluate` ask of its prior."""

    name: str = ""
    choice: str = ""
    keypoints: str = "none"
    config: dict[str, Any] | None = None


class _Data(msgspec.Struct):
    """What `evaluate` and `export` ask of its data."""

    clip: str = ""
    truth: str = ""
    root: str = ""
    settings: str = "{}"


def make_run_id(**parts: Any) -> str:
    """Return sixteen hex digits of the SHA-256 over the JSON of all parts, in a fixed order."""
    return digest(msgspec.json.encode(parts, order="deterministic"))[:16]


def write_record(record: RunRecord, folder: Path) -> Path:
    """Write ``folder/record.json`` atomically and return its path."""
    path = folder / FILE
    write_text(path, to_json(record) + "\n")
    return path


def to_json(record: RunRecord) -> str:
    """Write the record as indented JSON.

    Raises:
        ValueError: a number that is not finite; the text says where.
    """
    if found := next(_not_finite(msgspec.to_builtins(record)), None):
        raise ValueError(f"expected finite numbers in the record of a run, got {found}")
    return msgspec.json.format(msgspec.json.encode(record, order="sorted"), indent=1).decode()


def read_record(path: Path) -> RunRecord:
    """Read one record file.

    Raises:
        UserError: missing, cannot be read, not JSON, or not of this schema.
    """
    with contextlib.suppress(OSError):
        if (size := path.stat().st_size) > MOST_BYTES:
            raise UserError(f"{path}: expected a run record of at most {MOST_BYTES >> 20} MiB, got {size >> 20} MiB.")
    record = read_json(path, f"a run record of schema {SCHEMA}", RunRecord)
    if record.schema != SCHEMA:
        raise UserError(f"{path}: expected a run record of schema {SCHEMA}, got schema {record.schema}.")
    for name, score in record.scores.items():
        if score.better not in ("higher", "lower", ""):
            raise UserError(
                f"{path}: expected 'higher', 'lower' or nothing in `scores`, got '{score.better[:50]}' of {name[:50]}."
            )
    for place, shape in (("protocol", _Protocol), ("prior", _Prior), ("data", _Data)):
        try:
            msgspec.convert(getattr(record, place), shape)
        except msgspec.ValidationError as error:
            raise UserError(f"{path}: expected the {place} of a run, but in `{place}`: {reason(error)}.") from error
    return record


def _not_finite(tree: Any, place: str = "") -> Iterator[str]:
    """Find numbers that JSON cannot hold, with their place: "nan at scores.psnr.value"."""
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from _not_finite(value, f"{place}.{name}" if place else str(name))
    elif isinstance(tree, list | tuple):
        for index, value in enumerate(tree):
            yield from _not_finite(value, f"{place}[{index}]")
    elif isinstance(tree, float) and not math.isfinite(tree):
        yield f"{tree} at {place}"


def find_records(folder: Path) -> list[tuple[Path, RunRecord]]:
    """Read all records below a folder, sorted by path, each with the folder that holds it.

    Raises:
        UserError: no such folder, or a record that cannot be read or is a link out of the folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: expected a folder of runs, but there is no such folder.")
    paths = sorted(folder.rglob(FILE))
    for path in paths:
        regular_inside(path, folder)
    return [(path.parent, read_record(path)) for path in paths]
