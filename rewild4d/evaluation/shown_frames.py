"""Hold a reconstruction against the frames that it was fitted to."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from rewild4d.cameras.input_view import input_camera
from rewild4d.cameras.rendering import render
from rewild4d.contracts import Reconstruction
from rewild4d.metrics.silhouette import mask_iou
from rewild4d.types import Clip, Frame

FRAMES = 6
"""Looked at, spread over the clip."""
NEAR, FAR = 0.02, 0.12
"""Distances from the mask's edge, in roots of its area: pixels nearer on both sides are left out, and those farther
outside."""


@dataclass(frozen=True)
class ShownFacts:
    """How a reconstruction agrees with the shown frames, on white, in the mean.

    Attributes:
        iou: overlap of its silhouette and the mask, in [0, 1].
        inside: absolute error of colour inside the mask, in [0, 1].
        beyond: the same in a ring around the mask, where nothing should be.
    """

    iou: float
    inside: float
    beyond: float


@torch.no_grad()
def shown_facts(reconstruction: Reconstruction, clip: Clip) -> ShownFacts | None:
    """Measure some frames of the clip that was fitted; None where none has a camera and a mask."""
    last = len(clip.frames) - 1
    frames = [clip.frames[index] for index in sorted({round(k * last / (FRAMES - 1)) for k in range(FRAMES)})]
    rows = [row for frame in frames if (row := _facts(reconstruction, frame)) is not None]
    if not rows:
        return None
    return ShownFacts(*(float(value) for value in np.mean(rows, axis=0)))


def _facts(reconstruction: Reconstruction, frame: Frame) -> tuple[float, float, float] | None:
    """Return the attributes of `ShownFacts` for one frame."""
    camera, mask = input_camera(reconstruction, frame), (frame.mask[0] > 0.5).numpy()
    if camera is None or not mask.any() or mask.all():
        return None
    color, alpha = (value.cpu() for value in render(reconstruction.at(frame.time), camera))
    error = (color + (1 - alpha) - frame.over(1.0)).abs().mean(0).numpy()
    size = float(np.sqrt(mask.sum()))
    outside, depth = (cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5) for part in (~mask, mask))
    ring, inner = (outside > NEAR * size) & (outside <= FAR * size), depth > NEAR * size
    if not ring.any() or not inner.any():
        return None
    overlap = mask_iou(alpha.reshape(1, 1, *mask.shape), frame.mask[None])
    return float(overlap), float(error[inner].mean()), float(error[ring].mean())
