"""One measured quantity, with its unit, its direction and what it is a mean of."""

import msgspec


class Score(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One measured quantity.

    Attributes:
        value: the mean over ``count`` items, or None where it could not be computed; ``note`` then says why.
        unit: "dB", "1" for a ratio, ...
        better: "higher" or "lower".
        count: how many items the mean is over.
        per_item: the value of each item, in the order of the record's ``items``; None for an item without a value.
        note: why there is no value, or what was left out of the mean.
        floor: what a perfect result would get, where that is not the best value there is; None where nobody knows.
    """

    value: float | None
    unit: str
    better: str
    count: int
    per_item: list[float | None] = []
    note: str = ""
    floor: float | None = None
