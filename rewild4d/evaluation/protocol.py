"""Evaluation protocols: a TOML file states held-out frames and scores."""

from collections.abc import Iterable, Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Literal

import msgspec

from rewild4d.contracts import Selection
from rewild4d.errors import UserError, reason, unknown_name
from rewild4d.files import digest
from rewild4d.foreign.texts import read_toml
from rewild4d.metrics import names
from rewild4d.registry import plugged_in


class NovelViews(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of novel views in a protocol.

    Attributes:
        frames: times, evenly spaced over the clip, that KID-V uses from every view.
        clip: frames T of a clip of FVD; a shorter video is padded with its last frame.
        stride: frames from the start of one clip to that of the next.
        upright: the circle is level in the world (`world_up`), and principal points are the images' middles. Where left
            out (first versions), up is the mean of the cameras' own, and the principal point that of the first image.
    """

    frames: int = 8
    clip: int = 16
    stride: int = 8
    upright: Literal[True] | None = None


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One named, versioned way to score a reconstruction.

    Attributes:
        name: equals the file's name; ends in the version.
        dataset: name of its reader.
        title: for table captions.
        description: one paragraph that is shown with the numbers.
        background: grey level in [0, 1] behind prediction and truth alike.
        scores: out of `metrics.names.ALL`: on held-out images, on the shape, on novel views as a set.
        floors: methods that are always printed as lower-bound rows.
        selection: input of a method, and held-out frames.
        default: whether it is the data set's default; of several, the highest version.
        points: drawn from each cloud for scores of the shape.
        novel: settings of novel views for scores of sets.
        even_alignment: shapes are aligned by points that lie evenly on them (`metrics.alignment.align_sequence`). Where
            left out (first versions), by all points alike.
        free_scale: one scale a sequence about the input camera's centre is taken from the true surface before held-out
            views are drawn (`evaluation.placing`), because one fixed camera cannot know it.
    """

    name: str
    dataset: str
    title: str
    description: str
    background: float
    scores: tuple[str, ...]
    floors: tuple[str, ...]
    selection: Selection
    default: bool = False
    points: int | None = None
    novel: NovelViews | None = None
    even_alignment: Literal[True] | None = None
    free_scale: Literal[True] | None = None

    def __post_init__(self) -> None:
        for name in self.scores:
            if name not in names.ALL:
                raise ValueError(f"unknown score '{name}'")
        if self.points is None and any(name in names.GEOMETRY for name in self.scores):
            raise ValueError("scores of the shape need 'points'")
        if self.novel is None and any(name in names.SETS for name in self.scores):
            raise ValueError("scores of novel views need a table 'novel'")
        if self.free_scale and (self.selection.cameras != "fixed" or self.points is None or self.novel):
            raise ValueError("'free_scale' needs cameras = 'fixed' and 'points', and no table 'novel'")
        for name in self.scores:
            if (name == names.SCALE or name.endswith(names.RIGID)) and not self.free_scale:
                raise ValueError(f"the score '{name}' needs 'free_scale'")

    @property
    def digest(self) -> str:
        """SHA-256 over every setting; a setting newer than the protocol, left out, changes nothing."""
        given = msgspec.to_builtins(self)
        novel, selection = given["novel"], given["selection"]
        newer = ((given, "points"), (novel, "upright"), (given, "novel"), (selection, "split"),
                 (given, "even_alignment"), (given, "free_scale"), (selection, "frames"),
                 (selection, "mask_threshold"))  # fmt: skip
        for part, name in newer:
            if part is not None and part[name] is None:
                del part[name]
        return digest(msgspec.json.encode(given))


def load_protocols() -> dict[str, Protocol]:
    """Load all protocols by name: our own, then those of installed packages (entry point `rewild4d.protocols`).

    Raises:
        UserError: a package's protocol cannot be read, or its name is taken.
    """
    folder = resources.files("rewild4d.leaderboard") / "protocols"
    found = {protocol.name: protocol for protocol in map(_decode, _tomls(folder))}
    for entry in plugged_in("protocols"):
        try:
            added = [_decode(file) for file in _tomls(resources.files(entry.value))]
        except (ImportError, OSError, UserError) as error:
            raise UserError(f"protocols '{entry.name}': {entry.value}: {reason(error)}.") from error
        for protocol in added:
            if found.setdefault(protocol.name, protocol) is not protocol:
                raise UserError(f"protocols '{entry.name}': {entry.value}: the name '{protocol.name}' is taken.")
    return found


def _tomls(folder: Traversable) -> list[Traversable]:
    files = (entry for entry in folder.iterdir() if entry.name.endswith(".toml"))
    return sorted(files, key=lambda entry: entry.name)


def _decode(file: Traversable) -> Protocol:
    return read_toml(file, "a protocol", Protocol)


def default_name(dataset: str, protocols: Mapping[str, Protocol]) -> str | None:
    """Return the name of a data set's default protocol, or None where it has none."""
    names = [name for name, protocol in protocols.items() if protocol.dataset == dataset and protocol.default]
    return max(names, key=lambda name: int(name.rpartition("-v")[2]), default=None)


def newest_version(name: str, known: Iterable[str]) -> str:
    """Return the full name of a protocol: of a family ("artemis-sweep-256") the highest version; others unchanged."""
    return next(iter(versions(name, known)), name)


def versions(family: str, known: Iterable[str]) -> list[str]:
    """List the full names of a family's protocols, the newest first."""
    parts = {name: name.rpartition("-v") for name in known}
    found = [name for name, (stem, _, number) in parts.items() if stem == family and number.isdecimal()]
    return sorted(found, key=lambda name: int(parts[name][2]), reverse=True)


def find_protocol(dataset: str, name: str | None) -> Protocol:
    """Return the protocol of that name, or the data set's default.

    Raises:
        UserError: unknown, or made for another data set.
    """
    protocols = load_protocols()
    if name is None:
        name = default_name(dataset, protocols)
        if name is None:
            raise UserError(f"--protocol: the data set '{dataset}' has no default; name one of its protocols.")
    if name not in protocols:
        raise unknown_name("protocol", name, protocols)
    if protocols[name].dataset != dataset:
        raise UserError(f"protocol '{name}' is for the data set '{protocols[name].dataset}', not for '{dataset}'.")
    return protocols[name]
