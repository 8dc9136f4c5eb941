"""Room for the pairs of a Gaussian and a tile, in calls that a CUDA graph records, where no number may be looked at.

Outside a graph the backend waits for the number of pairs and takes as much room as they need. `measured` tells these
numbers; `given` then sets the room of the same calls in the same order, with some to spare, and tells whether it was
enough.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from torch import Tensor


@dataclass
class Rooms:
    """Room of a sequence of calls of the rasterizer.

    Attributes:
        given: room of each call, in their order; empty where it is measured.
        pairs: found in each call: numbers where it is measured, else tensors on the GPU.
    """

    given: Sequence[int] = ()
    pairs: list[int | Tensor] = field(default_factory=list)


_rooms: Rooms | None = None


@contextmanager
def measured() -> Iterator[Rooms]:
    """Note the numbers of pairs of all calls inside a `with` block."""
    with _use(Rooms()) as rooms:
        yield rooms


@contextmanager
def given(room: Sequence[int]) -> Iterator[Rooms]:
    """Set the room of all calls inside a `with` block; with fewer than the pairs found the images are wrong."""
    with _use(Rooms(room)) as rooms:
        yield rooms


@contextmanager
def _use(rooms: Rooms) -> Iterator[Rooms]:
    global _rooms
    before, _rooms = _rooms, rooms
    try:
        yield rooms
    finally:
        _rooms = before


def take_room(ends: Tensor) -> int:
    """Return the room of the next call, whose pairs have the running sum ``ends`` [V * N]."""
    rooms = _rooms
    if rooms is not None and rooms.given:
        index = len(rooms.pairs)
        rooms.pairs.append(ends[-1])
        return rooms.given[index]
    pairs = int(ends[-1]) if len(ends) else 0
    if rooms is not None:
        rooms.pairs.append(pairs)
    return pairs
