"""One measured quantity, with its unit, its direction and the items that it averages."""

import msgspec


class Score(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One measured quantity.

    Attributes:
        value: mean over ``count`` items; None where it could not be computed.
        unit: "dB", "1" for a ratio, "world" for the data's own unit of length, ...
        better: "higher" or "lower".
        count: items that the mean is over.
        per_item: value of each item, in the order of the record's ``items``; None for an item without a value.
        note: why there is no value, or what the mean leaves out.
        floor: value of a perfect result where that is not the best possible value; None where unknown.

    Example:
        >>> Score(value=30.0, unit="dB", better="higher", count=2, per_item=[29.0, 31.0]).note
        ''
    """

    value: float | None
    unit: str
    better: str
    count: int
    per_item: list[float | None] = []
    note: str = ""
    floor: float | None = None
