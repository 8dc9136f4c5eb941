"""Sets of images or clips as feature rows, and the result that a distance between two sets gives.

The hooks are open: any callable with a name, a digest and a resize rule is an extractor; its metrics carry its name.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from rewild4d.metrics.networks.layers import check_range
from rewild4d.metrics.score import Distance

ORIGINAL = ("inception-fid", "i3d-k400")
"""Networks under which a metric has its plain name; under any other the network's name stands behind it."""
_BATCH = 16

Progress = Callable[[int, int], None]
"""Called with how many are done, of how many."""


class Images(Protocol):
    """Images in order, each [3, H, W] in [0, 1], read when asked for: a tensor [n, 3, H, W], a list, a lazy reader."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Tensor: ...


class ImageExtractor(Protocol):
    """What `rewild4d.metrics.features.Extractor` is, as far as it is needed here: bring your own."""

    name: str
    digest: str
    resize: str

    def __call__(self, images: Tensor, /) -> Tensor:
        """[B, 3, H, W] in [0, 1] -> [B, D]."""


@dataclass(frozen=True)
class Conditions:
    """What both sets must share for a distance to mean anything; it is copied into the result.

    Attributes:
        background: what lies behind the animal ("white", "as filmed", ...).
        crop: which part of the frame was fed.
        fps: frames a second of the clips; None for still images or where nobody knows it.
    """

    background: str = "as given"
    crop: str = "full frame"
    fps: float | None = None


@dataclass(frozen=True)
class Features:
    """What a network says of a set of images or clips.

    Attributes:
        values: one row an image or clip, float64 on the CPU, [n, D].
        groups: which sequence each row belongs to, int64, [n].
        extractor: the network's name.
        digest: SHA-256 of its weights.
        resize: how images were brought to its input size.
        frames: T of the clips; None for still images.
    """

    values: Tensor
    groups: Tensor
    extractor: str
    digest: str
    resize: str
    frames: int | None = None


def image_features(
    sequences: Sequence[Images], extractor: ImageExtractor, progress: Progress | None = None
) -> Features:
    """The features of every image, sequence by sequence.

    Args:
        sequences: one entry a sequence (an animal's clip, a turn around it); images [3, H, W] in [0, 1], of any size.
        extractor: [B, 3, H, W] in [0, 1] -> [B, D].
        progress: called after every batch.

    Raises:
        ValueError: an image is not [3, H, W], not float, or leaves [0, 1].
    """
    places = [(group, i) for group, images in enumerate(sequences) for i in range(len(images))]
    rows: list[Tensor] = []
    batch: list[Tensor] = []
    for group, i in places:
        image = require_image(sequences[group][i])
        if batch and (len(batch) == _BATCH or image.shape != batch[0].shape):
            rows.append(extractor(torch.stack(batch)).double().cpu())
            batch = []
            if progress is not None:
                progress(sum(map(len, rows)), len(places))
        batch.append(image)
    if batch:
        rows.append(extractor(torch.stack(batch)).double().cpu())
        if progress is not None:
            progress(len(places), len(places))
    values = torch.cat(rows) if rows else torch.zeros(0, 0, dtype=torch.float64)
    groups = torch.tensor([group for group, _ in places], dtype=torch.int64)
    return Features(values, groups, extractor.name, extractor.digest, extractor.resize)


def require_image(image: Tensor) -> Tensor:
    """The image itself, [3, H, W] in [0, 1]; 0..255 or another layout would give a plausible, wrong number.

    Raises:
        ValueError: anything else.
    """
    if image.ndim != 3 or image.shape[0] != 3 or not image.is_floating_point():
        raise ValueError(f"expected a float image of shape [3, H, W], got {image.dtype} {tuple(image.shape)}")
    check_range(image)
    return image


def describe(
    name: str,
    value: float | None,
    prediction: Features,
    truth: Features,
    *,
    estimator: str,
    notes: Sequence[str],
    conditions: Conditions,
    interval: tuple[float, float] | None = None,
) -> Distance:
    """A distance with what its two sets know of themselves."""
    return Distance(
        name=plain_name(name, prediction.extractor),
        value=value,
        n=len(prediction.values),
        m=len(truth.values),
        sequences=min(len(features.groups.unique()) for features in (prediction, truth)),
        estimator=estimator,
        interval=interval,
        note="; ".join(notes),
        extractor=prediction.extractor,
        digest=prediction.digest,
        resize=prediction.resize,
        background=conditions.background,
        crop=conditions.crop,
        frames=prediction.frames,
        fps=conditions.fps,
    )


def not_computed(prediction: Features, truth: Features, least: int = 2) -> str:
    """Why no distance between two sets can be computed, or ""; an estimator needs at least so many rows a side.

    Raises:
        ValueError: the two sets come from different networks or resize rules.
    """
    ways = [(features.extractor, features.digest, features.resize) for features in (prediction, truth)]
    if ways[0] != ways[1]:
        raise ValueError(f"expected features of one network, got {ways[0]} and {ways[1]}")
    if prediction.frames != truth.frames:
        return f"not computed: clips of {prediction.frames} and {truth.frames} frames, and only equal lengths compare"
    n, m = len(prediction.values), len(truth.values)
    return "" if min(n, m) >= least else f"not computed: at least {least} samples a side are needed, got {n} and {m}"


def plain_name(name: str, extractor: str) -> str:
    """A metric keeps its plain name under its original network only: "KID", but "KID [mine]"."""
    return name if extractor in ORIGINAL else f"{name} [{extractor}]"
