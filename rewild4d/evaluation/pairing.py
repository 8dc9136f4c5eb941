"""Match the images of two folders with their truths and masks, on one background."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from rewild4d.datasets.video.footage import Footage, Picture, Reel, match_images, match_reels, open_footage
from rewild4d.errors import UserError
from rewild4d.evaluation.image_scores import ImagePairs
from rewild4d.metrics.samples import LazyImages


@dataclass(frozen=True)
class Inputs:
    """The paths to compare.

    Attributes:
        prediction: a folder of images, a folder of clips, or a video.
        truth: the same.
        masks: true masks, laid out like ``truth``; the truths' own alpha where None.
        prediction_masks: predicted masks, laid out like ``truth``; the predictions' own alpha where None.
        in_order: match in sorted order what shares no name.
    """

    prediction: Path
    truth: Path
    masks: Path | None = None
    prediction_masks: Path | None = None
    in_order: bool = False


@dataclass(frozen=True)
class Match:
    """A sequence of images with its truth and masks, all in the order of the truth."""

    prediction: Reel
    truth: Reel
    masks: Reel | None
    prediction_masks: Reel | None


def on_background(reel: Reel, background: float) -> LazyImages:
    """Return a reel's images on a background, read when asked for, [3, h, w] each."""
    return LazyImages(len(reel), lambda index: reel.picture(index).over(background))


def match_inputs(inputs: Inputs, prediction: Footage, truth: Footage) -> tuple[list[Match], list[str]]:
    """Match every truth with its prediction and masks by name, and note where only the order matched.

    Raises:
        UserError: kinds, names or counts that do not match.
    """
    notes: list[str] = []

    def aligned(footage: Footage) -> list[Reel]:
        reels, said = match_reels(footage, truth, inputs.in_order)
        matched = [match_images(reel, true, inputs.in_order) for reel, true in zip(reels, truth.reels, strict=True)]
        notes.extend([*said, *(note for _, found in matched for note in found)])
        return [reel for reel, _ in matched]

    def masks(path: Path | None) -> Sequence[Reel | None]:
        return aligned(open_footage(path)) if path else [None] * len(truth.reels)

    columns = (aligned(prediction), truth.reels, masks(inputs.masks), masks(inputs.prediction_masks))
    return [Match(*row) for row in zip(*columns, strict=True)], notes


def iterate_pairs(matches: Sequence[Match], background: float) -> Iterator[tuple[str, ImagePairs, tuple[bool, bool]]]:
    """Iterate over images: label, pair, and whether prediction and truth have alpha of their own.

    Raises:
        UserError: an image or a mask that cannot be read, or is of another size than its truth.
    """
    for match in matches:
        for index in range(len(match.truth)):
            prediction, truth = (reel.picture(index) for reel in (match.prediction, match.truth))
            require_size(prediction.label, prediction.rgb, truth)
            shown = ImagePairs(
                prediction=prediction.over(background)[None],
                truth=truth.over(background)[None],
                prediction_matte=_matte(match.prediction_masks, index, prediction, truth),
                truth_matte=_matte(match.masks, index, truth, truth),
                background=background,
            )
            yield truth.label, shown, (prediction.alpha is not None, truth.alpha is not None)


def _matte(masks: Reel | None, index: int, picture: Picture, truth: Picture) -> Tensor | None:
    """Read the matte from a folder of masks, or the picture's own alpha, [1, 1, h, w]."""
    if masks is None:
        return None if picture.alpha is None else picture.alpha[None]
    matte = masks.matte(index)
    require_size(masks.label(index), matte, truth)
    return matte[None]


def require_size(label: str, image: Tensor, truth: Picture) -> None:
    """Raise UserError where an image [c, h, w] has another size than its truth: resizing would change the numbers."""
    if image.shape[1:] != truth.rgb.shape[1:]:
        sizes = [f"{shape[2]}x{shape[1]}" for shape in (truth.rgb.shape, image.shape)]
        raise UserError(f"{label}: expected {sizes[0]} pixels like {truth.label}, got {sizes[1]}.")
