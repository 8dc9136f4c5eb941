"""`make`: render a rigged, animated glTF, or random animals, as a data set with exact truth."""

import re
from dataclasses import dataclass
from pathlib import Path

from rewild4d.commands.shared import call_subcommand
from rewild4d.config import parse_flags
from rewild4d.errors import UserError

LONGEST_SIDE = 8192
"""Longest side of an image, pixels."""
USAGE = """usage: rewild4d-bench make artemis --rig FILE.glb --clip NAME --out DIR [--views 36] [--frames 24]
       rewild4d-bench make zoo --seeds 0 1 2 --out DIR [--views 24] [--frames 24]"""
DESCRIPTION = """Render a skinned, animated glTF from a ring of cameras and write it as an Artemis folder: images,
mattes, cameras, bones and the voxel volume with its skinning weights."""
ZOO_DESCRIPTION = """Render random animals, one a seed, as Artemis folders: twenty kinds (dogs, stags, elephants,
crocodiles, ostriches, crows, ...) of random proportions, coats and motions, with exact truth. Seeds 0 to 99 are for
development: choose settings on them. Seeds from 1000 on are the test set: score them once, at the end, and never tune
on them. Animals that DIR holds are not rendered again. DIR/sheet.png shows the animals of this call, a row each."""


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


def main(arguments: list[str]) -> int:
    kinds = {"artemis": _make_artemis, "zoo": _make_zoo}
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
    if not options.seeds:
        raise UserError("--seeds: expected at least one number, got none.")
    from rewild4d.datasets.builtin.zoo import animals, sheet
    from rewild4d.progress import Progress

    seeds = tuple(dict.fromkeys(options.seeds))
    progress = Progress(f"zoo: {len(seeds)} {'animal' if len(seeds) == 1 else 'animals'}")
    made = animals.render(
        options.out, seeds, views=options.views, frames=options.frames, width=width, height=height, progress=progress
    )
    progress.close()
    sheet.write(options.out / "sheet.png", seeds)
    for folder in made:
        print(folder)
    return 0


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
