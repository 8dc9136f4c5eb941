"""Small turns of each frame's joints beside the pose network. A method of ours, not of the paper.

The network's poses are smooth over time, none is exactly that of a frame, and Gaussians that fit all frames blur. A
turn for each joint of each frame lets the frames agree on one sharp animal. Joints are not shifted: one image does not
tell where they are along the line of sight (docs/experiments/tuning.md).
"""

import torch
from torch import Tensor, nn

from rewild4d.transforms import mirror_quats


class Turns(nn.Module):
    """A rotation vector for each joint of each frame, linear between frames.

    Attributes:
        vectors: of images and of their mirror images, radians, object frame, [2, T, J, 3].
        times: of the frames, as in the time code, in (0, 1], [T].
        tied: whether mirror images have the mirrored turns of the images (`Pose.tied`).
    """

    times: Tensor

    def __init__(self, times: Tensor, joints: int, tied: bool = False) -> None:
        super().__init__()
        self.vectors = nn.Parameter(torch.zeros(2, len(times), joints, 3))
        self.tied = tied
        self.register_buffer("times", times.clone())

    def forward(self, times: Tensor, flipped: Tensor, mirror: Tensor) -> Tensor:
        """Compute the turns of views as unit quaternions, by angles of 2 atan(|v| / 2), [B, J, 4].

        Args:
            times: of the views, clamped to those of the frames, [B].
            flipped: which of them are mirror images, boolean, [B].
            mirror: bone on the other side, [J].
        """
        after = torch.searchsorted(self.times, times.contiguous(), right=True).clamp(1, len(self.times) - 1)
        first, last = self.times[after - 1], self.times[after]
        part = ((times - first) / (last - first)).clamp(0, 1)[:, None, None]
        side = torch.zeros_like(after) if self.tied else flipped.long()
        vectors = torch.lerp(self.vectors[side, after - 1], self.vectors[side, after], part)
        ones = torch.ones_like(vectors[..., :1])
        quats = nn.functional.normalize(torch.cat((ones, 0.5 * vectors), dim=-1), dim=-1)
        return torch.where(flipped[:, None, None], mirror_quats(quats[:, mirror]), quats) if self.tied else quats
