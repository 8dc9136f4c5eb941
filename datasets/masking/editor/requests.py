"""What a page may ask the editor to do, as JSON: {"kind": "stroke", "place": 3, ...}."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

LARGEST = 1 << 20
"""Bytes of a request: twenty thousand points of a stroke."""
MOST_POINTS = 20_000

Name = Annotated[str, Meta(min_length=1, max_length=64)]
Place = Annotated[int, Meta(ge=0)]
Pixel = Annotated[float, Meta(ge=-1e5, le=1e5)]
Length = Annotated[float, Meta(gt=0, le=1e5)]


class Request(msgspec.Struct, forbid_unknown_fields=True, frozen=True, tag_field="kind"):
    """A request that holds whatever the page has seen."""


class Drawing(Request, frozen=True):
    """A change of one frame; the same id is drawn once, however often it is sent.

    Attributes:
        id: that the page made up.
        place: of the frame, 0 for the first.
    """

    id: Name
    place: Place


class Stroke(Drawing, frozen=True, tag="stroke"):
    """A line of a brush.

    Attributes:
        tool: the brush.
        radius: pixels of the frame.
        points: across and down, pixels of the frame.
    """

    tool: Literal["animal", "surroundings", "eraser"]
    radius: Annotated[float, Meta(gt=0, le=1000)]
    points: Annotated[list[tuple[Pixel, Pixel]], Meta(min_length=1, max_length=MOST_POINTS)]


class DrawBox(Drawing, frozen=True, tag="box"):
    """The box around the animal: left, top, width and height in pixels; null removes it."""

    box: tuple[Pixel, Pixel, Length, Length] | None


class Decision(Request, frozen=True):
    """A request that holds only for the state that the page shows.

    Attributes:
        version: of that state.
    """

    version: int


class Undo(Decision, frozen=True, tag="undo"):
    """Take the last step back."""


class Redo(Decision, frozen=True, tag="redo"):
    """Make it again."""


class Clear(Decision, frozen=True, tag="clear"):
    """Remove the box and the strokes of a frame."""

    place: Place


class Fix(Decision, frozen=True, tag="fix"):
    """Take a frame's mask for true, pixel by pixel; or no longer."""

    place: Place


class Track(Decision, frozen=True, tag="track"):
    """Follow the animal through the whole film (place is None), or from a frame's mask to the film's end."""

    place: Place | None = None


class Cancel(Request, frozen=True, tag="cancel"):
    """Stop following; masks that are there stay."""


class Save(Request, frozen=True, tag="save"):
    """Write masks, marks and boxes."""


class Done(Decision, frozen=True, tag="done"):
    """End the editor."""


AnyRequest = Stroke | DrawBox | Undo | Redo | Clear | Fix | Track | Cancel | Save | Done


def parse(body: bytes) -> AnyRequest:
    """Return the request that a body holds.

    Raises:
        ValueError: it holds none; the message says why.
    """
    try:
        return msgspec.json.decode(body, type=AnyRequest)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error
