"""Report of `score`: image scores, distances between sets, geometry; as one JSON file or a Markdown table."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from rewild4d.leaderboard.formats import plain
from rewild4d.metrics.score import Distance, Score

SCHEMA = 1
METRICS = {
    "psnr": "PSNR, dB", "ssim": "SSIM", "lpips_alex": "LPIPS-alex", "lpips_vgg": "LPIPS-vgg",
    "iou": "mask IoU", "dice": "mask Dice", "boundary_f": "boundary F",
}  # fmt: skip
REGIONS = {"": "full frame", "_fg": "foreground", "_union": "union", "_crop": "truth box"}
ARROWS = {"higher": "↑", "lower": "↓"}


class Report(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Inputs and results of a comparison.

    Attributes:
        schema: version of this layout.
        kind: of the inputs.
        inputs: the paths by flag.
        settings: background, fps, points, ...: all that decides the values.
        scores: by name, one value an image each; for geometry one value each.
        distances: between the two sets of images or clips.
        networks: name -> SHA-256 of the weights of every network used.
        items: label of each image, as in ``Score.per_item``.
        notes: how files were matched, and warnings.
        code: version and digest of the sources.
        machine: see `rewild4d.machine.machine`.
        seconds: duration.
    """

    schema: int
    kind: Literal["images", "clips", "geometry"]
    inputs: dict[str, str]
    settings: dict[str, str]
    scores: dict[str, Score]
    distances: list[Distance]
    networks: dict[str, str]
    items: list[str]
    notes: list[str]
    code: dict[str, str]
    machine: dict[str, str]
    seconds: float


def to_json(report: Report) -> str:
    """Write the report as indented JSON."""
    return msgspec.json.format(msgspec.json.encode(report, order="sorted"), indent=1).decode()


def markdown(report: Report) -> str:
    """Write the report as Markdown: tables of all values, then every note and every reason for a missing value."""
    parts = [_region_table(report.scores), _single_table(report.scores), _distance_table(report.distances)]
    settings = ", ".join(f"{name} {value}" for name, value in report.settings.items())
    lines = [f"- {plain(note)}" for note in [settings, *report.notes, *_notes(report)] if note]
    return "\n\n".join([part for part in parts if part] + (["\n".join(lines)] if lines else []))


def _region_table(scores: dict[str, Score]) -> str:
    """Write a table with metrics as rows, and the regions in which any has a value as columns."""
    found = {name for name, score in scores.items() if score.value is not None}
    rows = [metric for metric in METRICS if any(f"{metric}{region}" in scores for region in list(REGIONS)[1:])]
    regions = [region for region in REGIONS if any(f"{metric}{region}" in found for metric in rows)]
    table = [["", *(REGIONS[region] for region in regions), "images"]]
    for metric in rows:
        cells = [scores.get(f"{metric}{region}") for region in regions]
        counts = sorted({cell.count for cell in cells if cell and cell.count}, reverse=True)
        if counts:
            title = f"{METRICS[metric]} {ARROWS[next(cell.better for cell in cells if cell)]}"
            table.append([title, *map(_cell, cells), " / ".join(map(str, counts))])
    return _table(table)


def _single_table(scores: dict[str, Score]) -> str:
    """Write scores without regions, one a row."""
    regional = {f"{metric}{region}" for metric in METRICS for region in list(REGIONS)[1:]}
    regional |= {name.rpartition("_")[0] for name in regional if name in scores}
    table = [["", "value", "items"]]
    for name, score in scores.items():
        if name not in regional and score.value is not None:
            table.append([f"{METRICS.get(name, name)} {ARROWS[score.better]}", _cell(score), str(score.count)])
    return _table(table)


def _distance_table(distances: Sequence[Distance]) -> str:
    table = [["", "value", "95 % interval", "n", "m", "T", "estimator"]]
    for distance in distances:
        if distance.value is None:
            continue
        interval = " to ".join(_digits(end) for end in distance.interval) if distance.interval else ""
        frames = str(distance.frames) if distance.frames else ""
        table.append([
            f"{distance.name} ↓", _digits(distance.value), interval, str(distance.n), str(distance.m), frames,
            distance.estimator,
        ])  # fmt: skip
    return _table(table)


def _notes(report: Report) -> Iterator[str]:
    """Return every note once, after the names that it is about."""
    names: dict[str, list[str]] = defaultdict(list)
    for name, score in report.scores.items():
        names[score.note].append(_title(name))
    for distance in report.distances:
        for note in distance.note.split("; "):
            names[note].append(distance.name)
    for note, titles in names.items():
        if note:
            yield f"{', '.join(titles)}: {note}"


def _title(name: str) -> str:
    """Return a score's name in words."""
    for region, words in list(REGIONS.items())[1:]:
        if name.endswith(region) and name.removesuffix(region) in METRICS:
            return f"{METRICS[name.removesuffix(region)].split(',')[0]} {words}"
    return METRICS.get(name, name).split(",")[0]


def _cell(score: Score | None) -> str:
    if score is None or score.value is None:
        return ""
    return f"{score.value:.2f}" if score.unit == "dB" else f"{score.value:.4f}"


def _digits(value: float) -> str:
    """Format four significant digits, without an exponent from 0.0001 on."""
    digits = max(0, 3 - math.floor(math.log10(abs(value)))) if value else 1
    return f"{value:.{min(digits, 7)}f}"


def _table(rows: list[list[str]]) -> str:
    """Write a Markdown table, the first row being the head; nothing where there is only a head."""
    if len(rows) == 1:
        return ""
    ruler = ["---"] + ["---:"] * (len(rows[0]) - 1)
    return "\n".join("| " + " | ".join(row) + " |" for row in [rows[0], ruler, *rows[1:]])
