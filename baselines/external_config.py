"""Settings of programs of others, and what lists say of them; a light module, read before the method is loaded."""

from typing import Literal

import msgspec

from rewild4d.contracts import MethodInfo
from rewild4d.foreign.programs import TIMEOUT
from rewild4d.ours.numbers import Count, Positive

INFO = MethodInfo(title="anybody's program, by files", paper="that of the program", licence="that of the program")


class ExternalConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Whose program, and how its files are read."""

    program: str = ""
    """Its name, for tables; the profile's where it is left out."""
    profile: str = "frames"
    """Layout of its files: frames, glb, gvfdiffusion, dreammesh4d or 3d-fauna."""
    command: str = ""
    """Words that start it; {clip} and {out} stand for the two folders, {case} and {seed} for what they say. A file that
    a word names counts as a setting: edit it and it is another run. What such a file reads or imports does not.
    venv:PATH or docker:IMAGE before them runs it in that environment."""
    file: str = ""
    """A method file (.toml) that says command, environment, licence and more, instead of a command; the same as
    --method FILE.toml."""
    folder: str = ""
    """Where its results are already, instead of a command; {case} stands for <animal>__<motion>."""
    placed: Literal["profile", "yes", "no"] = "profile"
    """Whether results stand in the world of the cameras; "no" rotates them to the best input-view PSNR."""
    up: Literal["profile", "y", "-y", "z", "any"] = "profile"
    """Axis of its results that points up, where they are rotated; "any" tries all three."""
    points: Count = 20_000
    """Gaussians on a mesh."""
    timeout: Positive = TIMEOUT
    """Seconds that the program may take; then it is killed with all that it started."""
