"""A data set: <root>/<animal>/<motion>/ with RGBA images and a cameras.json that says which of them are held out."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from PIL import Image

from rewild4d.contracts import Finding, Selection
from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.foreign.texts import read_json
from rewild4d.types import Camera, Clip, Frame, Truth


class Shot(msgspec.Struct, forbid_unknown_fields=True):
    """One image, as cameras.json has it: OpenCV axes, pixel centres at +0.5."""

    file: str
    time: float
    view: int
    held_out: bool
    world_to_camera: list[list[float]]
    intrinsics: list[list[float]]


class Example:
    """RGBA images with cameras (contracts.DatasetReader)."""

    title = "RGBA images with a cameras.json"
    licence = "CC0 1.0"

    def __init__(self, root: Path) -> None:
        self.root = root

    def cases(self, selection: Selection) -> list[str]:
        found = sorted(path.parent for path in self.root.glob("*/*/cameras.json"))
        if not found:
            raise UserError(f"{self.root}: expected <animal>/<motion>/cameras.json in this folder, found none.")
        return [folder.relative_to(self.root).as_posix() for folder in found]

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        shots = read_json(self.root / case / "cameras.json", "a list of images with cameras", list[Shot])
        frames = {held_out: [self._frame(case, shot, selection) for shot in shots if shot.held_out == held_out]
                  for held_out in (False, True)}  # fmt: skip
        keys = {held_out: digest(*(tensor for frame in found for tensor in (frame.rgb, frame.mask)))
                for held_out, found in frames.items()}  # fmt: skip
        clip = Clip(case, case.partition("/")[0], tuple(frames[False]), 10.0, self.licence, keys[False])
        return clip, Truth(frames[True], None, keys[True])

    def check(self) -> list[Finding]:
        selection: Any = Selection("sweep", 96)
        findings = []
        for case in self.cases(selection):
            try:
                self.load(case, selection)
                findings.append(Finding("ok", case, "can be read"))
            except UserError as error:
                findings.append(Finding("error", case, str(error)))
        return findings

    def _frame(self, case: str, shot: Shot, selection: Selection) -> Frame:
        path = self.root / case / shot.file
        try:
            pixels = np.asarray(Image.open(path).convert("RGBA"), dtype=np.float32) / 255
        except OSError as error:
            raise UserError(f"{path}: expected an image, but it cannot be read: {error}.") from error
        image = torch.from_numpy(pixels).permute(2, 0, 1)
        height, width = image.shape[1:]
        if max(height, width) != selection.size:
            raise UserError(f"{path}: expected an image of {selection.size} pixels, got {width}x{height}.")
        color, mask = image[:3], image[3:]
        matrix, intrinsics = (torch.tensor(m, dtype=torch.float64) for m in (shot.world_to_camera, shot.intrinsics))
        return Frame(shot.time, Camera(matrix, intrinsics, width, height), color * mask, mask, shot.view)
