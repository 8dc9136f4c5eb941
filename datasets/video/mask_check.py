"""What `check` says of masks: holes, jumps, empty frames, more than one part, and a picture of all that.

Nothing here changes a mask. A person looks at the contact sheet and decides.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from rewild4d.contracts import Finding, Selection
from rewild4d.datasets.masking.facts import FRAMED, MaskFacts, jumps, mask_facts
from rewild4d.datasets.masking.trust import MaskTrust
from rewild4d.datasets.video.wild import LEAST_AREA, TWIN, Video, lay_out
from rewild4d.errors import UserError
from rewild4d.files import atomic

HOLES = 0.01
"""Share of the animal that may be enclosed background."""
PART = 0.02
"""A second part above this share of the largest is told."""
SHEET_FRAMES = 24
TILE = 240
MOST_CASES = 12
"""Contact sheets are drawn, and files decoded, for no more cases than these where none is named."""
SPLIT = Selection(cameras="unknown", size=256, framing="crop", split=5)
"""The split of the protocols, to see whether enough frames remain."""


def check_video(video: Video, sheets: Path | None) -> list[Finding]:
    """Return findings on one video, first whether its masks can be trusted.

    Its contact sheet goes to ``sheets``/<case>.png.

    Raises:
        UserError: files that cannot be read.
    """
    count = len(video.moments)
    shown = set(np.linspace(0, count - 1, min(count, SHEET_FRAMES)).round().astype(int).tolist())
    facts: list[MaskFacts | None] = []
    trust = MaskTrust(count)
    tiles: dict[int, np.ndarray] = {}
    for index, (image, mask) in enumerate(zip(video.images(), video.masks(), strict=False)):
        facts.append(mask_facts(mask) if mask is not None else None)
        trust.add(index, image, mask)
        if index in shown:
            tiles[index] = tile(image, mask)
    if len(facts) < count:
        raise UserError(f"{video.title}: expected {count} frames, got {len(facts)}: it is cut off.")
    found = {what: [i for i, fact in enumerate(facts) if test(fact or _NO_MASK)] for what, test in _TESTS.items()}
    troubles = found | {"a jump from the frame before": jumps(facts)}
    verdict = trust.verdict([moment.label for moment in video.moments])
    findings = [Finding("ok" if verdict.level == "green" else "warning", video.name, str(verdict))]
    findings += [Finding("warning", video.name, note) for note in video.notes]
    for what, indices in troubles.items():
        if indices:
            told = f"{what} in {len(indices)} of {count} frames: {_names(video, indices)}"
            findings.append(Finding("warning", video.name, told))
    if troubles[_SECOND] or troubles[_TWO]:
        told = "where other parts are not the animal, --parts main keeps to its own (see the contact sheet)"
        findings.append(Finding("warning", video.name, told))
    findings += _usable(video, facts)
    if sheets is not None:
        marked = {index for indices in troubles.values() for index in indices}
        path = sheets / f"{video.name.replace('/', '__')}.png"
        _save(path, contact_sheet(tiles, [moment.label for moment in video.moments], marked))
        findings.append(Finding("ok", video.name, f"contact sheet: {path}"))
    return findings


def _usable(video: Video, facts: Sequence[MaskFacts | None]) -> list[Finding]:
    """Return how many frames there are and, where they are chosen here, how many to learn from and to test."""
    said = f"{len(video.moments)} frames of {video.size[0]}x{video.size[1]} at {video.fps:.4g} a second"
    if video.is_placed:
        return [Finding("ok", video.name, said)]
    try:
        layout = lay_out(video, facts, SPLIT)
    except UserError as error:
        return [finding_of(error)]
    train = layout.tested.count(False)
    told = Finding("ok", video.name, f"{said}: {train} to learn from, {len(layout.used) - train} to test")
    return [*(Finding("warning", video.name, note) for note in layout.notes), told]


def finding_of(error: UserError) -> Finding:
    """Return an error as a finding."""
    path, _, sentence = str(error).partition(": ")
    return Finding("error", path, sentence.rstrip("."))


_SECOND, _TWO = "a second part beside the animal", "two parts of like size (two animals?)"
_NO_MASK = MaskFacts(None, False, (), 0.0)
_TESTS: dict[str, Callable[[MaskFacts], bool]] = {
    "no mask or an empty one": lambda fact: fact.area < LEAST_AREA,
    "animal all along the image's border (is the mask inverted?)": lambda fact: fact.framed > FRAMED,
    f"holes (or gaps between legs) above {HOLES:.0%} of the animal": lambda fact: fact.holes > HOLES,
    _SECOND: lambda fact: PART < fact.second <= TWIN,
    _TWO: lambda fact: fact.second > TWIN,
}


def _names(video: Video, indices: Sequence[int]) -> str:
    return ", ".join(video.moments[i].label for i in indices[:6]) + (", ..." if len(indices) > 6 else "")


def tile(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return a small picture of a frame with its mask tinted and outlined, uint8 [h, TILE, 3]."""
    scale = TILE / image.shape[1]
    size = (TILE, max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if mask is None:
        return (small * 0.4).astype(np.uint8)
    matte = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)[..., None].astype(np.float32) / 255
    tinted = small * (0.45 + 0.2 * matte) + matte * np.array((10.0, 90.0, 10.0), dtype=np.float32)
    drawn = np.clip(tinted, 0, 255).astype(np.uint8)
    outlines, _ = cv2.findContours((matte[..., 0] > 0.5).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outlines, -1, (80, 255, 80), 1, cv2.LINE_AA)
    return drawn


def contact_sheet(tiles: dict[int, np.ndarray], labels: Sequence[str], marked: set[int]) -> np.ndarray:
    """Return tiles in reading order under their labels, in red where a warning names them, uint8 [H, W, 3]."""
    cells = []
    for index, picture in tiles.items():
        strip = np.full((18, picture.shape[1], 3), 255, np.uint8)
        color = (200, 0, 0) if index in marked else (40, 40, 40)
        cv2.putText(strip, labels[index], (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
        cells.append(np.concatenate((strip, picture)))
    columns = min(6, len(cells))
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    rows = [np.concatenate(cells[i : i + columns], axis=1) for i in range(0, len(cells), columns)]
    return np.concatenate(rows)


def _save(path: Path, image: np.ndarray) -> None:
    with atomic(path) as temporary:
        cv2.imwrite(str(temporary), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
