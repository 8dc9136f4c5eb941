"""Pictures of the fitted template over its frames."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import imageio.v2 as imageio
import numpy as np
import torch
from torch import Tensor

from rewild4d.files import atomic
from rewild4d.priors.silhouettes import mask_box, outline
from rewild4d.transforms import skin_points
from rewild4d.types import Clip, Prior

BODY_COLOR, LEFT_COLOR, RIGHT_COLOR = (255, 255, 255), (255, 170, 0), (0, 170, 255)
HEAD_COLOR = (255, 0, 80)


def overlay(clip: Clip, prior: Prior, rows: Sequence[int] | None = None, photo: float = 0.0) -> Tensor:
    """Draw masks in green, the template in magenta (grey where they agree), bones on top.

    Left legs are drawn orange, right legs blue, the spine white and the head red.

    Args:
        clip, prior: frames, and a pose for each.
        rows: indices of the frames; None is all.
        photo: share of the animal's picture in the colours under the bones, from 0 to 1.

    Returns:
        float32 in [0, 1], [k, 3, h, w].
    """
    pictures = []
    for row in range(len(clip.frames)) if rows is None else rows:
        frame, camera, transforms = clip.frames[row], prior.cameras[row], prior.transforms[row]
        drawn = outline(skin_points(prior.vertices, prior.weights, transforms), prior.faces, camera)
        mask = (frame.mask[0].numpy() * 255).astype(np.uint8)
        shades = np.stack((drawn, mask, drawn), -1) * (0.5 * (1 - photo))
        picture = np.ascontiguousarray(shades + photo * 255 * frame.rgb.permute(1, 2, 0).numpy()).astype(np.uint8)
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


def save_overlay(clip: Clip, prior: Prior, beside: Path, side: int = 320) -> list[Path]:
    """Write overlays cropped to the animal: of twelve frames to <beside>.png, of all as a video to <beside>.mp4.

    ``side`` is that of a tile in pixels. Returns the two paths.
    """
    tiles: list[Any] = [_tile(clip, prior, row, side) for row in range(len(clip.frames))]
    shown = [tiles[i] for i in np.linspace(0, len(tiles) - 1, min(12, len(tiles))).round().astype(int)]
    shown += [np.zeros_like(tiles[0])] * (-len(shown) % 4 if len(shown) > 4 else 0)
    rows = [np.concatenate(shown[i : i + 4], axis=1) for i in range(0, len(shown), 4)]
    picture, video = beside.with_suffix(".png"), beside.with_suffix(".mp4")
    with atomic(picture) as temporary:
        imageio.imwrite(temporary, np.concatenate(rows), format="png")
    with atomic(video) as temporary:
        settings: Any = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        imageio.mimwrite(temporary, tiles, fps=clip.fps, **settings)
    return [picture, video]


def _tile(clip: Clip, prior: Prior, row: int, side: int) -> np.ndarray:
    """Return the square around the animal: its dimmed picture under the overlay, uint8 [side, side, 3]."""
    drawn = overlay(clip, prior, [row], photo=0.5)[0]
    box = mask_box(torch.maximum(clip.frames[row].mask[0], drawn.amax(0)) > 0.2)
    if box is None:
        return np.zeros((side, side, 3), np.uint8)
    left, top, right, bottom = box
    half, x, y = 0.55 * max(bottom - top, right - left), (left + right) / 2, (top + bottom) / 2
    matrix = np.array(((2 * half / side, 0, x - half), (0, 2 * half / side, y - half)))
    image = (drawn.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    return cv2.warpAffine(image, matrix, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
