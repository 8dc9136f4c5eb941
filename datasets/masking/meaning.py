"""Tell what the grey values of a whole folder, or film, of masks mean: one animal, numbers of objects, or a soft matte.

One image does not say it: 38 is an object's number beside 75, and the animal where it is the only value. Values are
looked at as they are stored, before 16 bits become 8.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

VOID = 255
MOST_OBJECTS = 32
"""Grey images whose values all lie below this, but for `VOID`, are ids, not shades."""
MOST_SHADES = 64
"""More values than these in 8 bits are shades."""
SOLID = 0.1
"""Share of a value's pixels whose neighbours have the same value, from which on it fills areas, not edges."""
LARGE = 0.01
"""Share of all pixels that a value has at least, where soft edges blur the objects."""
FILLED = 0.5
"""Share of all pixels that such values have in masks of objects."""
NEARLY = 0.97
"""Of the largest value: a matte that reaches it is white there."""
STRAY = 0.001
"""Share of the pixels that may be brighter than a mask's white."""
NOISE = 8
"""Values up to this, or as far from each other, are one value that was compressed."""
IGNORED = 10000
"""What MOTS calls a region to ignore; its objects are class * 1000 + number."""
BYTE, WORD = 255, 65535


@dataclass(frozen=True)
class Meaning:
    """What the values of masks mean.

    Attributes:
        ids: values that are numbers of objects, ascending; empty where a value is a shade.
        void: a value that stands for nothing; None: there is none.
        white: the shade of the inside of the animal.
        note: what was assumed, a sentence ("" for nothing).
    """

    ids: tuple[int, ...] = ()
    void: int | None = None
    white: float = BYTE
    note: str = ""

    def mask(self, values: np.ndarray, object_id: int | None) -> np.ndarray:
        """Return stored values as a mask, uint8 [h, w], 255 inside: of one object, or of all."""
        if self.ids:
            inside = values == object_id if object_id is not None else (values != 0) & (values != self.void)
            return np.where(inside, 255, 0).astype(np.uint8)
        if values.dtype == np.uint8 and self.white == BYTE:
            return values
        return np.rint((values / self.white * 255).clip(0, 255)).astype(np.uint8)


class Census:
    """How often each value occurs in some masks, and how often among its like.

    Args:
        is_lossy: whether compression changed the values.
    """

    def __init__(self, is_lossy: bool = False) -> None:
        self.is_lossy = is_lossy
        self._fractions: float | None = None
        self._pixels: dict[float, int] = {}
        self._among: dict[float, int] = {}

    def add(self, values: np.ndarray) -> None:
        """Count the values of one mask, uint8, uint16 or float32, [h, w]."""
        if values.dtype == np.float32 and ((values != np.rint(values)) | (values < 0)).any():
            self._fractions = max(self._fractions or 0.0, float(values.max()))
            return
        _count(values, self._pixels)
        around = np.ones((3, 3), np.uint8)
        alike = (cv2.erode(values, around) == values) & (cv2.dilate(values, around) == values)
        _count(values[alike], self._among)

    def indexed(self) -> Meaning:
        """Return the meaning of files whose values are entries of a palette: each is an object, but `VOID`."""
        ids = tuple(int(value) for value in sorted(self._pixels) if value not in (0, VOID))
        return Meaning(ids, VOID if ids else None)

    def meaning(self) -> Meaning:
        """Return the meaning of grey files."""
        pixels = {value: count for value, count in self._pixels.items() if value > 0}
        highest = max(pixels, default=0.0)
        if self._fractions is not None:
            highest = max(highest, self._fractions)
            return Meaning(white=1 if highest <= 1 else BYTE if highest <= BYTE else WORD)
        if not pixels:
            return Meaning()
        if self.is_lossy:
            return _shades(pixels)
        named = {value for value in pixels if value != VOID}
        if named and max(named) < MOST_OBJECTS:
            return Meaning(_numbers(named), VOID)
        ignored = {IGNORED} if IGNORED in named and all(1000 <= value <= IGNORED for value in named) else set[float]()
        objects = set(pixels) - ignored or set(pixels)
        told = f"masks hold {IGNORED}, which MOTS ignores: taken for no animal" if objects < set(pixels) else ""
        void = IGNORED if objects < set(pixels) else None
        if len(objects) == 1:
            value = int(*objects)
            if value in (BYTE, WORD):
                return Meaning(white=value)
            one = f"masks hold one value, {value}: taken as the animal"
            return Meaning((value,), void, note="; ".join(filter(None, (one, told))))
        if solid := _objects({value: pixels[value] for value in objects}, self._among):
            listed = ", ".join(f"{value:g}" for value in sorted(solid)[:6]) + (", ..." if len(solid) > 6 else "")
            several = f"masks hold {len(solid)} values ({listed}): taken as numbers of objects"
            return Meaning(_numbers(solid), void, note="; ".join(filter(None, (several, told))))
        return _shades(pixels)


def _objects(pixels: dict[float, int], among: dict[float, int]) -> set[float]:
    """Return values that fill areas, as numbers of objects do; none where they are shades, or noise around one value.

    Args:
        pixels: how many each value above 0 has.
        among: how many of them have neighbours of the same value only.
    """
    total, narrow = sum(pixels.values()), max(pixels) <= BYTE
    solid = {value for value in pixels if among.get(value, 0) >= SOLID * pixels[value]}
    if sum(pixels[value] for value in solid) < FILLED * total or (narrow and len(pixels) > MOST_SHADES):
        return set()
    if 2 * len(solid) >= len(pixels):  # hardly a shade at the edges: nothing blurred or compressed them
        return solid if len(solid) > 1 and min(solid) < NEARLY * (BYTE if narrow else WORD) else set()
    solid = {value for value in solid if pixels[value] >= LARGE * total}
    places = sorted(solid)
    groups = 1 + sum(after - before > NOISE for before, after in zip(places, places[1:], strict=False))
    return solid if groups > 1 and places[0] > NOISE else set()


def _numbers(values: set[float]) -> tuple[int, ...]:
    return tuple(int(value) for value in sorted(values))


def _count(values: np.ndarray, into: dict[float, int]) -> None:
    found: Iterable[tuple[float, int]]
    if values.dtype == np.float32:
        kinds, numbers = np.unique(values, return_counts=True)
        found = zip(map(float, kinds), map(int, numbers), strict=True)
    else:
        counts = np.bincount(values.ravel())
        found = [(float(value), int(counts[value])) for value in np.flatnonzero(counts)]
    for value, count in found:
        into[value] = into.get(value, 0) + count


def _shades(pixels: dict[float, int]) -> Meaning:
    """Return the meaning of soft values above 0: what is white among them."""
    full = BYTE if max(pixels) <= BYTE else WORD
    values = np.array(sorted(pixels))
    counts = np.array([pixels[value] for value in values])
    above = counts[::-1].cumsum()[::-1] / counts.sum()
    peak = float(values[above > STRAY][-1])
    if peak >= NEARLY * full:
        return Meaning(white=full)
    upper = values > peak / 2
    white = float(values[upper][counts[upper].argmax()])
    return Meaning(white=white, note=f"masks reach {white:g} of {full}: taken as the inside of the animal")
