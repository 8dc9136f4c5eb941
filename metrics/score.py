"""Results of a measurement: a score, or a distance between two sets."""

from dataclasses import dataclass

import msgspec


class Score(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One measured quantity.

    Attributes:
        value: mean over ``count`` items; None where it could not be computed.
        unit: "dB", "1" for a ratio, "world" for the data's own unit of length, ...
        better: "higher" or "lower"; "" for a figure that rates nothing.
        count: items that the mean is over.
        per_item: value of each item, in the order of the record's ``items``; None for an item without a value.
        note: why there is no value, or what the mean leaves out.
        floor: value of a perfect result where that is not the best possible value; None where unknown.

    Examples:
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


@dataclass(frozen=True)
class Distance:
    """A distance between two sets, with all that decides its value.

    Attributes:
        name: of the metric; lower is better.
        value: None where it could not be computed.
        n: predicted images or clips.
        m: true ones.
        sequences: that they come from (of the side with fewer).
        estimator: in words.
        interval: 2.5 and 97.5 % of a bootstrap over sequences, or None (too few sequences, or no such estimate).
        note: why there is no value, or a warning.
        extractor, digest, resize, frames: see `metrics.samples.Features`.
        background, crop, fps: see `metrics.samples.Conditions`.
    """

    name: str
    value: float | None
    n: int
    m: int
    sequences: int
    estimator: str
    interval: tuple[float, float] | None
    note: str
    extractor: str
    digest: str
    resize: str
    background: str
    crop: str
    frames: int | None
    fps: float | None
