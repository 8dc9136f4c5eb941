"""`make`: render a rigged, animated glTF, or random animals, as a data set with exact truth, or as other formats."""

import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rewild4d.commands.shared import call_subcommand
from rewild4d.config import parse_flags
from rewild4d.errors import UserError

LONGEST_SIDE = 8192
"""Longest side of an image, pixels."""
USAGE = """usage: rewild4d-bench make artemis --rig FILE.glb --clip NAME --out DIR [--views 36] [--frames 24]
       rewild4d-bench make zoo --seeds 0 1 2 --out DIR [--views 24] [--frames 24]
       rewild4d-bench make aim --out DIR [--seeds 0 7] [--frames 24]
       rewild4d-bench make cop3d --out DIR [--seeds 0 3] [--frames 24]"""
DESCRIPTION = """Render a skinned, animated glTF from a ring of cameras and write it as an Artemis folder: images,
mattes, cameras, bones and the voxel volume with its skinning weights."""
ZOO_DESCRIPTION = """Render random animals, one a seed, as Artemis folders: twenty kinds (dogs, stags, elephants,
crocodiles, ostriches, crows, ...) of random proportions, coats and motions, with exact truth. Seeds 0 to 99 are for
development: choose settings on them. Seeds from 1000 on are the test set: score them once, at the end, and never tune
on them. Animals that DIR holds are not rendered again. DIR/sheet.png shows the animals of this call, a row each."""

AIM_DESCRIPTION = """Film random animals (those of `make zoo`) with a moving camera and write the films in the layout of
Animal-in-Motion: crops, masks, keypoints and metadata, to see the format and to try it."""
COP3D_DESCRIPTION = """Film cats and dogs of `make zoo` with a moving camera and write the films in the layout of CoP3D:
images, soft masks and cameras, to see the format and to try it."""


@dataclass(frozen=True)
class Options:
    """Flags of `make artemis`.

    Attributes:
        rig: a .glb or .gltf file with a skin and at least one animation.
        clip: name of the animation.
        out: the animal's new folder.
        views: cameras around the animal.
        frames: times, evenly spaced over the clip.
        size: width x height in pixels.
    """

    rig: Path
    clip: str
    out: Path
    views: int = 36
    frames: int = 24
    size: str = "640x360"


@dataclass(frozen=True)
class ZooOptions:
    """Flags of `make zoo`.

    Attributes:
        seeds: one animal each: 0 to 99 for development, from 1000 on for the test set.
        out: folder of the animals' folders, for `--data`.
        views: cameras around each animal.
        frames: times of its clip.
        size: width x height in pixels.
    """

    seeds: tuple[int, ...]
    out: Path
    views: int = 24
    frames: int = 24
    size: str = "384x216"


@dataclass(frozen=True)
class AimOptions:
    """Flags of `make aim`.

    Attributes:
        out: the new folder, for `--data`.
        seeds: one animal each, as of `make zoo`.
        frames: of each film.
        size: width x height of the films in pixels.
        crop: width and height of the crops in pixels.
    """

    out: Path
    seeds: tuple[int, ...] = (0, 7)
    frames: int = 24
    size: str = "640x360"
    crop: int = 512


@dataclass(frozen=True)
class Cop3dOptions:
    """Flags of `make cop3d`.

    Attributes:
        out: the new folder, for `--data`.
        seeds: one animal each, as of `make zoo`: those of cats and dogs.
        frames: of each film.
        size: width x height of the films in pixels.
        intrinsics: the form in which cameras are written.
    """

    out: Path
    seeds: tuple[int, ...] = (0, 3)
    frames: int = 24
    size: str = "360x640"
    intrinsics: Literal["ndc_norm_image_bounds", "ndc_isotropic"] = "ndc_norm_image_bounds"


def main(arguments: list[str]) -> int:
    kinds = {"artemis": _make_artemis, "zoo": _make_zoo, "aim": _make_aim, "cop3d": _make_cop3d}
    return call_subcommand(arguments, USAGE, "kind of data set to make", kinds)


def _make_artemis(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench make artemis", description=DESCRIPTION)
    width, height = parse_size(options.size)
    _require_positive(options.views, options.frames)
    from rewild4d.datasets.rigs.studio import make_artemis
    from rewild4d.progress import Progress

    progress = Progress(f"{options.rig.name}: {options.clip}")
    made = make_artemis(
        options.rig, options.clip, views=options.views, frames=options.frames, width=width, height=height,
        out=options.out, progress=progress,
    )  # fmt: skip
    progress.close()
    print(made)
    return 0


def _make_zoo(arguments: list[str]) -> int:
    options = parse_flags(ZooOptions, arguments, prog="rewild4d-bench make zoo", description=ZOO_DESCRIPTION)
    width, height = parse_size(options.size)
    _require_positive(options.views, options.frames)
    seeds = _distinct(options.seeds)
    from rewild4d.datasets.builtin.zoo import animals, sheet
    from rewild4d.progress import Progress

    progress = Progress(f"zoo: {len(seeds)} {'animal' if len(seeds) == 1 else 'animals'}")
    made = animals.render(
        options.out, seeds, views=options.views, frames=options.frames, width=width, height=height, progress=progress
    )
    progress.close()
    sheet.write(options.out / "sheet.png", seeds)
    for folder in made:
        print(folder)
    return 0


def _make_aim(arguments: list[str]) -> int:
    options = parse_flags(AimOptions, arguments, prog="rewild4d-bench make aim", description=AIM_DESCRIPTION)
    size, seeds = parse_size(options.size), _distinct(options.seeds)
    _require_positive(1, options.frames)
    if not 16 <= options.crop <= LONGEST_SIDE:
        raise UserError(f"--crop: expected 16 to {LONGEST_SIDE} pixels, got {options.crop}.")
    from rewild4d.datasets.aim.writer import write_aim
    from rewild4d.progress import Progress

    with closing(Progress(f"aim: {len(seeds)} films")) as progress:
        made = write_aim(options.out.absolute(), seeds, options.frames, size, options.crop, progress)
    print(*made, sep="\n")
    return 0


def _make_cop3d(arguments: list[str]) -> int:
    options = parse_flags(Cop3dOptions, arguments, prog="rewild4d-bench make cop3d", description=COP3D_DESCRIPTION)
    size, seeds = parse_size(options.size), _distinct(options.seeds)
    _require_positive(1, options.frames)
    from rewild4d.datasets.cop3d.writer import write_cop3d
    from rewild4d.progress import Progress

    with closing(Progress(f"cop3d: {len(seeds)} films")) as progress:
        made = write_cop3d(options.out.absolute(), seeds, options.frames, size, options.intrinsics, progress)
    print(*made, sep="\n")
    return 0


def _distinct(seeds: Sequence[int]) -> tuple[int, ...]:
    """Return each seed once; a `UserError` where there is none."""
    if not seeds:
        raise UserError("--seeds: expected at least one number, got none.")
    return tuple(dict.fromkeys(seeds))


def _require_positive(views: int, frames: int) -> None:
    for flag, value in (("--views", views), ("--frames", frames)):
        if value < 1:
            raise UserError(f"{flag}: expected a number of at least 1, got {value}.")


def parse_size(text: str) -> tuple[int, int]:
    """Return the width and height of "640x360".

    Raises:
        UserError: another form, or a side of less than 16 or more than `LONGEST_SIDE` pixels.
    """
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None or not all(16 <= int(side) <= LONGEST_SIDE for side in match.groups()):
        raise UserError(
            f"--size: expected <width>x<height> of 16 to {LONGEST_SIDE} pixels, like 640x360, got '{text}'."
        )
    return int(match[1]), int(match[2])
