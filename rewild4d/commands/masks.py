"""`masks`: make masks of the animal for a video without masks."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rewild4d.commands.shared import check_timeout, open_dataset, require_writable
from rewild4d.config import parse_flags
from rewild4d.datasets.masking import DETECTOR, SEGMENTER
from rewild4d.errors import UserError, unknown_name
from rewild4d.foreign.programs import TIMEOUT

if TYPE_CHECKING:
    import torch

    from rewild4d.datasets.masking.makers import MaskMaker, Unmasked

DESCRIPTION = """Make masks of the animal. --tool track follows it offline from boxes, strokes or whole masks on any
frames, or from what stands out in the first one (a network of 4.5 MB: `weights fetch u2netp`). --tool program runs any
command that reads a folder of frames and writes a folder of masks; --tool grounded-sam2 uses Grounding DINO and SAM 2
(pip install -e '.[masks]'; their weights are on Hugging Face); --tool rough is GrabCut from a box, without any network
and inexact."""
TOOLS = ("track", "rough", "program", "grounded-sam2")


@dataclass(frozen=True)
class Options:
    """Flags of `masks`.

    Attributes:
        out: folder for the masks; of a data set with several cases one folder for each in it.
        tool: track, rough, program or grounded-sam2.
        video: a video file or a folder of frames.
        dataset: online, or aptv2, whose boxes are used.
        data: the data set's folder.
        case: names or patterns of cases; all where it is left out.
        start: time of the first frame that is used, seconds.
        end: time of the last frame that is used, seconds.
        fps: frames per second that are used.
        box: around the animal, in pixels: left,top,width,height in the first frame; more of them as frame:left,...
            with the film's number of the frame, as in the mask's name and on the sheet of `check`.
        marks: for track: folder of images named as the frames that you tell something about, green strokes on the
            animal and red ones beside it, or a mask in black and white; of a data set with several cases one folder for
            each in it.
        command: for program: a command line with {frames} and {masks} (and {boxes}) in it.
        timeout: for program: seconds that it may take; then it is killed with all that it started.
        text: for grounded-sam2: name of the animal, such as "dog".
        detector: for grounded-sam2: name or folder of a Grounding DINO model.
        segmenter: for grounded-sam2: name or folder of a SAM 2 model.
        device: auto, cpu or cuda.
        edit: draw and correct masks in a browser on this machine; --out holds what is there and what is saved.
        port: of this machine, for --edit; 0: any that is free.
    """

    out: Path
    tool: str = "track"
    video: Path | None = None
    dataset: str = "online"
    data: Path | None = None
    case: tuple[str, ...] = ()
    start: float | None = None
    end: float | None = None
    fps: float | None = None
    box: tuple[str, ...] = ()
    marks: Path | None = None
    command: str | None = None
    timeout: float = TIMEOUT
    text: str = "animal"
    detector: str = DETECTOR
    segmenter: str = SEGMENTER
    device: str = "auto"
    edit: bool = False
    port: int = 0


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench masks", description=DESCRIPTION)
    check_timeout(options.timeout)
    if options.edit:
        return edit(options)
    from rewild4d.datasets.masking.makers import write_masks
    from rewild4d.datasets.masking.masks import list_images
    from rewild4d.datasets.video.mask_check import SPLIT
    from rewild4d.machine import pick_device
    from rewild4d.progress import Progress
    from rewild4d.running.runner import choose_cases

    if options.marks is not None and options.tool != "track":
        raise UserError(f"--marks: only --tool track takes marks, got --tool {options.tool}.")
    device = pick_device(options.device)
    maker = make_maker(options, device)
    reader: Any = open_dataset(options.dataset, options.data, options)[1]
    if not hasattr(reader, "unmasked"):
        raise UserError(f"--dataset: expected online or aptv2, got '{options.dataset}'.")
    is_one = options.dataset == "online"
    cases = (reader.name,) if is_one else choose_cases(reader.cases(SPLIT), options.case)
    require_writable(options.out)
    for case in cases:
        source = told(reader.unmasked(case), options, None if is_one else case)
        folder = options.out if is_one else options.out / case
        progress = Progress(f"{folder}: masks")
        try:
            paths, empty = write_masks(source, maker, folder, progress)
        finally:
            progress.close()
        print(f"{folder}: {len(paths)} masks by '{options.tool}', {empty} of them without the animal")
        if older := set(list_images(folder)) - set(paths):
            print(f"{folder}: it holds {len(older)} other masks, which readers take too: remove them?", file=sys.stderr)
    print("check the masks before use: rewild4d-bench check with --masks draws a contact sheet", file=sys.stderr)
    return 0


def told(source: Unmasked, options: Options, case: str | None = None) -> Unmasked:
    """Return frames with the boxes and marks that the flags give.

    Args:
        source: the frames.
        options: flags of the command.
        case: of a data set with several, whose marks lie in a folder of its name and may be missing.

    Raises:
        UserError: boxes or marks that cannot be used.
    """
    from rewild4d.datasets.masking.makers import parse_boxes
    from rewild4d.datasets.masking.marks import read_marks

    if options.box:
        source = replace(source, boxes=parse_boxes(options.box, source.stems))
    folder = None if options.marks is None else options.marks / (case or "")
    if folder is not None and (case is None or folder.is_dir()):
        source = replace(source, marks=read_marks(folder, source.stems, source.size))
    return source


def edit(options: Options) -> int:
    """Serve the editor of one film until it is done.

    Raises:
        UserError: other flags than it takes, or a film, masks or a port that cannot be used.
    """
    if options.tool != "track":
        raise UserError(f"--edit: expected --tool track, which it follows with, got {options.tool}.")
    if options.dataset != "online":
        raise UserError(f"--edit: expected --video FILE, got --dataset {options.dataset}.")
    from rewild4d.datasets.masking.editor.app import open_editor, serve
    from rewild4d.datasets.masking.editor.server import Server
    from rewild4d.datasets.masking.tracking import track_masks

    reader: Any = open_dataset(options.dataset, options.data, options)[1]
    source = told(reader.unmasked(reader.name), options)
    require_writable(options.out)
    with Server(options.port) as server:
        serve(server, open_editor(source, options.out, track_masks, _check_command(options)))
    return 0


def _check_command(options: Options) -> str:
    """Return the command that checks the masks of the same frames."""
    words = ["rewild4d-bench", "check", "--dataset", "online", "--video", options.data or options.video]
    words += ["--masks", options.out]
    for flag in ("start", "end", "fps"):
        if (value := getattr(options, flag)) is not None:
            words += [f"--{flag}", f"{value:g}"]
    return shlex.join(map(str, words))


def make_maker(options: Options, device: torch.device) -> MaskMaker:
    """Return the maker that `--tool` names.

    Raises:
        UserError: an unknown tool, or one that lacks a command or a package.
    """
    from rewild4d.datasets.masking.grabcut import rough_masks
    from rewild4d.datasets.masking.grounded_sam import grounded_masks
    from rewild4d.datasets.masking.makers import run_program
    from rewild4d.datasets.masking.tracking import track_masks

    if options.tool not in TOOLS:
        raise unknown_name("tool", options.tool, TOOLS)
    if options.tool == "program":
        if not options.command:
            raise UserError("--command: expected a command line with {frames} and {masks} in it, got none.")
        return run_program(options.command, options.timeout)
    if options.tool == "grounded-sam2":
        return grounded_masks(options.text, options.detector, options.segmenter, device)
    return rough_masks if options.tool == "rough" else track_masks
