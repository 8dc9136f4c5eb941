"""Score rendered images against true ones by name: a metric, a region, a unit.

The regions are those of `rewild4d.metrics.image`; LPIPS has no value per pixel and uses `fill_outside`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
from torch import Tensor

from rewild4d.evaluation.networks import LpipsNetwork
from rewild4d.metrics.image import PSNR_CAP, WINDOW, crop_to_box, fill_outside, mask_box, psnr, ssim
from rewild4d.metrics.names import COLOR_METRICS, split_name
from rewild4d.metrics.score import Score
from rewild4d.metrics.silhouette import boundary_f, mask_dice, mask_iou

FOREGROUND = 0.5
"""A pixel belongs to the animal where its matte is at least this."""
SILHOUETTES: dict[str, Callable[[Tensor, Tensor, float], Tensor]] = {
    "iou": mask_iou,
    "dice": mask_dice,
    "boundary_f": boundary_f,
}
_LEAST = {"ssim": WINDOW, "lpips_alex": 31, "lpips_vgg": 16}
"""Least side of an image in pixels."""


@dataclass(frozen=True)
class ImagePairs:
    """Predictions and truths of one size on one background.

    Attributes:
        prediction: in [0, 1], [B, 3, H, W].
        truth: in [0, 1], [B, 3, H, W].
        prediction_matte: in [0, 1], [B, 1, H, W], or None.
        truth_matte: in [0, 1], [B, 1, H, W], or None.
        background: grey level in [0, 1] of both.
    """

    prediction: Tensor
    truth: Tensor
    prediction_matte: Tensor | None
    truth_matte: Tensor | None
    background: float


def needs(name: str) -> tuple[bool, bool]:
    """Return whether a score needs the matte of the truth, and of the prediction."""
    metric, region = split_name(name)
    return metric in SILHOUETTES or region != "full", metric in SILHOUETTES or region == "union"


def measure(name: str, shown: ImagePairs, networks: Mapping[str, LpipsNetwork]) -> list[float | None]:
    """Compute one score of every image.

    Args:
        name: one of `metrics.names.IMAGES`.
        shown: the images.
        networks: "lpips_alex" and "lpips_vgg".

    Returns:
        One value an image; None where a matte is missing or empty, or the image is too small for the metric.
    """
    metric, region = split_name(name)
    absent = [matte is None for matte in (shown.truth_matte, shown.prediction_matte)]
    if any(needed and gone for needed, gone in zip(needs(name), absent, strict=True)):
        return [None] * len(shown.truth)
    if metric in SILHOUETTES:
        assert shown.prediction_matte is not None and shown.truth_matte is not None
        return _items(SILHOUETTES[metric](shown.prediction_matte, shown.truth_matte, FOREGROUND))
    if region == "crop":
        cropped = (_truth_crop(shown, i) for i in range(len(shown.truth)))
        return [_compare(metric, part, None, networks)[0] if part else None for part in cropped]
    return _compare(metric, shown, _region_mask(shown, region), networks)


def summarize(name: str, items: Sequence[float | None]) -> Score:
    """Average over the images that have a value; a score without any says why."""
    metric, _ = split_name(name)
    unit, better = ("1", "higher") if metric in SILHOUETTES else COLOR_METRICS[metric]
    present = [item for item in items if item is not None]
    if not present:
        reason = "no image in which it is defined" if items else "no image"
        return Score(None, unit, better, 0, list(items), f"not computed: {reason}")
    notes = []
    if len(present) < len(items):
        notes.append(f"{len(items) - len(present)} images left out: not defined there")
    if metric == "psnr" and PSNR_CAP in present:
        notes.append(f"{present.count(PSNR_CAP)} identical images counted as {PSNR_CAP:g} dB")
    return Score(math.fsum(present) / len(present), unit, better, len(present), list(items), "; ".join(notes))


def without_value(name: str, reason: str) -> Score:
    """Return a score that could not be computed on any image, with its reason."""
    return msgspec.structs.replace(summarize(name, []), note=f"not computed: {reason}")


def _compare(
    metric: str, shown: ImagePairs, mask: Tensor | None, networks: Mapping[str, LpipsNetwork]
) -> list[float | None]:
    if min(shown.truth.shape[2:]) < _LEAST.get(metric, 1):
        return [None] * len(shown.truth)
    if metric in ("psnr", "ssim"):
        return _items((psnr if metric == "psnr" else ssim)(shown.prediction, shown.truth, mask))
    if mask is None:
        return _items(networks[metric](shown.prediction, shown.truth))
    filled = (fill_outside(images, mask, shown.background) for images in (shown.prediction, shown.truth))
    values = _items(networks[metric](*filled))
    return [value if inside else None for value, inside in zip(values, mask.flatten(1).any(1), strict=True)]


def _region_mask(shown: ImagePairs, region: str) -> Tensor | None:
    if region == "full":
        return None
    assert shown.truth_matte is not None
    mask = shown.truth_matte >= FOREGROUND
    if region == "union":
        assert shown.prediction_matte is not None
        mask = mask | (shown.prediction_matte >= FOREGROUND)
    return mask


def _truth_crop(shown: ImagePairs, index: int) -> ImagePairs | None:
    """Cut one image to its truth's box; None where the truth is empty."""
    assert shown.truth_matte is not None
    box = mask_box(shown.truth_matte[index] >= FOREGROUND)
    if box is None:
        return None
    prediction, truth = (crop_to_box(x[index : index + 1], box) for x in (shown.prediction, shown.truth))
    return replace(shown, prediction=prediction, truth=truth)


def _items(values: Tensor) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.double().tolist()]
