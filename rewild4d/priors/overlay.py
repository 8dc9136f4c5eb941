"""Pictures for people: the fitted template over the frames it was fitted to."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from rewild4d.priors.silhouettes import outline
from rewild4d.transforms import skin_points
from rewild4d.types import Clip, Prior

BODY_COLOR, LEFT_COLOR, RIGHT_COLOR = (255, 255, 255), (255, 170, 0), (0, 170, 255)
HEAD_COLOR = (255, 0, 80)


def overlay(clip: Clip, prior: Prior, moments: Sequence[int] | None = None) -> Tensor:
    """Masks in green, the template in magenta (grey where they agree), bones on top.

    Left legs are drawn orange, right legs blue, the spine white and the head red, so that a turned template shows.

    Args:
        clip: the frames.
        prior: a prior with one pose per frame.
        moments: which frames; None is all.

    Returns:
        float32 in [0, 1], [k, 3, h, w].
    """
    pictures = []
    for moment in range(len(clip.frames)) if moments is None else moments:
        frame, camera, transforms = clip.frames[moment], prior.cameras[moment], prior.transforms[moment]
        drawn = outline(skin_points(prior.vertices, prior.weights, transforms), prior.faces, camera)
        mask = (frame.mask[0].numpy() * 255).astype(np.uint8)
        picture = np.ascontiguousarray(np.stack((drawn, mask, drawn), -1) // 2)
        posed = torch.einsum("jab,jkb->jka", transforms[:, :3, :3], prior.bones) + transforms[:, None, :3, 3]
        ends = camera.project(posed.double())[0].round().int().tolist()
        for bone, (start, end) in enumerate(ends):
            cv2.line(picture, start, end, _color(prior, bone), 1, cv2.LINE_AA)
        pictures.append(torch.from_numpy(picture).permute(2, 0, 1).float() / 255)
    return torch.stack(pictures)


def _color(prior: Prior, bone: int) -> tuple[int, int, int]:
    if int(prior.mirror[bone]) != bone:
        return LEFT_COLOR if float(prior.bones[bone, 0, 0]) > 0 else RIGHT_COLOR
    farthest = prior.bones[:, 1, 2].argmax()
    return HEAD_COLOR if bone == int(farthest) else BODY_COLOR
