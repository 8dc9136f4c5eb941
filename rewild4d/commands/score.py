"""`score`: compute metrics of any results, made by any program."""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rewild4d.commands.shared import require_writable_file
from rewild4d.config import parse_flags
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import write_text

if TYPE_CHECKING:
    from rewild4d.evaluation.reports import Report
    from rewild4d.metrics.samples import Progress as ShowProgress

DESCRIPTION = """Score a folder of images or clips, or a .ply file, against the truth. Images are matched by file name,
clips (subfolders of frames, or videos) by their own; nothing is resized or cropped."""


@dataclass(frozen=True)
class Options:
    """Flags of `score`.

    Attributes:
        pred: folder of images, folder of clips, a video, or a .ply file.
        truth: the same of the truth.
        masks: true masks (white inside), laid out like --truth; the alpha of the truths where it is left out.
        pred_masks: predicted masks, laid out like --truth; the alpha of the predictions where it is left out.
        background: grey level from 0 (black) to 1 (white) behind images that have alpha; alpha is taken as straight.
        pair: by name, or in sorted order where predictions and truths share no name: name or order.
        unpaired: the predictions are of other views than the truths: only KID, FVD and KVD.
        only: what to compute: psnr ssim lpips-alex lpips-vgg silhouette kid fvd; all where it is left out.
        fps: of clips whose files do not name it, for the record.
        up: axis that points up in both .ply files, for the initial alignments: y or z; unknown where it is left out.
        points: number of points that are sampled on a mesh or on Gaussians, or drawn from a larger cloud.
        device: auto, cpu or cuda.
        out: file for the scores as JSON, with every image's value, the machine and the versions.
        json: print the same JSON, and nothing else, to standard output.
    """

    pred: Path
    truth: Path
    masks: Path | None = None
    pred_masks: Path | None = None
    background: float = 1.0
    pair: Literal["name", "order"] = "name"
    unpaired: bool = False
    only: tuple[str, ...] = ()
    fps: float | None = None
    up: Literal["y", "z"] | None = None
    points: int = 30_000
    device: str = "auto"
    out: Path | None = None
    json: bool = False


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench score", description=DESCRIPTION)
    if options.out is not None:
        require_writable_file(options.out)
    from rewild4d.evaluation.reports import markdown, to_json

    report = score(options)
    if options.out is not None:
        write_text(options.out, to_json(report) + "\n")
    print(to_json(report) if options.json else markdown(report))
    return 0


def score(options: Options) -> Report:
    """Check the flags and score the files that they name.

    Raises:
        UserError: a value out of range, a name that is unknown, or a path that cannot be used.
    """
    from rewild4d.evaluation.cloud_scoring import score_clouds
    from rewild4d.evaluation.folders import score_pictures
    from rewild4d.evaluation.networks import FAMILIES, load_networks
    from rewild4d.evaluation.pairing import Inputs
    from rewild4d.machine import pick_device
    from rewild4d.progress import Progress

    device = pick_device(options.device)
    clouds = [path.suffix.lower() == ".ply" for path in (options.pred, options.truth)]
    if any(clouds):
        if not all(clouds):
            raise UserError(f"score: expected two .ply files or none, got {options.pred} and {options.truth}.")
        if options.points < 1:
            raise UserError(f"--points: expected a number of at least 1, got {options.points}.")
        return score_clouds(options.pred, options.truth, up=options.up, points=options.points)
    for name in options.only:
        if name not in FAMILIES:
            raise unknown_name("score", name, FAMILIES)
    if not 0 <= options.background <= 1:
        raise UserError(f"--background: expected a grey level from 0 to 1, got {options.background:g}.")
    if options.fps is not None and not options.fps > 0:
        raise UserError(f"--fps: expected a number above 0, got {options.fps:g}.")
    if options.unpaired and (options.masks or options.pred_masks):
        raise UserError("--unpaired: expected no masks, because only whole images are compared.")
    families = options.only or FAMILIES
    if options.unpaired and not {"kid", "fvd"} & {*families}:
        raise UserError(f"--unpaired: expected kid or fvd among --only, got {' '.join(families)}.")
    shown = ExitStack()

    def begin(title: str) -> ShowProgress:
        """Replace the progress bar by the next one."""
        shown.close()
        return shown.enter_context(closing(Progress(title)))

    with shown:
        return score_pictures(
            Inputs(options.pred, options.truth, options.masks, options.pred_masks, options.pair == "order"),
            networks=load_networks(families, device),
            families=families,
            background=options.background,
            fps=options.fps,
            paired=not options.unpaired,
            device=device,
            stage=begin,
        )
