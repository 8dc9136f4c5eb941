"""`prior fit` and `prior import`: a posed template for real footage, as an npz and as pictures to judge it by."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from rewild4d.config import parse_flags
from rewild4d.errors import UserError, unknown_name
from rewild4d.priors.annotations import read_keypoints
from rewild4d.priors.config import FOOTAGE
from rewild4d.priors.fauna import read_fauna
from rewild4d.priors.folder import Footage, read_footage
from rewild4d.priors.footage import Evidence, fit_footage, resized
from rewild4d.priors.io import save_prior, seal
from rewild4d.priors.judge import joint_scores
from rewild4d.priors.landmarks import Marks, load_mapping, marks
from rewild4d.priors.overlay import save_overlay
from rewild4d.priors.steady import steady
from rewild4d.runner import Progress
from rewild4d.types import Prior

USAGE = """usage: rewild4d-bench prior fit --frames DIR --masks DIR --out prior.npz [--keypoints FILE --mapping NAME]
       rewild4d-bench prior import --files DIR --out prior.npz"""
DESCRIPTION = """Fit the quadruped template to masked frames whose cameras nobody knows; write the prior and an overlay
(<out>.png and <out>.mp4): mask green, template magenta, agreement grey, left legs orange, right legs blue, head red."""
IMPORT = """Read what 3D-Fauna's test run wrote (<step>_<frame>_mesh.obj, _pose.txt, _arti_params.txt) as a prior."""
POOR = 0.6
"""Mask IoU below which the template hardly fits."""


@dataclass(frozen=True)
class FitOptions:
    """Flags of `prior fit`.

    Attributes:
        frames: folder of images, in order of their names.
        masks: folder of masks with the frames' names: white or coloured inside, or alpha.
        out: the npz to write.
        keypoints: BADJA or COCO-like .json, DeepLabCut or SLEAP .csv.
        mapping: which keypoint is which point of the template: aptv2, badja, superanimal-quadruped or a .toml file.
        use: frames whose keypoints the fit sees: all; every other one (the rest is scored); none (all are scored).
        fps: frames per second.
        seed: of the fit.
    """

    frames: Path
    masks: Path
    out: Path
    keypoints: Path | None = None
    mapping: str | None = None
    use: Literal["all", "half", "none"] = "all"
    fps: float = 24.0
    seed: int = 0


@dataclass(frozen=True)
class ImportOptions:
    """Flags of `prior import`.

    Attributes:
        files: 3D-Fauna's result folder.
        out: the npz to write.
        flip: result folder of the horizontally flipped images; mirror images of the others where it is left out.
        boxes: folder of <frame>_box.txt, which say where the crops lie in the frames; without it cameras are for crops.
        size: side of the crops in pixels.
        fps: frames per second.
    """

    files: Path
    out: Path
    flip: Path | None = None
    boxes: Path | None = None
    size: int = 256
    fps: float = 24.0


def main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] not in ("fit", "import"):
        raise unknown_name("kind of prior command", arguments[0], ["fit", "import"])
    prog = f"rewild4d-bench prior {arguments[0]}"
    if arguments[0] == "import":
        chosen = parse_flags(ImportOptions, arguments[1:], prog=prog, description=IMPORT)
        prior = read_fauna(chosen.files, flip=chosen.flip, boxes=chosen.boxes, size=chosen.size, fps=chosen.fps)
        save_prior(prior, chosen.out)
        _tell(prior, [chosen.out])
        return 0
    options = parse_flags(FitOptions, arguments[1:], prog=prog, description=DESCRIPTION)
    _fit(options)
    return 0


def _fit(options: FitOptions) -> None:
    if not options.fps > 0:
        raise UserError(f"--fps: expected a number above 0, got {options.fps:g}.")
    if (options.keypoints is None) != (options.mapping is None):
        raise UserError("--keypoints and --mapping: expected both or neither.")
    mapping = load_mapping(options.mapping) if options.mapping else {}
    footage = read_footage(options.frames, options.masks, options.fps)
    for note in footage.notes:
        print(note)
    given, scored = _split(_marks(options, footage, mapping), options.use)
    progress = Progress(f"prior: {options.frames}")
    prior = fit_footage(
        footage.clip, config=FOOTAGE, seed=options.seed, log=progress, said=Evidence(given, footage.travel)
    )
    progress.close()
    if scored is not None:
        prior = seal(replace(prior, quality=prior.quality | joint_scores(prior, footage.clip.frames, scored)))
    pictures = save_overlay(footage.clip, prior, options.out)
    save_prior(resized(prior, *footage.size), options.out)
    _tell(prior, [options.out, *pictures])


def _marks(options: FitOptions, footage: Footage, mapping: dict[str, str]) -> Marks | None:
    if options.keypoints is None:
        return None
    size = footage.clip.frames[0].mask.shape[2], footage.clip.frames[0].mask.shape[1]
    found = read_keypoints(options.keypoints, footage.stems, footage.size)
    scale = torch.tensor((size[0] / footage.size[0], size[1] / footage.size[1]))
    result = marks([k and replace(k, points=k.points * scale) for k in found], mapping)
    if not len(result):
        names = sorted({name for points in found if points for name in points.names})
        raise UserError(
            f"{options.keypoints}: expected visible keypoints that the mapping {options.mapping} names, "
            f"got {', '.join(names[:6])}."
        )
    return result


def _split(found: Marks | None, use: str) -> tuple[Marks | None, Marks | None]:
    """Marks for the fit and marks to score it by."""
    if found is None or use == "none":
        return None, found
    if use == "all":
        return found, None
    moments = found.moments.unique()
    seen = torch.isin(found.moments, moments[::2])
    return found.chosen(seen), found.chosen(~seen)


def _tell(prior: Prior, written: list[Path]) -> None:
    for name in ("mask_iou", "mask_iou_flip", "facing_margin", "pck", "facing"):
        if name in prior.quality:
            print(f"{name:14} {prior.quality[name]:.3f}")
    for word, cameras in (("frames", prior.cameras), ("mirrored frames", prior.cameras_flip)):
        out = int((~steady(cameras)).sum())
        print(f"{out} of {len(cameras)} {word} with a camera far from the others'")
    if prior.quality.get("mask_iou", 1.0) < POOR:
        print(f"warning: the template hardly fits these masks (mask IoU below {POOR:g}); look at the overlay")
    for path in written:
        print(path)
