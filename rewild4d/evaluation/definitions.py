"""Score one prediction by every paper's definitions, so that a reader sees how far definitions alone move a number."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from rewild4d.cameras.input_view import finite_at, input_camera
from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.cameras.rendering import render
from rewild4d.contracts import Log, Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation.film_keypoints import (
    Annotated,
    Part,
    annotated,
    mapped,
    score_keypoints,
    score_transfer,
    threshold_of,
    without,
)
from rewild4d.evaluation.film_pictures import Drawn, score_pictures
from rewild4d.evaluation.joints import NotThere, joint_tracks, point_tracks
from rewild4d.evaluation.networks import Networks
from rewild4d.leaderboard.layout import Cell, Column, Row, Table
from rewild4d.metrics.definitions import KEYPOINT_SOURCES, KEYPOINTS, PICTURES, TRANSFER, definition
from rewild4d.metrics.score import Score
from rewild4d.priors.landmarks import load_mapping
from rewild4d.registry import load_dataset
from rewild4d.types import Frame

Scores = dict[str, Score]


class Line(NamedTuple):
    """A row of a table: a paper's own definitions.

    Attributes:
        title: of the paper.
        scores: names, at most one for each quantity.
        source: where its keypoints come from, one of `KEYPOINT_SOURCES`, or "".
    """

    title: str
    scores: tuple[str, ...]
    source: str = ""


_AIM = ("pck@0.05_mask_area", "pck@0.1_mask_area", "mpjve")
_EQUINE = ("pck@0.05_crop", "pck@0.1_crop", "pck@0.15_crop")
_BOX = ("pck@0.05_box", "pck@0.1_box", "pck@0.15_box")
JOINT_LINES = (
    Line("Animal-in-Motion", (*_AIM, *TRANSFER), "map_test_frames"),
    Line("Animal-in-Motion", (*_AIM, *TRANSFER), "map_other_half"),
    Line("Animal-in-Motion", (*_AIM, *TRANSFER), "bones"),
    Line("4DEquine, motion", (*_EQUINE, "accel_at_30fps"), "map_other_half"),
    Line("4DEquine, motion", (*_EQUINE, "accel_at_30fps"), "bones"),
    Line("the same, true frame rate", ("accel",), "bones"),
    Line("box of the mask", _BOX, "map_other_half"),
    Line("box of the mask", _BOX, "bones"),
)
_AVATARS = ("iou@0.7", "psnr_black", "psnrm", "lpips_vgg_black")
PICTURE_LINES = (
    Line("rewild4d", ("iou", "psnr_white", "ssim", "lpips_alex")),
    Line("Animal-in-Motion", ("iou_pooled",)),
    Line("Animal Avatars", _AVATARS),
    Line("4D-Animal", (*_AVATARS, "iou@0.7_worst5", "psnr_black_worst5")),
    Line(
        "4DEquine, appearance",
        ("psnr_pooled_white_brightness", "ssim_reflected_brightness", "lpips_alex_unscaled_brightness"),
    ),
    Line("the same, brightness as drawn", ("psnr_pooled_white", "ssim_reflected", "lpips_alex_unscaled")),
)
SOURCES = {"bones": "bones", "map_other_half": "map, other half", "map_test_frames": "map, TEST frames"}
"""Short words for the sources of keypoints."""


def film_scores(
    reconstruction: Reconstruction,
    frames: Sequence[Frame],
    dataset: str,
    networks: Networks,
    log: Log,
    asked: Sequence[str],
) -> Scores:
    """Compute the scores of `metrics.names.FILM` that a protocol asks for.

    Args:
        reconstruction: of the film.
        frames: that are scored, in any order.
        dataset: whose reader says which keypoint is which landmark.
        networks: of LPIPS.
        log: progress.
        asked: names.
    """
    scores: Scores = {}
    if any(name not in PICTURES for name in asked):
        ordered = sorted(frames, key=lambda frame: (frame.time, frame.view))
        mapping = getattr(load_dataset(dataset), "keypoint_mapping", None)
        scores |= joint_scores(reconstruction, ordered, load_mapping(mapping) if mapping else {})
    if any(name in PICTURES for name in asked):
        scores |= picture_scores(reconstruction, frames, networks, log)
    return {name: scores[name] for name in asked}


def joint_scores(reconstruction: Reconstruction, frames: Sequence[Frame], mapping: Mapping[str, str]) -> Scores:
    """Score the keypoints of a film from each source under each definition; what lacks data says so.

    Args:
        reconstruction: of the film.
        frames: square images of one size in the order of time, with the data set's keypoints.
        mapping: keypoint -> landmark of the template (`priors.landmarks.load_mapping`); others do not count.

    Raises:
        UserError: images of other sizes, or a reconstruction that holds a NaN.
    """
    names = next((frame.keypoints.names for frame in frames if frame.keypoints is not None), ())
    truth = annotated(frames, [name for name in names if name in mapping]) if names else None
    if truth is None or not len(truth.rows):
        return _nothing("these frames have no keypoints" if not names else "no keypoint of these frames is known")
    scores = _from_bones(reconstruction, frames, truth, mapping)
    shown = [frames[row] for row in truth.rows]
    try:
        tracks = point_tracks(reconstruction, shown)
    except NotThere as why:
        return _nothing(str(why)) | scores
    scores |= score_transfer(truth, tracks.points, tracks.seen[0])
    for source in ("map_other_half", "map_test_frames"):
        try:
            parts = mapped(truth, tracks.points, halves=source == "map_other_half")
        except ValueError as why:
            scores |= _absent(source, str(why))
        else:
            scores |= score_keypoints(truth, parts, source)
    return scores


def picture_scores(
    reconstruction: Reconstruction,
    frames: Sequence[Frame],
    networks: Networks,
    log: Log,
    placement: Placement = IDENTITY,
) -> Scores:
    """Score the images of a reconstruction under each definition.

    Args:
        reconstruction: to draw.
        frames: with true images and masks; cameras are their own or the reconstruction's.
        networks: of LPIPS.
        log: progress.
        placement: by which it is drawn.

    Raises:
        UserError: no camera, or a reconstruction that holds a NaN.
    """
    drawn = LazyDrawn(len(frames), lambda index: _draw(reconstruction, frames[index], placement))
    return score_pictures(drawn, networks.lpips, networks.missing, log)


def tables(scores: Mapping[str, Score], title: str, remarks: Sequence[str]) -> list[Table]:
    """Lay out the tables: a row for each paper, a column for each quantity, the definition in a numbered note.

    Args:
        scores: of `joint_scores` and `picture_scores`; without the latter there is no table of images.
        title: what was scored.
        remarks: sentences below each table.
    """
    caption = "one prediction, the same frames in every row; nothing is ranked"
    found = []
    for kind, lines in (("keypoints", JOINT_LINES), ("images", PICTURE_LINES)):
        if not all(_full(name, line) in scores for line in lines for name in line.scores):
            continue
        columns = _columns(lines)
        rows = tuple(_row(line, columns, scores) for line in lines)
        stubs = ("definition", "keypoints from") if kind == "keypoints" else ("definition",)
        name = f"definitions-{kind}"
        found.append(Table(name, f"{title}: {kind}", caption, stubs, tuple(columns), rows, tuple(remarks)))
    return found


@dataclass(frozen=True)
class LazyDrawn(Sequence[Drawn]):
    """Frames that are drawn when they are asked for."""

    length: int
    draw: Callable[[int], Drawn]

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Drawn:  # type: ignore[override]
        return self.draw(range(self.length)[index])


def _draw(reconstruction: Reconstruction, frame: Frame, placement: Placement) -> Drawn:
    splats, camera = finite_at(reconstruction, frame.time), input_camera(reconstruction, frame)
    if camera is None and len(splats):
        raise UserError(
            f"the frame at {frame.time:.4f} s needs a camera, but neither the data nor the method knows it."
        )
    nothing = torch.zeros_like(frame.rgb), torch.zeros_like(frame.mask)
    return Drawn(*(nothing if camera is None else render(splats, placement.camera(camera))), frame.rgb, frame.mask)


def _from_bones(
    reconstruction: Reconstruction, frames: Sequence[Frame], truth: Annotated, mapping: Mapping[str, str]
) -> Scores:
    try:
        tracks = joint_tracks(reconstruction, mapping, truth.names, frames)
    except NotThere as why:
        return _absent("bones", str(why))
    everything = Part(np.arange(len(frames)), tracks.points, np.ones(len(truth.names), dtype=bool))
    return score_keypoints(truth, [everything], "bones")


def _nothing(reason: str) -> Scores:
    scores = {name: without(name, reason) for name in TRANSFER}
    for source in KEYPOINT_SOURCES:
        scores |= _absent(source, reason)
    return scores


def _absent(source: str, reason: str) -> Scores:
    return {f"{name}_{source}": without(name, reason) for name in KEYPOINTS}


def _columns(lines: Sequence[Line]) -> list[Column]:
    """Return a column for each quantity of some lines, PCK first, by its thresholds."""
    found = {one.quantity: one for line in lines for one in (definition(_full(name, line)) for name in line.scores)}
    threshold = {quantity: threshold_of(quantity) for quantity in found if quantity.startswith("PCK")}
    order = sorted(found, key=lambda quantity: threshold.get(quantity, 1.0))
    units = {quantity: f", {one.unit}" if one.unit != "1" else "" for quantity, one in found.items()}
    return [Column(quantity + units[quantity], found[quantity].better, score=quantity) for quantity in order]


def _row(line: Line, columns: Sequence[Column], scores: Mapping[str, Score]) -> Row:
    by_quantity = {definition(_full(name, line)).quantity: _full(name, line) for name in line.scores}
    cells = [
        _cell(by_quantity[column.score], scores) if column.score in by_quantity else Cell("") for column in columns
    ]
    stubs = (line.title, SOURCES[line.source]) if line.source else (line.title,)
    notes = {
        scores[name].note for name in by_quantity.values() if name not in TRANSFER and scores[name].value is not None
    }
    return Row(stubs, tuple(cells), "unranked", tuple(sorted(note for note in notes if note)))


def _full(name: str, line: Line) -> str:
    return f"{name}_{line.source}" if name in KEYPOINTS else name


def _cell(name: str, scores: Mapping[str, Score]) -> Cell:
    score, defined = scores[name], definition(name)
    if score.value is None:
        return Cell("n/a", note=f"{defined.quantity.partition('@')[0]} {score.note}")
    digits = {"dB": 2, "sides/s²": 1}.get(score.unit, 4 if "step" in score.unit else 3)
    return Cell(f"{score.value:.{digits}f}", note=f"{defined.rule} ({defined.source})", value=score.value)
