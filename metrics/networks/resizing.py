"""Resize images and clips to a network's input. The method changes FID and KID, so a score names it."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

IMAGE_RESIZES = ("clean", "tf1", "bilinear-antialias")
VIDEO_RESIZES = ("short-side-crop", "square")


def resize_images(images: Tensor, size: int, how: str) -> Tensor:
    """Stretch images [B, C, H, W] of any range to a square of a size in pixels; bicubic may leave their range.

    "clean" is the antialiased bicubic of clean-fid (Parmar et al. 2022), which is Pillow's on floats; "tf1" is the
    bilinear of TensorFlow 1, without half-pixel centres and antialiasing, of the first FID and torch-fidelity;
    "bilinear-antialias" is that of torchmetrics 1.9.
    """
    if images.shape[2:] == (size, size):
        return images
    if how == "tf1":
        return _bilinear_tf1(_bilinear_tf1(images, size).mT, size).mT
    mode = {"clean": "bicubic", "bilinear-antialias": "bilinear"}[how]
    return F.interpolate(images, (size, size), mode=mode, align_corners=False, antialias=True)


def _bilinear_tf1(images: Tensor, size: int) -> Tensor:
    """Interpolate along the last axis: output i reads position i * length / size."""
    length = images.shape[-1]
    position = torch.arange(size, dtype=images.dtype, device=images.device) * (length / size)
    low = position.long().clamp_max(length - 1)
    high = (low + 1).clamp_max(length - 1)
    return torch.lerp(images[..., low], images[..., high], position - low)


def resize_clip(frames: Tensor, size: int, how: str) -> Tensor:
    """Resize frames [T, C, H, W] to a square of a size in pixels, bilinear without antialiasing, half-pixel centres.

    "short-side-crop" scales the shorter side to the size and crops the centre (StyleGAN-V); "square" stretches (TATS).
    """
    height, width = frames.shape[2:]
    if how == "square":
        return F.interpolate(frames, (size, size), mode="bilinear", align_corners=False)
    scale = size / min(height, width)
    target = (size, math.ceil(width * scale)) if height < width else (math.ceil(height * scale), size)
    scaled = F.interpolate(frames, target, mode="bilinear", align_corners=False)
    top, left = (target[0] - size) // 2, (target[1] - size) // 2
    return scaled[..., top : top + size, left : left + size]
