"""Sets of images or clips as feature rows, and the distance between two sets.

Any callable with a name, a digest and a resize rule is an extractor; metrics on its features carry its name.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from rewild4d.metrics.networks.layers import check_range
from rewild4d.metrics.score import Distance

ORIGINAL = ("inception-fid", "i3d-k400")
"""Networks under which a metric keeps its plain name; under any other the network's name is added."""
_BATCH = 16
T = TypeVar("T")
Progress = Callable[[int, int], None]
"""Function of (done, total)."""


class Images(Protocol):
    """Images in order, each [3, H, W] in [0, 1], read when asked for: a tensor [n, 3, H, W], a list, `LazyImages`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Tensor: ...


class LazyImages:
    """A number of images, each made by a function of its index when asked for.

    Examples:
        >>> images = LazyImages(2, lambda i: torch.full((3, 4, 4), i / 2))
        >>> len(images), images[1].mean().item()
        (2, 0.5)
    """

    def __init__(self, count: int, make: Callable[[int], Tensor]) -> None:
        self.count, self.make = count, make

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> Tensor:
        if not 0 <= index < self.count:
            raise IndexError(index)
        return self.make(index)


class ImageExtractor(Protocol):
    """Network of a metric on sets of images; see `rewild4d.metrics.features` on bringing one's own."""

    name: str
    digest: str
    resize: str

    def __call__(self, images: Tensor, /) -> Tensor:
        """[B, 3, H, W] in [0, 1] -> [B, D]."""


class VideoExtractor(Protocol):
    """Network of a metric on sets of clips; see `rewild4d.metrics.features` on bringing one's own."""

    name: str
    digest: str
    resize: str
    minimum_frames: int

    def __call__(self, videos: Tensor, /) -> Tensor:
        """[B, T, 3, H, W] in [0, 1] -> [B, D]."""


class MeanColor:
    """Toy extractor of images and clips for examples: the mean of each channel.

    Examples:
        >>> MeanColor()(torch.ones(2, 3, 4, 4)).tolist()
        [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """

    name, digest, resize, minimum_frames = "mean-color", "", "none", 1

    def __call__(self, images: Tensor, /) -> Tensor:
        """[B, 3, H, W] or [B, T, 3, H, W] -> [B, 3]."""
        return images.mean((-2, -1)).reshape(len(images), -1, 3).mean(1)


@dataclass(frozen=True)
class Conditions:
    """What both sets must share to be comparable; it is copied into the result.

    Attributes:
        background: behind the animal ("white", "as filmed", ...).
        crop: part of the frame that the network sees.
        fps: frames a second of the clips; None for still images or where unknown.
    """

    background: str = "as given"
    crop: str = "full frame"
    fps: float | None = None


@dataclass(frozen=True)
class Features:
    """Feature rows of a set of images or clips.

    Attributes:
        values: one row an image or clip, float64 on the CPU, [n, D].
        groups: sequence of each row, int64, [n].
        extractor: the network's name.
        digest: SHA-256 of its weights.
        resize: how images reach its input size.
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
    """Compute the features of every image, sequence by sequence.

    Args:
        sequences: one entry a sequence (an animal's clip, an orbit of views); images [3, H, W] in [0, 1], of any size.
        extractor: [B, 3, H, W] in [0, 1] -> [B, D].
        progress: called after every batch.

    Raises:
        ValueError: an image is not [3, H, W], not float, or leaves [0, 1].

    Examples:
        >>> found = image_features([torch.zeros(2, 3, 4, 4), torch.ones(1, 3, 8, 8)], MeanColor())
        >>> found.values[:, 0].tolist(), found.groups.tolist()
        ([0.0, 0.0, 1.0], [0, 0, 1])
    """
    indices = [(group, i) for group, images in enumerate(sequences) for i in range(len(images))]
    images = (require_image(sequences[group][i]) for group, i in indices)
    rows: list[Tensor] = []
    for batch in batches(images, _BATCH, lambda image: image.shape):
        rows.append(extractor(torch.stack(batch)).double().cpu())
        if progress is not None:
            progress(sum(map(len, rows)), len(indices))
    values = torch.cat(rows) if rows else torch.zeros(0, 0, dtype=torch.float64)
    groups = torch.tensor([group for group, _ in indices], dtype=torch.int64)
    return Features(values, groups, extractor.name, extractor.digest, extractor.resize)


def batches(items: Iterable[T], size: int, key: Callable[[T], Any]) -> Iterator[list[T]]:
    """Group neighbours with one key into lists of at most a size, in order.

    Examples:
        >>> list(batches("aaabba", 2, str))
        [['a', 'a'], ['a'], ['b', 'b'], ['a']]
    """
    for _, group in groupby(items, key):
        while batch := list(islice(group, size)):
            yield batch


def require_image(image: Tensor) -> Tensor:
    """Check an image, [3, H, W] in [0, 1], and return it; 0..255 or another layout gives a plausible, wrong number.

    Raises:
        ValueError: another shape, type or range.

    Examples:
        >>> require_image(torch.full((3, 2, 2), 255.0))
        Traceback (most recent call last):
        ValueError: expected values in [0, 1], got 255 to 255
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
    """Build a distance with the metadata of its two sets."""
    return Distance(
        name=name if prediction.extractor in ORIGINAL else f"{name} [{prediction.extractor}]",
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
        frames=prediction.frames,
        **vars(conditions),
    )


def not_computed(prediction: Features, truth: Features, least: int = 2) -> str:
    """Return why no distance between two sets can be computed, or "".

    Args:
        prediction: one set.
        truth: the other.
        least: rows a side that the estimator needs.

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
