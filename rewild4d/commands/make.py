"""`make artemis`: render a rigged, animated glTF as a data set with exact truth."""

import re
from dataclasses import dataclass
from pathlib import Path

from rewild4d.commands.shared import call_subcommand
from rewild4d.config import parse_flags
from rewild4d.errors import UserError

LONGEST_SIDE = 8192
"""Longest side of an image, pixels."""
USAGE = "usage: rewild4d-bench make artemis --rig FILE.glb --clip NAME --out DIR [--views 36] [--frames 24]"
DESCRIPTION = """Render a skinned, animated glTF from a ring of cameras and write it as an Artemis folder: images,
mattes, cameras, bones and the voxel volume with its skinning weights."""


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


def main(arguments: list[str]) -> int:
    return call_subcommand(arguments, USAGE, "kind of data set to make", {"artemis": _make_artemis})


def _make_artemis(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench make artemis", description=DESCRIPTION)
    width, height = parse_size(options.size)
    for flag, value in (("--views", options.views), ("--frames", options.frames)):
        if value < 1:
            raise UserError(f"{flag}: expected a number of at least 1, got {value}.")
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
