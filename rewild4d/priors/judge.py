"""Quality of a prior: mask IoU, joints against annotated keypoints, head and tail, and reasons to doubt it."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rewild4d.contracts import Verdict
from rewild4d.priors.landmarks import FRONT, LANDMARKS, REAR, Marks, landmark_pixels
from rewild4d.priors.silhouettes import mask_box, overlap
from rewild4d.priors.steady import steady
from rewild4d.transforms import skin_points
from rewild4d.types import Camera, Frame, Prior

CORRECT = 0.2
"""A joint is correct within this share of the longer side of the mask's bounding box."""

POOR = 0.6
"""Mask IoU below which the template hardly fits."""
UNDECIDED = 0.01
"""Lead in cost below which head and tail are uncertain."""
AGREED = 0.9
"""Share of frames in which the clip and its mirror image must agree about the heading."""
FITS = 0.75
"""Mask IoU from which on a verdict says that the template fits."""
LEFT_OUT, MOST = 0.25, 0.5
"""Share of frames left out above which a verdict is yellow, and red."""


def measured(prior: Prior, frames: Sequence[Frame]) -> dict[str, float]:
    """Measure a prior with a row for each frame by masks, of which at least one shows something, and cameras.

    Returns:
        mask_iou: mean intersection over union of template and mask; hops: number of frames whose camera is far from the
        others' (`steady`); both also of the mirror image, "<name>_flip"; facing_agreement (`agreement`).
    """
    figures = {"facing_agreement": agreement(prior.cameras, prior.cameras_flip)}
    plain, flipped = [f.mask for f in frames], [f.mask.flip(-1) for f in frames]
    for suffix, cameras, transforms, masks in (
        ("", prior.cameras, prior.transforms, plain),
        ("_flip", prior.cameras_flip, prior.transforms_flip, flipped),
    ):
        posed = skin_points(prior.vertices, prior.weights, transforms)
        figures[f"mask_iou{suffix}"] = overlap(list(posed), prior.faces, cameras, masks)
        figures[f"hops{suffix}"] = float((~steady(cameras, prior.times)).sum())
    return figures


def agreement(cameras: Sequence[Camera], cameras_flip: Sequence[Camera]) -> float:
    """Return the share of frames in which clip and mirror image agree about the heading within 90 degrees.

    Headings are over the ground in the camera's axes x and z.
    """
    heads, flipped = (
        torch.stack([camera.world_to_camera[(0, 2), 2].double() for camera in each]) for each in (cameras, cameras_flip)
    )
    mirror = heads.new_tensor((-1.0, 1.0))
    return float(((heads * flipped * mirror).sum(1) > 0).double().mean())


def doubts(quality: Mapping[str, float]) -> tuple[str, ...]:
    """Return the reasons to doubt a prior that its figures give, a sentence each."""
    found = []
    iou = _worse_iou(quality)
    if iou < POOR:
        found.append(f"the template hardly fits these masks (mask IoU {iou:.2f}, below {POOR:g})")
    agreed, margin = quality.get("facing_agreement", 1.0), quality.get("facing_margin", 1.0)
    if agreed < AGREED:
        found.append(f"head and tail are uncertain: the clip and its mirror image agree in {agreed:.0%} of the frames")
    elif margin < UNDECIDED:
        found.append(f"head and tail are uncertain: the reversed heading costs only {margin:.4f} more")
    return tuple(found)


def prior_verdict(quality: Mapping[str, float], left_out: int, frames: int) -> Verdict | None:
    """Judge a fitted prior; None where nothing was fitted.

    Args:
        quality: figures of its fit (`Prior.quality`).
        left_out: frames that the method was not shown, since their cameras are far from the others'.
        frames: of the clip.
    """
    if "mask_iou" not in quality:
        return None
    iou, share = _worse_iou(quality), left_out / max(1, frames)
    reasons = [*doubts(quality), *([f"{share:.0%} of the frames are left out"] if share > LEFT_OUT else [])]
    if not reasons and iou < FITS:
        reasons = [f"the template fits the masks with IoU {iou:.2f} only"]
    if not reasons:
        return Verdict("prior", "green", f"the template fits the masks (IoU {iou:.2f})")
    is_bad = iou < POOR or share > MOST
    return Verdict("prior", "red" if is_bad else "yellow", "; ".join(reasons), "look at prior-only from four sides")


def _worse_iou(quality: Mapping[str, float]) -> float:
    """Return the lower mask IoU of a clip and of its mirror image."""
    return min(quality.get("mask_iou", 1.0), quality.get("mask_iou_flip", 1.0))


def joint_scores(prior: Prior, frames: Sequence[Frame], found: Marks) -> dict[str, float]:
    """Return the share of correct joints, and of frames with the correct heading, of a prior with a row for each frame.

    Returns:
        pck: share of points within `CORRECT` of the box (Yang & Ramanan 2013); facing: share of the frames with both
        ends annotated in which the direction in the image from the mean rear point to the mean front point agrees
        within 90 degrees; pck_points and facing_frames: their numbers. Empty without points.
    """
    if not len(found):
        return {}
    drawn = landmark_pixels(prior, found)
    boxes = [mask_box(frames[int(row)].mask[0] > 0.5) or (0, 0, 0, 0) for row in found.frames]
    sides = torch.tensor([float(max(right - left, bottom - top)) for left, top, right, bottom in boxes])
    near = (drawn - found.pixels).norm(dim=1) <= CORRECT * sides
    front, rear = _among(found, FRONT), _among(found, REAR)
    agree = []
    for frame in found.frames.unique():
        here = found.frames == frame
        if (here & front).any() and (here & rear).any():
            wanted, got = (
                points[here & front].double().mean(0) - points[here & rear].double().mean(0)
                for points in (found.pixels, drawn)
            )
            agree.append(float(wanted @ got > 0))
    scores = {"pck": float(near.double().mean()), "pck_points": float(len(found))}
    if agree:
        scores |= {"facing": sum(agree) / len(agree), "facing_frames": float(len(agree))}
    return scores


def _among(found: Marks, names: Sequence[str]) -> Tensor:
    """Return which marks are one of the named landmarks, bool, [m]."""
    points = {LANDMARKS[name] for name in names}
    marks = zip(found.bones.tolist(), found.along.tolist(), strict=True)
    return torch.tensor([(bone, round(along, 4)) in points for bone, along in marks])
