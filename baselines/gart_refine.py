"""The second fit of GART*: the pose of one frame by SGD on that frame's image, everything else frozen."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rewild4d.baselines.common.splatting import image_losses, render
from rewild4d.baselines.gart_config import GartStarConfig
from rewild4d.baselines.gart_skeleton import PoseTable
from rewild4d.baselines.gart_skinning import posed
from rewild4d.contracts import Log
from rewild4d.kernels.threads import torch_on_one
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.motion import Root
from rewild4d.ours.symmetry import Target, animal_side
from rewild4d.transforms import camera_in_object
from rewild4d.types import Frame


def refine_step(
    own: Gaussians, weights: Tensor, poses: PoseTable, frame: int, target: Target, step: int, config: GartStarConfig
) -> float:
    """Take one step on the pose of a frame; the background is white, as in the original.

    Args:
        own: canonical Gaussians.
        weights: their skinning weights, [n, J].
        poses: changed in place.
        frame: index of the frame.
        target: its image, and its camera in the object frame.
        step: index of the step within this frame.
        config: of the fit.

    Returns:
        The loss before the step.

    Raises:
        FloatingPointError: the gradient is not finite.
    """
    rgb, alpha, _ = render(own, posed(own, weights, *poses(frame)), target.camera, config.canonical.sh_degree)
    losses = image_losses(rgb, alpha, target, rgb.new_ones(3), config.loss)
    loss = torch.stack(list(losses.values())).sum()
    rate = config.refine.rate * 0.5 ** (step // config.refine.halve_every)
    learned = (poses.turns, poses.shifts)
    for parameter, grad in zip(learned, torch.autograd.grad(loss, learned), strict=True):
        if not torch.isfinite(grad).all():
            raise FloatingPointError(f"frame {frame}, refinement step {step}: the gradient of its pose is not finite")
        parameter.data -= rate * grad
    return float(loss.detach())


def refine_held_out(
    own: Gaussians, weights: Tensor, poses: PoseTable, root: Root, frames: Sequence[Frame], config: GartStarConfig,
    log: Log,
) -> tuple[PoseTable, Root]:  # fmt: skip
    """Fit poses to further frames of the input view, each from the interpolated pose at its time.

    Args:
        own: canonical Gaussians.
        weights: their skinning weights, [n, J].
        poses: of the fitted frames; not changed.
        root: of the fitted frames.
        frames: with cameras in the world; those without an animal or at a fitted time are skipped.
        config: of the fit.
        log: progress.

    Returns:
        Poses and root of all frames, in the order of time.
    """
    known = set(root.times.tolist())
    held = [frame for frame in frames if frame.time not in known and (frame.mask > 0.5).any()]
    for frame in held:
        row = int((root.times < frame.time).sum())
        poses, root = poses.with_frame(row, root.position(frame.time)), root.with_frame(row, frame.time)
    with torch.enable_grad(), torch_on_one():
        for done, frame in enumerate(held):
            row = int((root.times < frame.time).sum())
            target = _target(frame, root.object_to_world[row], weights.device)
            loss = 0.0
            for step in range(config.refine.steps):
                loss = refine_step(own, weights, poses, row, target, step, config)
            log(done + 1, len(held), {"loss": loss})
    return poses, root


def _target(frame: Frame, object_to_world: Tensor, device: torch.device) -> Target:
    assert frame.camera is not None
    camera = camera_in_object(frame.camera, object_to_world).resized(frame.mask.shape[2], frame.mask.shape[1])
    side = animal_side(frame.mask, f"the frame at {frame.time:.4f} s", 0)
    return Target(frame.rgb.float().to(device), frame.mask.float().to(device), camera, side)
