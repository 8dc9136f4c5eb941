"""`make artemis`: render a rigged, animated glTF as a data set with exact truth."""

import re
from dataclasses import dataclass
from pathlib import Path

from rewild4d.config import parse_flags
from rewild4d.errors import UserError, unknown_name

LONGEST_SIDE = 8192
"""Of an image in pixels."""
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
        frames: moments, evenly over the clip.
        size: width x height in pixels.
    """

    rig: Path
    clip: str
    out: Path
    views: int = 36
    frames: int = 24
    size: str = "640x360"


def main(arguments: list[str]) -> int:
    if arguments[:1] in (["-h"], ["--help"]) or not arguments:
        print("usage: rewild4d-bench make artemis --rig FILE.glb --clip NAME --out DIR [--views 36] [--frames 24]")
        return 0 if arguments else 2
    if arguments[0] != "artemis":
        raise unknown_name("kind of data set to make", arguments[0], ["artemis"])
    options = parse_flags(Options, arguments[1:], prog="rewild4d-bench make artemis", description=DESCRIPTION)
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
        UserError: anything else, or a side that is too short or too long.
    """
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None or not all(16 <= int(side) <= LONGEST_SIDE for side in match.groups()):
        raise UserError(
            f"--size: expected <width>x<height> of 16 to {LONGEST_SIDE} pixels, like 640x360, got '{text}'."
        )
    return int(match[1]), int(match[2])
