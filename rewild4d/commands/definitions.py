"""`definitions`: score one saved run by the definitions of several papers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rewild4d.config import parse_flags
from rewild4d.errors import UserError, unknown_name

if TYPE_CHECKING:
    from rewild4d.leaderboard.layout import Table
    from rewild4d.metrics.score import Score
    from rewild4d.running.opening import OpenedRun
    from rewild4d.types import Frame

DESCRIPTION = """Score one saved run as Animal-in-Motion, 4DEquine, Animal Avatars and 4D-Animal define their numbers.
Two tables have a row for each paper and a column for each quantity; the prediction and the frames are the same in every
row, so what differs is the definition. Nothing is written, and the run's record stays as it is."""


@dataclass(frozen=True)
class Options:
    """Flags of `definitions`.

    Attributes:
        run: folder of a single run, with a record.json and a reconstruction.
        data: folder of the data, where it has moved since the fit.
        frames: all, as Animal-in-Motion and 4DEquine score them (those that the method was shown too), or held-out.
        mapping: of the data set's keypoints to the template's bones: aptv2, badja, superanimal-quadruped or a .toml
            file; the data set's own where it is left out.
        keypoints: no images, which take most of the time.
        format: md, latex, html or csv (one line a figure, for programs).
        json: print all scores with their definitions as JSON, and nothing else.
        device: auto, cpu or cuda.
        rasterizer: what renders: auto, numba (CPU), triton or gsplat (CUDA), or reference.
    """

    run: Annotated[tuple[Path, ...], tyro.conf.Positional]
    data: Path | None = None
    frames: Literal["all", "held-out"] = "all"
    mapping: str | None = None
    keypoints: bool = False
    format: str = "md"
    json: bool = False
    device: str = "auto"
    rasterizer: str = "auto"


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench definitions", description=DESCRIPTION)
    if len(options.run) != 1:
        raise UserError(f"definitions: expected the folder of one run, got {len(options.run)} of them.")
    from rewild4d.leaderboard.formats import FORMATS

    if options.format not in FORMATS:
        raise unknown_name("format", options.format, FORMATS)
    scores, found = _scored(options)
    print(_as_json(scores) if options.json else "\n\n".join(FORMATS[options.format](table) for table in found))
    return 0


def _scored(options: Options) -> tuple[dict[str, Score], list[Table]]:
    """Open the run and score it; the tables have no images where only keypoints were asked for."""
    from rewild4d.evaluation.definitions import joint_scores, picture_scores, tables
    from rewild4d.evaluation.networks import load_networks
    from rewild4d.evaluation.placing import scale_of
    from rewild4d.machine import pick_device
    from rewild4d.priors.landmarks import load_mapping
    from rewild4d.progress import Progress
    from rewild4d.rasterizer import pick_rasterizer
    from rewild4d.registry import load_dataset
    from rewild4d.running.opening import open_run
    from rewild4d.running.workers import share_cores, this_process

    device = pick_device(options.device)
    given = load_mapping(options.mapping) if options.mapping else None
    with this_process(share_cores(1, 1, device), pick_rasterizer(options.rasterizer, device)):
        run = open_run(options.run[0], options.data, device)
        known = getattr(load_dataset(run.record.dataset), "keypoint_mapping", None)
        mapping = given if given is not None else load_mapping(known) if known else {}
        frames = _frames(run, options.frames)
        scores = joint_scores(run.reconstruction, frames, mapping)
        if not options.keypoints:
            progress = Progress("images")
            networks = load_networks(("lpips-alex", "lpips-vgg"), device)
            placement = scale_of(run.record.alignments)
            scores |= picture_scores(run.reconstruction, frames, networks, progress, placement)
            progress.close()
    record = run.record
    title = f"{record.method} ({record.preset}, seed {record.seed}) on {record.dataset} {record.case}"
    return scores, tables(scores, title, _remarks(run, frames))


def _frames(run: OpenedRun, which: str) -> list[Frame]:
    """Return the frames to score in the order of time, each once."""
    held_out = list(run.truth.held_out)
    if which == "held-out" and not held_out:
        raise UserError(f"{run.folder}: expected held-out frames, its protocol has none: leave --frames out.")
    chosen = held_out if which == "held-out" else [*run.clip.frames, *held_out]
    return [frame for _, frame in sorted({(frame.time, frame.view): frame for frame in chosen}.items())]


def _shown(run: OpenedRun, frames: Sequence[Frame]) -> int:
    """Return how many of the frames the method was shown: the opened clip of a video holds its held-out frames too."""
    held_out = len(run.truth.held_out)
    merged = all(frame.crop is not None for frame in run.clip.frames)
    shown = len(run.clip.frames) - (held_out if merged else 0)
    everything = len({(frame.time, frame.view) for frame in [*run.clip.frames, *run.truth.held_out]})
    return shown if len(frames) == everything else shown + held_out - everything


def _remarks(run: OpenedRun, frames: Sequence[Frame]) -> list[str]:
    sizes = sorted({f"{frame.mask.shape[2]}x{frame.mask.shape[1]}" for frame in frames})
    filmed = all(frame.crop is not None for frame in frames)
    cut = (
        "squares that follow the animal, where papers may score whole frames" if filmed else "as the protocol has them"
    )
    return [
        f"{len(frames)} frames of {' and '.join(sizes)} pixels, {cut}; {_shown(run, frames)} were shown to the method.",
        f"Data as protocol {run.record.protocol['name']} reads them. PCK, KT, IoU and SSIM are shares, which papers "
        "may print times 100.",
    ]


def _as_json(scores: dict[str, Score]) -> str:
    import msgspec

    from rewild4d.metrics.definitions import definition

    rows = [
        {"name": name, **msgspec.to_builtins(score), "rule": definition(name).rule, "source": definition(name).source}
        for name, score in scores.items()
    ]
    return msgspec.json.format(msgspec.json.encode(rows), indent=1).decode()
