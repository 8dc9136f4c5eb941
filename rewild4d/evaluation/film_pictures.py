"""Score the images of a film under every definition of `metrics.definitions`, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rewild4d.contracts import Log
from rewild4d.evaluation.image_scores import ImagePairs, measure
from rewild4d.evaluation.networks import LpipsNetwork
from rewild4d.metrics.as_published import (
    brightened,
    brightness_errors,
    brightness_factors,
    for_unscaled_network,
    overlap,
    pooled_psnr,
    psnr_of_rmse,
    smoothed_iou,
    ssim_reflected,
)
from rewild4d.metrics.definitions import PICTURES
from rewild4d.metrics.image import WINDOW
from rewild4d.metrics.score import Score
from rewild4d.metrics.tallies import WORST, FrameSums, worst_mean

SMALL = 256
"""Longer side of the pictures of Animal Avatars and 4D-Animal; smaller ones stay as they are."""
CUT = 0.7
"""Above it a pixel of theirs is the animal."""
HALF = 0.5
OWN = ("iou", "psnr_white", "ssim", "lpips_alex")
"""Scores by the definitions of `image_scores`."""


@dataclass(frozen=True)
class Drawn:
    """One frame beside what a reconstruction draws of it.

    Attributes:
        color: drawn, premultiplied by its alpha, [3, h, w].
        alpha: drawn, [1, h, w].
        rgb: true, premultiplied by its mask, [3, h, w].
        mask: true matte, [1, h, w].
    """

    color: Tensor
    alpha: Tensor
    rgb: Tensor
    mask: Tensor

    def small(self) -> Drawn:
        """Return the frame averaged down to `SMALL` pixels along its longer side."""
        height, width = self.mask.shape[1:]
        scale = SMALL / max(height, width)
        if scale >= 1:
            return self
        size = (round(height * scale), round(width * scale))
        return Drawn(*(interpolate(image[None], size, mode="area")[0] for image in vars(self).values()))

    def true_cut(self, mask: Tensor, background: float) -> Tensor:
        """Return the true colours inside of a boolean mask, unmixed at the matte's edge, on grey, [1, 3, h, w]."""
        own = (self.rgb / self.mask.clamp_min(1 / 255)).clamp(0, 1)
        return torch.where(mask, own, background)[None]

    def drawn_on(self, background: float) -> Tensor:
        """Return what is drawn on a background, [1, 3, h, w]."""
        return (self.color + (1 - self.alpha) * background).clamp(0, 1)[None]


@dataclass
class _Found:
    """Values of each frame (None where it has none, such as an empty mask), and sums over all."""

    values: dict[str, list[float | None]] = field(default_factory=dict)
    overlaps: list[FrameSums] = field(default_factory=list)
    squares: float = 0.0
    adjusted: Tensor = field(default_factory=lambda: torch.zeros(len(brightness_factors()), dtype=torch.float64))
    count: int = 0

    def add(self, name: str, value: float | None) -> None:
        """Keep one frame's value; a NaN is none."""
        self.values.setdefault(name, []).append(None if value is None or math.isnan(value) else value)


def score_pictures(
    frames: Sequence[Drawn], lpips: Mapping[str, LpipsNetwork], missing: Mapping[str, str], log: Log
) -> dict[str, Score]:
    """Compute every score of `metrics.definitions.PICTURES`.

    Args:
        frames: in order; each is drawn twice, because the brightness is that of the whole sequence.
        lpips: "lpips_alex" and "lpips_vgg", as far as they are here.
        missing: why one is not here, by family ("lpips-alex", "lpips-vgg").
        log: progress.
    """
    found = _Found()
    for index in range(len(frames)):
        frame = frames[index]
        _own(frame, lpips, found)
        _avatars(frame.small(), lpips, found)
        _sums(frame, lpips, found)
        log(index + 1, 2 * len(frames), {})
    factor = float(brightness_factors()[int(found.adjusted.argmin())])
    for index in range(len(frames)):
        _adjusted(frames[index], factor, lpips, found)
        log(len(frames) + index + 1, 2 * len(frames), {})
    return {name: _score(name, found, factor, missing) for name in PICTURES}


def _own(frame: Drawn, lpips: Mapping[str, LpipsNetwork], found: _Found) -> None:
    target = (frame.rgb + (1 - frame.mask)).clamp(0, 1)[None]
    shown = ImagePairs(frame.drawn_on(1.0), target, frame.alpha[None], frame.mask[None], 1.0)
    for name in OWN:
        if name != "lpips_alex" or name in lpips:
            found.add(name, measure("psnr" if name == "psnr_white" else name, shown, lpips)[0])


def _avatars(frame: Drawn, lpips: Mapping[str, LpipsNetwork], found: _Found) -> None:
    """Add what Animal Avatars and 4D-Animal score: on black, the truth cut out by its hard mask."""
    mask = frame.mask > CUT
    target, prediction = frame.true_cut(mask, 0.0), frame.drawn_on(0.0)
    found.add("iou@0.7", float(smoothed_iou(overlap((frame.alpha > CUT)[None], mask[None]))[0]))
    found.add("psnr_black", float(psnr_of_rmse(prediction, target)[0]))
    found.add("psnrm", float(psnr_of_rmse(prediction, target, mask[None])[0]))
    _learned("lpips_vgg_black", "lpips_vgg", prediction, target, lpips, found)


def _sums(frame: Drawn, lpips: Mapping[str, LpipsNetwork], found: _Found) -> None:
    """Add to the sums that are of the whole sequence."""
    mask = frame.mask >= HALF
    prediction, target = frame.drawn_on(1.0), frame.true_cut(mask, 1.0)
    found.overlaps.append(overlap((frame.alpha >= HALF)[None], mask[None]))
    found.squares += float((prediction - target).double().square().sum())
    found.adjusted += brightness_errors(prediction, target)
    found.count += target.numel()
    _reflected("ssim_reflected", prediction, target, found)
    _unscaled("lpips_alex_unscaled", prediction, target, lpips, found)


def _adjusted(frame: Drawn, factor: float, lpips: Mapping[str, LpipsNetwork], found: _Found) -> None:
    """Add what 4DEquine scores after the brightness of the whole sequence is chosen."""
    prediction, target = brightened(frame.drawn_on(1.0), factor), frame.true_cut(frame.mask >= HALF, 1.0)
    _reflected("ssim_reflected_brightness", prediction, target, found)
    _unscaled("lpips_alex_unscaled_brightness", prediction, target, lpips, found)


def _reflected(name: str, prediction: Tensor, target: Tensor, found: _Found) -> None:
    fits = min(target.shape[2:]) >= WINDOW
    found.add(name, float(ssim_reflected(prediction, target)[0]) if fits else None)


def _unscaled(name: str, prediction: Tensor, target: Tensor, lpips: Mapping[str, LpipsNetwork], found: _Found) -> None:
    _learned(name, "lpips_alex", for_unscaled_network(prediction), for_unscaled_network(target), lpips, found)


def _learned(
    name: str, network: str, prediction: Tensor, target: Tensor, lpips: Mapping[str, LpipsNetwork], found: _Found
) -> None:
    least = {"lpips_alex": 31, "lpips_vgg": 16}[network]
    if network in lpips:
        fits = min(target.shape[2:]) >= least
        found.add(name, float(lpips[network](prediction, target)[0]) if fits else None)


def _score(name: str, found: _Found, factor: float, missing: Mapping[str, str]) -> Score:
    """Return the score of all frames, or why there is none."""
    defined = PICTURES[name]
    worst = name.removesuffix("_worst5")
    items = found.values.get(worst, [])
    values = [item for item in items if item is not None]
    value: float | None = float(np.mean(values)) if values else None
    count, note, reason = len(values), "", "no frame in which it is defined"
    family = next((family for family in missing if name.startswith(family.replace("-", "_"))), None)
    if family is not None:
        reason = missing[family]
    if worst != name:
        value, count = worst_mean(values, defined.better), int(WORST * len(values))
        reason = f"5 % of {len(values)} frames is no frame, it takes 20"
    elif name == "iou_pooled":
        tally = (
            sum(found.overlaps[1:], found.overlaps[0]) if found.overlaps else FrameSums(np.zeros(0), np.zeros(0, int))
        )
        value, count = tally.pooled(), len(found.overlaps)
    elif name.startswith("psnr_pooled"):
        squares = float(found.adjusted.min()) if name.endswith("brightness") else found.squares
        count = len(found.overlaps)
        value = pooled_psnr(squares, found.count) if squares > 0 else None
        reason = "the images are identical, so that it is infinite" if count else reason
    if name.endswith("brightness"):
        note = f"brightness × {factor:.4f}"
    if value is None:
        return Score(None, defined.unit, defined.better, 0, note=f"not computed: {reason}")
    return Score(value, defined.unit, defined.better, count, list(items) if worst == name else [], note)
