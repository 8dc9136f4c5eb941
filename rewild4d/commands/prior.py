"""`prior fit` and `prior import`: a posed template for real footage, as an npz and as overlays to check it by.

`prior train` makes what the fit knows of animals.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rewild4d.commands.shared import call_subcommand, require_writable_file
from rewild4d.config import parse_flags
from rewild4d.contracts import Parts, Selection
from rewild4d.errors import UserError
from rewild4d.priors.config import STANDARD, Use

if TYPE_CHECKING:
    from rewild4d.priors.landmarks import Marks
    from rewild4d.types import Clip, Prior

USAGE = """usage: rewild4d-bench prior fit --frames DIR --masks DIR --out prior.npz [--keypoints FILE --mapping NAME]
       rewild4d-bench prior import --files DIR --out prior.npz
       rewild4d-bench prior train --out DIR [--part headings|shapes|points]"""
DESCRIPTION = """Fit a template to masked frames of unknown cameras; write the prior and an overlay
(<out>.png and <out>.mp4): mask green, template magenta, agreement grey, left legs orange, right legs blue, head red."""
IMPORT = """Import the output of a test run of 3D-Fauna, <step>_<frame>_mesh.obj, _pose.txt, _arti_params.txt, as a
prior."""
TRAIN = """Learn a part of the prior from random animals, or go on where the folder's training was stopped.
`headings` (a network, weights.safetensors and curve.json, half an hour on two cores) and `shapes`
(density.safetensors, an hour) come with the package; `points` is the network of
`run --prior learned:DIR/weights.safetensors` (about 15 seconds a round)."""
WHOLE = Selection(cameras="unknown", size=256, framing="crop", split=5)
"""Selection that names the cases of a reader; frames are used whole and none is held out."""


@dataclass(frozen=True)
class FitOptions:
    """Flags of `prior fit`.

    Attributes:
        frames: folder of images in order of their names, or a video file.
        masks: folder of masks with the frames' names, or a video of them; the frames' alpha where it is left out.
        parts: as for `run`.
        out: the npz to write.
        keypoints: BADJA or COCO-like .json, DeepLabCut or SLEAP .csv.
        mapping: from names of keypoints to points of the template: aptv2, badja, superanimal-quadruped or a .toml file.
        use: frames whose keypoints the fit sees: all; every other one (the rest is scored); none (all are scored).
        prior: "template" (a quadruped, biped or primate, whichever fits best), "template:<which>" (one of these),
            "masks" (the same from masks alone, without what was learned of headings and shapes) or "learned:<weights>"
            (masks, and points of the body that a network finds).
        rig: a rig of your own, .glb or .gltf with a skinned mesh and a clip, y up, as the template.
        fps: frames per second as for `run`: DAVIS has 24, other folders 25 where it is left out, videos their own.
        seed: of the fit.
    """

    frames: Path
    out: Path
    masks: Path | None = None
    parts: Parts = "auto"
    keypoints: Path | None = None
    mapping: str | None = None
    use: Use = "all"
    prior: str = "template"
    rig: Path | None = None
    fps: float | None = None
    seed: int = 0


@dataclass(frozen=True)
class ImportOptions:
    """Flags of `prior import`.

    Attributes:
        files: 3D-Fauna's result folder.
        out: the npz to write.
        flip: result folder of the horizontally flipped images; mirror images of the others where it is left out.
        boxes: folder of <frame>_box.txt, the crops' boxes in the frames; without it cameras are those of the crops.
        size: side of the crops in pixels.
        fps: frames per second.
    """

    files: Path
    out: Path
    flip: Path | None = None
    boxes: Path | None = None
    size: int = 256
    fps: float = 24.0


@dataclass(frozen=True)
class TrainOptions:
    """Flags of `prior train`.

    Attributes:
        out: folder of what is learned and of what is needed to go on.
        part: headings (which way an animal heads), shapes (proportions and cross sections) or points (of the body, in
            3D).
        animals: of headings and shapes: to learn from; 1600 and 275 where it is left out.
        epochs: of headings: how often their pictures are gone through.
        two_legged: of headings: share of the animals that have two legs, 0 to 1.
        start: of headings: weights to start from, as an earlier training wrote them; the learning rate is a quarter.
        augment: of headings: stretch parts of animals, and bend pictures and change their light.
        rounds: of points: of eight animals each; the learning rate falls over all of them.
        seed: of the animals and of the first weights.
        workers: processes that draw (of shapes: fit) animals; of points beside the one that trains; 0 takes the same.
    """

    out: Path
    part: Literal["headings", "shapes", "points"] = "headings"
    animals: int | None = None
    epochs: int = 10
    two_legged: float = 0.0
    start: Path | None = None
    augment: bool = False
    rounds: int = 2000
    seed: int = 0
    workers: int = 2


def main(arguments: list[str]) -> int:
    return call_subcommand(arguments, USAGE, "kind of prior command", {"fit": _fit, "import": _import, "train": _train})


def _import(arguments: list[str]) -> int:
    options = parse_flags(ImportOptions, arguments, prog="rewild4d-bench prior import", description=IMPORT)
    from rewild4d.priors.fauna import read_fauna
    from rewild4d.priors.fauna_files import LARGEST
    from rewild4d.priors.io import save_prior

    if not options.fps > 0:
        raise UserError(f"--fps: expected a number above 0, got {options.fps:g}.")
    if not 0 < options.size <= LARGEST:
        raise UserError(f"--size: expected 1 to {LARGEST} pixels, got {options.size}.")
    prior = read_fauna(options.files, flip=options.flip, boxes=options.boxes, size=options.size, fps=options.fps)
    save_prior(prior, options.out)
    return _report(prior, [options.out])


def _train(arguments: list[str]) -> int:
    options = parse_flags(TrainOptions, arguments, prog="rewild4d-bench prior train", description=TRAIN)
    for name in ("animals", "epochs", "rounds"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UserError(f"--{name}: expected 1 or more, got {value}.")
    if not 0 <= options.two_legged <= 1:
        raise UserError(f"--two-legged: expected a share from 0 to 1, got {options.two_legged:g}.")
    if options.start is not None and options.part != "headings":
        raise UserError(f"--start: expected with --part headings alone, got --part {options.part}.")
    if options.workers < 0:
        raise UserError(f"--workers: expected 0 or more, got {options.workers}.")
    require_writable_file(options.out / "weights.safetensors")
    print(_trained(options))
    return 0


def _trained(options: TrainOptions) -> Path:
    from rewild4d.priors.heading import training as headings
    from rewild4d.priors.learned import training as points
    from rewild4d.priors.shapes import training as shapes

    animals = {} if options.animals is None else {"animals": options.animals}
    if options.part == "points":
        rounds = points.TrainingConfig(rounds=options.rounds, seed=options.seed)
        return points.train(options.out, rounds, workers=options.workers, report=print)
    if options.part == "shapes":
        samples = shapes.TrainingConfig(seed=options.seed, **animals)
        return shapes.train(options.out, samples, workers=options.workers, report=print)
    start = "" if options.start is None else str(options.start)
    epochs = headings.TrainingConfig(
        epochs=options.epochs,
        seed=options.seed,
        two_legged=options.two_legged,
        start=start,
        augment=options.augment,
        **animals,
    )
    return headings.train(options.out, epochs, workers=options.workers, report=print)


def _fit(arguments: list[str]) -> int:
    options = parse_flags(FitOptions, arguments, prog="rewild4d-bench prior fit", description=DESCRIPTION)
    if (options.keypoints is None) != (options.mapping is None):
        raise UserError("--keypoints and --mapping: expected both or neither.")
    from rewild4d.datasets.video.online import Online
    from rewild4d.datasets.video.whole_frames import whole_clip
    from rewild4d.priors.bodies.choice import is_rig_file
    from rewild4d.priors.choose import PriorChoice, split_marks
    from rewild4d.priors.footage import Evidence, fit_footage
    from rewild4d.priors.io import save_prior, seal
    from rewild4d.priors.judge import joint_scores
    from rewild4d.priors.landmarks import load_mapping
    from rewild4d.priors.overlay import save_overlay
    from rewild4d.priors.placing import resized
    from rewild4d.progress import Progress

    mapping = load_mapping(options.mapping) if options.mapping else {}
    if options.rig is not None and options.prior != FitOptions.prior:
        raise UserError("--rig and --prior: expected one of them, got both.")
    if options.rig is not None and not is_rig_file(str(options.rig)):
        raise UserError(f"--rig {options.rig}: expected a .glb or .gltf file.")
    choice = PriorChoice(options.prior if options.rig is None else f"template:{options.rig}", STANDARD)
    if not choice.is_fitted:
        raise UserError(f"--prior {options.prior}: expected template, template:<which>, masks or learned:<weights>.")
    if choice.is_own_rig and options.keypoints is not None:
        raise UserError("--rig and --keypoints: expected one of them; keypoints are mapped to the package's templates.")
    choice.require()
    reader = Online(
        options.frames, masks=options.masks, fps=options.fps, keypoints=options.keypoints, parts=options.parts
    )
    video = reader.video(reader.cases(WHOLE)[0])
    clip = whole_clip(video)
    for note in clip.notes:
        print(note)
    given, scored = split_marks(_marks(options, clip, mapping), options.use)
    require_writable_file(options.out)
    progress = Progress(f"prior: {options.frames}")
    evidence = Evidence(given, clip.travel)
    prior = fit_footage(
        clip, config=choice.settings_under(known_cameras=False), seed=options.seed, log=progress, said=evidence,
        trained=choice.trained(), bodies=choice.bodies(),
    )  # fmt: skip
    progress.close()
    if scored is not None:
        prior = seal(replace(prior, quality=prior.quality | joint_scores(prior, clip.frames, scored)))
    pictures = save_overlay(clip, prior, options.out)
    save_prior(resized(prior, *video.size), options.out)
    return _report(prior, [options.out, *pictures])


def _marks(options: FitOptions, clip: Clip, mapping: dict[str, str]) -> Marks:
    from rewild4d.priors.landmarks import marks

    found = [frame.keypoints for frame in clip.frames]
    result = marks(found, mapping)
    if options.keypoints is not None and not len(result):
        names = sorted({name for points in found if points for name in points.names})
        raise UserError(
            f"{options.keypoints}: expected visible keypoints that the mapping {options.mapping} names, "
            f"got {', '.join(names[:6])}."
        )
    return result


def _report(prior: Prior, written: list[Path]) -> int:
    from rewild4d.priors.judge import doubts
    from rewild4d.priors.steady import without_hops

    for name in ("mask_iou", "mask_iou_flip", "facing_margin", "facing_agreement", "pck", "facing"):
        if name in prior.quality:
            print(f"{name:16} {prior.quality[name]:.3f}")
    for note in without_hops(prior).notes:
        print(f"in a run: {note}")
    for doubt in doubts(prior.quality):
        print(f"warning: {doubt}; look at the overlay", file=sys.stderr)
    for path in written:
        print(path)
    return 0
