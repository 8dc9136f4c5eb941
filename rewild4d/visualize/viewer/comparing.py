"""A held-out image, our render from its camera, and where they differ."""

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from rewild4d.cameras.input_view import finite_at, input_camera
from rewild4d.metrics.image import psnr
from rewild4d.types import Frame
from rewild4d.visualize.pictures import over
from rewild4d.visualize.viewer.staging import Run

BRIGHTEST = 0.3
"""Mean absolute difference of the channels that is drawn brightest."""


class Comparison(NamedTuple):
    """A held-out image, our render and their difference in false colours, [3, h, w] each, and the PSNR in dB."""

    truth: Tensor
    render: Tensor
    difference: Tensor
    psnr: float


@dataclass
class HeldOut:
    """The held-out frames of a run by view: decoded once to learn which there are, then one at a time."""

    run: Run
    _rows: dict[int, list[tuple[float, int]]] = field(default_factory=dict)

    def views(self) -> list[int]:
        """Return the numbers of the views, in order; of a video there is one."""
        if not self._rows:
            for row, frame in enumerate(self.run.truth.held_out):
                self._rows.setdefault(frame.view, []).append((frame.time, row))
        return sorted(self._rows)

    def nearest(self, view: int, time: float) -> Frame | None:
        """Return the frame of a view whose time is closest; None where the view has none."""
        self.views()
        if view not in self._rows:
            return None
        return self.run.truth.held_out[min(self._rows[view], key=lambda found: abs(found[0] - time))[1]]


def compare(run: Run, frame: Frame) -> Comparison | None:
    """Render a held-out frame's view and compare, on the run's background and by its placement, as in its scores.

    None where nobody knows the frame's camera.
    """
    camera = input_camera(run.reconstruction, frame)
    if camera is None:
        return None
    truth = frame.over(run.background).clamp(0, 1)
    render = over(finite_at(run.reconstruction, frame.time), run.placement.camera(camera), run.background)
    return Comparison(truth, render, _heat((truth - render).abs().mean(0)), float(psnr(render[None], truth[None])))


def _heat(difference: Tensor) -> Tensor:
    """Colour a difference, [h, w] -> [3, h, w]."""
    levels = (difference / BRIGHTEST).clamp(0, 1).mul(255).round().byte().numpy()
    colors = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return torch.from_numpy(np.ascontiguousarray(colors)).permute(2, 0, 1).float() / 255
