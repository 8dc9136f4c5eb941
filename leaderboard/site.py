"""The leaderboard as a static page: records in, a folder of HTML out that needs no server and no network."""

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from rewild4d.errors import UserError
from rewild4d.files import regular_inside, replaced_folder
from rewild4d.leaderboard.cells import cell
from rewild4d.leaderboard.formats import ARROWS, html
from rewild4d.leaderboard.layout import Table
from rewild4d.leaderboard.media import FILMS, MOST_BYTES, TIMEOUT, link, publish, shrink
from rewild4d.leaderboard.records import FILE, RunRecord
from rewild4d.leaderboard.run_page import page_head, provenance_rows, score_rows, template
from rewild4d.leaderboard.tables import columns_of, standings
from rewild4d.leaderboard.variants import by_protocol, scores_of, variants

TITLE = "Reconstructing 4D animals from one video"
MARKER = ".rewild4d-leaderboard"
"""Lies in every folder that was built, so that only such a folder is ever replaced."""
CAPTIONS = {
    "comparison": "Input, render, and a view that was held out: truth and render. One row a moment.",
    "canonical": "Canonical Gaussians, coloured by the parts that move them.",
    "input film": "Input beside render, from the input view.",
    "orbit film": "One turn around the moving animal.",
    "orbit": "The animal from four sides.",
    "original film": "The filmed frame beside the render in its place.",
    "original": "The filmed frame beside the render in its place, at six moments.",
}
IN_SHORT = ("orbit.png", "original.png", "comparison.png", "canonical.png")
"""Which picture of a run stands small beside it: the first that it has."""
THUMBNAIL = "thumbnail.webp"
POLICY = (
    "default-src 'none'; img-src 'self'; media-src 'self'; style-src {style}; script-src {script}; base-uri 'none'; "
    "form-action 'none'"
)
"""Content-Security-Policy of every page: its own style and script, known by their digests, and files of its folder."""
REPORT = "report.html"
"""What `report` writes beside a record."""
Found = tuple[Path, RunRecord]


def tell(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr)


@dataclass(frozen=True)
class Part:
    """Records whose cases are averaged with each other: one folder of runs.

    Attributes:
        title: heading.
        found: records with the folders that hold them and their pictures.
        tables: named ones, shown above those of the protocols; each with those that belong to it behind it.
        given: whether somebody submitted them, so that the heading, which says who, is always shown.
    """

    title: str
    found: Sequence[Found]
    tables: Sequence[Sequence[Table]] = ()
    given: bool = False


@dataclass(frozen=True)
class Page:
    """What was copied for the page of a run.

    Attributes:
        pictures: for `run.html`.
        has_thumbnail: whether there is a small picture too.
        has_report: whether the page of its player was copied.
    """

    pictures: list[dict[str, Any]]
    has_thumbnail: bool
    has_report: bool


def build_site(
    parts: Sequence[Part],
    out: Path,
    say: Callable[[str], None] = tell,
    timeout: float = TIMEOUT,
    reports: bool = False,
) -> Path:
    """Write the page of all records; an older one in the same place is replaced once the new one is complete.

    Args:
        parts: of the first page, each with tables of its own.
        out: a folder that is not there, is empty, or was built before.
        say: called with a line for every picture that is left out, because it is none, is damaged or lies elsewhere.
        timeout: seconds that reading one film may take.
        reports: publish the `REPORT` beside a record too. It is a page with a script of its own and cannot be checked
            as a picture is, so only for folders of runs that come from no stranger.

    Returns:
        The path of its first page.

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    with replaced_folder(out, MARKER, "an earlier leaderboard") as building:
        _write([replace(part, found=_unique(part.found)) for part in parts], building, say, timeout, reports)
    return out / "index.html"


def _write(parts: Sequence[Part], folder: Path, say: Callable[[str], None], timeout: float, reports: bool) -> None:
    (folder / MARKER).touch()
    loader = jinja2.FunctionLoader(template)
    pages = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    assets = page_head(POLICY, template("style.css"), template("script.js"))
    found = _unique([pair for part in parts for pair in part.found])

    def fill(pair: Found) -> Page:
        source, record = pair
        page = folder / _place(record)
        page.mkdir(parents=True)
        regular_inside(source / FILE, source)
        shutil.copyfile(source / FILE, page / FILE)
        pictures = list(_copy_pictures(source, record, page, say, timeout))
        if small := next((name for name in IN_SHORT if (page / name).exists()), ""):
            shrink(page / small, page / THUMBNAIL)
        return Page(pictures, bool(small), _copy_report(source, page, say, reports))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            drawn = list(pool.map(fill, found))
        except BaseException:  # Ctrl-C does not wait for what has not begun
            pool.shutdown(cancel_futures=True)
            raise
    pages_of = {record.run_id: page for (_, record), page in zip(found, drawn, strict=True)}
    for _, record in found:
        page = pages_of[record.run_id]
        text = pages.get_template("run.html").render(
            title=f"{record.method} on {record.case}", record=record, scores=list(score_rows(record)),
            pictures=page.pictures, report=page.has_report, provenance=provenance_rows(record), **assets,
        )  # fmt: skip
        (folder / _place(record) / "index.html").write_text(text, encoding="utf-8")
    shown = [_part(part, f"{index}-" if len(parts) > 1 else "", pages_of) for index, part in enumerate(parts, 1)]
    text = pages.get_template("index.html").render(
        title=TITLE, counts=_counts(found), parts=shown, arrows=ARROWS, **assets
    )
    (folder / "index.html").write_text(text, encoding="utf-8")


def _part(part: Part, key: str, pages: Mapping[str, Page]) -> dict[str, Any]:
    """Fill in a folder of runs on the first page; ``key`` tells its tables from those of other parts."""
    records = [record for _, record in part.found]
    tables = [[_shown(table, key) for table in group] for group in part.tables]
    counts, sections = _counts(part.found), _sections(records, key, pages)
    return {"title": part.title, "given": part.given, "counts": counts, "tables": tables, "sections": sections}


def _shown(table: Table, key: str) -> dict[str, Any]:
    name = key + table.name
    return {"name": name, "title": table.title, "html": Markup(html(replace(table, name=name)))}


def _unique(found: Sequence[Found]) -> list[Found]:
    """Drop copies of a run."""
    return list({record.run_id: (source, record) for source, record in found}.values())


def _place(record: RunRecord) -> Path:
    """Return where a run's page lies; anybody may have written the record, so its id is checked first."""
    if not re.fullmatch(r"[0-9A-Za-z_-]{1,64}", record.run_id):
        raise UserError(f"expected a run id of letters and digits, got '{record.run_id}'.")
    return Path("runs") / record.run_id


def _counts(found: Sequence[Found]) -> str:
    cases, methods = len({record.case for _, record in found}), len({record.method for _, record in found})
    return f"{len(found)} runs of {methods} methods on {cases} cases."


def _sections(records: Sequence[RunRecord], key: str, pages: Mapping[str, Page]) -> list[dict[str, Any]]:
    """Fill in each protocol on the first page."""
    sections = []
    for group, table in zip(by_protocol(records), standings(records), strict=True):
        labels = {record.run_id: variant.label for variant in variants(group) for record in variant.records}
        scores = scores_of(group)
        sections.append({
            **_shown(table, key), "description": group[0].protocol.get("description", ""),
            "columns": columns_of(group, scores),
            "runs": [_run_row(record, labels[record.run_id], pages[record.run_id], scores) for record in group],
        })  # fmt: skip
    return sections


def _run_row(record: RunRecord, label: str, page: Page, scores: Sequence[str]) -> dict[str, Any]:
    place = _place(record).as_posix()
    return {
        "record": record, "label": label, "href": f"{place}/index.html",
        "thumbnail": f"{place}/{THUMBNAIL}" if page.has_thumbnail else "",
        "flags": [mark.partition(":")[0] for mark in record.marks],
        "cells": [cell([record], [record.case], name) for name in scores],
    }  # fmt: skip


def _copy_pictures(
    source: Path, record: RunRecord, page: Path, say: Callable[[str], None], timeout: float
) -> Iterator[dict[str, Any]]:
    """Copy the pictures that lie beside the record, the held-out comparison first."""
    order = list(CAPTIONS)
    stems = {Path(name).name: Path(name).stem + " film" * (Path(name).suffix == ".mp4") for name in record.pictures}
    names = sorted(stems, key=lambda name: order.index(stems[name]) if stems[name] in order else len(order))
    for name in filter(None, names):
        if not os.path.lexists(source / name):
            continue
        try:
            publish(source / name, source, page / name, timeout)
        except UserError as error:
            say(f"left out: {error}")
            continue
        is_film = name.lower().endswith(FILMS)
        yield {"href": link(name), "caption": CAPTIONS.get(stems[name], name), "video": is_film}


def _copy_report(source: Path, page: Path, say: Callable[[str], None], wanted: bool) -> bool:
    """Copy the page of a run that lies beside its record, and tell whether there is one now."""
    path = source / REPORT
    if not os.path.lexists(path):
        return False
    try:
        if not wanted:
            raise UserError(f"{path}: it has a script of its own; --reports publishes reports of runs that you trust.")
        regular_inside(path, source)
        if (size := path.stat().st_size) > MOST_BYTES:
            raise UserError(f"{path}: expected at most {MOST_BYTES >> 20} MiB, got {size >> 20} MiB.")
        shutil.copyfile(path, page / REPORT)
    except UserError as error:
        say(f"left out: {error}")
        return False
    return True
