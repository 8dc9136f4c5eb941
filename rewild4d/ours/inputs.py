"""All that one training step takes beside the model: the view, and what is drawn at random or follows a schedule."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rewild4d.ours.symmetry import Target

Scalar = float | Tensor
"""A number, or a tensor without dimensions on the GPU."""


@dataclass(frozen=True)
class StepInput:
    """Input of `fit.Training.losses_of`, which draws nothing itself: equal inputs give equal losses.

    Attributes:
        target: image and camera of the view.
        eye: camera centre, [3].
        codes: time codes of the view, or of it and the frames beside it, [B, E].
        flipped: which of them are mirror images, boolean, [B].
        row: of the view among them, [1].
        gaps: frames between them (`skeleton.Neighbours.gaps`), or None.
        prior_pose: the prior's quats [B, J, 4] and shifts [B, J, 3].
        blend: share of the prior's poses in the poses; None for none.
        pull: weight of the distance to the prior's poses; None for none.
        ramp: strength of the deformation; None for none.
        offset: see `DeformNetwork.forward`.
        background: RGB behind render and target, [3].
        direction: of the viewpoint of L_smooth, [3]; None where it does not act.
        degree: of the harmonics in use.
        varies: whether L_tv acts.
        compacts: whether L_compact acts.
        marks: what the view says of each mark (`untold.Marks.views`), [2, k]; empty where there are no marks.
    """

    target: Target
    eye: Tensor
    codes: Tensor
    flipped: Tensor
    row: Tensor
    gaps: Tensor | None
    prior_pose: tuple[Tensor, Tensor]
    blend: Scalar | None
    pull: Scalar | None
    ramp: Scalar | None
    offset: float
    background: Tensor
    direction: Tensor | None
    degree: int
    varies: bool
    compacts: bool
    marks: Tensor

    def to(self, device: torch.device) -> "StepInput":
        """Move all but the target, whose images are there already, to a device."""
        if device.type == "cpu":
            return self
        quats, shifts = self.prior_pose
        return replace(
            self,
            eye=self.eye.to(device),
            codes=self.codes.to(device),
            flipped=self.flipped.to(device),
            row=self.row.to(device),
            gaps=None if self.gaps is None else self.gaps.to(device),
            prior_pose=(quats.to(device), shifts.to(device)),
            background=self.background.to(device),
            direction=None if self.direction is None else self.direction.to(device),
            marks=self.marks.to(device),
        )
