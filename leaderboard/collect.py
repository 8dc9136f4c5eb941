"""Records as data for a repository: small, without paths, with the few pictures that a page needs."""

import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from PIL import Image

from rewild4d.errors import UserError
from rewild4d.files import regular_inside, replaced_folder
from rewild4d.foreign.texts import read_json
from rewild4d.leaderboard.curves import MOMENT, moments
from rewild4d.leaderboard.media import TIMEOUT, open_picture, publish, recode
from rewild4d.leaderboard.privacy import without_paths
from rewild4d.leaderboard.records import FILE, RunRecord
from rewild4d.leaderboard.variants import by_protocol, grouped, latest, variants
from rewild4d.metrics.score import Score

MARKER = "collection.json"
"""Lies in every collected folder: its title and what was done to the records."""
RUN_BYTES = 150_000
"""Most that the files of one run may take."""
PICTURE_WIDTH, VIDEO_WIDTH = 960, 320
SMALLER = ("-vf", f"scale='min({VIDEO_WIDTH},iw)':-2", "-c:v", "libx264", "-crf", "30", "-preset", "slow", "-pix_fmt",
           "yuv420p", "-threads", "1")  # fmt: skip
"""ffmpeg's options for a film of a few tens of kilobytes."""
HINT = "; --pictures all keeps them"
"""End of the remark on pictures that a licence keeps out."""
DIGITS = 4
"""Significant digits of the value of a single image; means are kept whole."""
NOTE = (
    "Absolute paths are cut to their last part. Values of single items have four significant digits; of the further "
    "seeds of a row the items are the means over the views of a moment. Means over all items are as they were measured."
)
_OPEN = re.compile(r"cc0|cc[ -]by(?![ -]n)|mit\b|apache|bsd|public domain", re.IGNORECASE)
Found = tuple[Path, RunRecord]


class _Titled(msgspec.Struct):
    """What `title_of` reads of a collection's own file."""

    title: str


@dataclass
class Collection:
    """What was collected.

    Attributes:
        out: the folder.
        runs: how many.
        pictured: how many of them with pictures.
        size: bytes of all files.
        remarks: what was left out and why, a sentence each.
    """

    out: Path
    runs: int = 0
    pictured: int = 0
    size: int = 0
    remarks: list[str] = field(default_factory=list)


def collect(
    found: Sequence[Found], out: Path, *, title: str, pictures: str = "open", limit: float, timeout: float = TIMEOUT
) -> Collection:
    """Write the records and the pictures of the first seed of every row; an earlier collection there is replaced.

    Args:
        found: records with the folders that hold them.
        out: a folder that is not there, is empty, or was collected before.
        title: heading of the page's part.
        pictures: "open" (of data that may be passed on), "all" or "none".
        limit: most bytes in all.
        timeout: seconds that reading and coding one film may take.

    Raises:
        UserError: the folder holds something else or cannot be written, the files are too large in all, or a picture or
            film is damaged or no regular file of its run's folder.
    """
    made = Collection(out)
    with replaced_folder(out, MARKER, "an earlier collection") as building:
        _write(found, building, pictures, made, timeout)
        about = {"title": title, "runs": made.runs, "with_pictures": made.pictured, "note": NOTE}
        (building / MARKER).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        made.size = sum(path.stat().st_size for path in building.rglob("*") if path.is_file())
        if made.size > limit:
            raise UserError(
                f"{out}: expected at most {limit / 1e6:.1f} MB in all, got {made.size / 1e6:.1f} MB of {made.runs} "
                "runs; raise --limit-mb, or leave pictures out with --pictures none."
            )
    return made


def title_of(folder: Path) -> str:
    """Read the title of a collected folder; of any other, return its name.

    Raises:
        UserError: the file that should hold the title does not.
    """
    path = folder / MARKER
    if not os.path.lexists(path):
        return folder.resolve().name
    regular_inside(path, folder)
    return read_json(path, "the title of a collection", _Titled).title


def _write(found: Sequence[Found], folder: Path, pictures: str, made: Collection, timeout: float) -> None:
    folders = {record.run_id: source for source, record in found}
    for group in by_protocol([record for _, record in found]):
        kept, remarks = latest(list({record.run_id: record for record in group}.values()))
        made.remarks += remarks
        first = _first_seeds(kept)
        for record in kept:
            source = folders[record.run_id]
            place = folder / _place(record)
            shown = record.run_id in first and _may_show(record, pictures, made)
            _write_run(source, record, place, record.run_id in first, shown, made, timeout)


def _write_run(
    source: Path, record: RunRecord, place: Path, whole: bool, shown: bool, made: Collection, timeout: float
) -> None:
    if place.exists():
        raise UserError(f"{source}: expected a run of its own, but there is another one called {place.name}.")
    place.mkdir(parents=True)
    names = []
    if shown:
        names = [name for name in (_picture(source, place), _video(source, place, timeout)) if name]
    small = rounded(without_paths(record) if whole else per_moment(without_paths(record)))
    text = compact(msgspec.structs.replace(small, pictures=names))
    while names and len(text.encode()) + sum((place / name).stat().st_size for name in names) > RUN_BYTES:
        (place / names[-1]).unlink()
        made.remarks.append(f"{place.name}: {names.pop()} left out, the run takes more than {RUN_BYTES / 1e3:.0f} kB.")
        text = compact(msgspec.structs.replace(small, pictures=names))
    (place / FILE).write_text(text, encoding="utf-8")
    made.runs += 1
    made.pictured += bool(names)


def is_open(licence: str) -> bool:
    """Tell whether a licence allows to pass things on."""
    return bool(_OPEN.match(licence))


def _place(record: RunRecord) -> Path:
    """Where a run lies in the collection, as the runner would put it; nothing in a record is taken for a path."""
    run = f"{record.method}-{record.preset}-seed{record.seed}-{record.run_id[:8]}"
    parts = (record.protocol["name"], record.case.replace("/", "__"), run)
    return Path(*(re.sub(r"[^\w@+-]", "_", part) for part in parts))


def _first_seeds(records: Sequence[RunRecord]) -> set[str]:
    """List the run ids of the lowest good seed of every case of every variant."""
    cases = [runs for variant in variants(records) for runs in grouped(variant.records, lambda r: r.case).values()]
    return {min(runs, key=lambda run: (run.status != "ok", run.seed)).run_id for runs in cases}


def _may_show(record: RunRecord, pictures: str, made: Collection) -> bool:
    licence = record.data.get("licence", "")
    if pictures != "open" or is_open(licence):
        return pictures != "none"
    remark = f"{record.case}: no pictures, because of its licence ('{licence}'){HINT}."
    if remark not in made.remarks:
        made.remarks.append(remark)
    return False


def _picture(source: Path, place: Path) -> str:
    """Save the comparison as a small WebP."""
    target, large = place / "comparison.webp", source / "comparison.png"
    if os.path.lexists(source / target.name):
        publish(source / target.name, source, target)
    elif os.path.lexists(large):
        regular_inside(large, source)
        image = open_picture(large, "PNG", large)
        scale = min(1.0, PICTURE_WIDTH / image.width)
        size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
        image.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(target, quality=75, method=6)
    return target.name if target.is_file() else ""


def _video(source: Path, place: Path, timeout: float) -> str:
    """Save the orbit as a small H.264 film; the images of one that is small already are copied."""
    film, target = source / "orbit.mp4", place / "orbit.mp4"
    if not os.path.lexists(film):
        return ""
    regular_inside(film, source)
    if film.stat().st_size <= RUN_BYTES // 3:
        publish(film, source, target, timeout)
    else:
        coded = place / "coded.mp4"
        recode(film, coded, SMALLER, timeout)
        publish(coded, place, target, timeout)  # so that a collection of a collection has the same bytes
        coded.unlink()
    return target.name


def compact(record: RunRecord) -> str:
    """Write the record as JSON, a line a field and a line a score: small, and differences can be read."""
    parts = msgspec.to_builtins(record)
    lines = [f"{json.dumps(name)}: {_line(value)}" for name, value in sorted(parts.items()) if name != "scores"]
    scores = ",\n".join(f"  {json.dumps(name)}: {_line(value)}" for name, value in sorted(parts["scores"].items()))
    body = ",\n".join([*lines, f'"scores": {{\n{scores}\n}}' if scores else '"scores": {}'])
    return f"{{\n{body}\n}}\n"


def _line(value: object) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def rounded(record: RunRecord) -> RunRecord:
    """Round the values of single items to `DIGITS` significant digits; means stay as they are."""

    def short(score: Score) -> Score:
        items = [None if value is None else float(f"{value:.{DIGITS}g}") for value in score.per_item]
        return msgspec.structs.replace(score, per_item=items)

    return msgspec.structs.replace(record, scores={name: short(score) for name, score in record.scores.items()})


def per_moment(record: RunRecord) -> RunRecord:
    """Average the values of single images over the views of each moment; the curve over time stays the same."""
    times = [float(found[1]) for found in map(MOMENT.search, record.items) if found]
    views = Counter(times)
    if len(times) < len(record.items) or len(views) == len(times):
        return record

    def mean(score: Score) -> Score:
        if len(score.per_item) != len(record.items):
            return score
        means = {time: sum(values) / len(values) for time, values in moments(score, record.items)}
        return msgspec.structs.replace(score, per_item=[means.get(time) for time in sorted(views)])

    items = [f"mean of {views[time]} views at {time:.4f} s" for time in sorted(views)]
    scores = {name: mean(score) for name, score in record.scores.items()}
    return msgspec.structs.replace(record, scores=scores, items=items)
