"""Square crops around an animal that moves through a video (METHOD, section 1).

The square follows the animal smoothly, because each crop has a camera of its own and a camera must not tremble with the
mask. It is laid around the masks of the frames that the method sees; at held-out moments it lies on the straight line
between its neighbours, so nothing of a held-out mask decides what is seen.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from rewild4d.types import Crop

MARGIN = 0.15
"""Free border in all, as a share of the longer side of the animal's box."""
SMOOTH = 2.0
"""Standard deviation of the smoothing in frames."""

Box = tuple[int, int, int, int]


def follow(times: Sequence[float], boxes: Sequence[Box], wanted: Sequence[float], size: tuple[int, int]) -> list[Crop]:
    """Return the squares at some moments of a video.

    Args:
        times: seconds of the frames whose boxes are known, ascending.
        boxes: left, top, right, bottom of the animal in them, pixels.
        wanted: seconds at which a square is asked for, within ``times``.
        size: width and height of the original frames.
    """
    edges = np.asarray(boxes, dtype=np.float64)
    middle = gaussian_filter1d((edges[:, :2] + edges[:, 2:]) / 2, SMOOTH, axis=0, mode="nearest")
    extent = np.maximum(middle - edges[:, :2], edges[:, 2:] - middle).max(axis=1)
    span = 2 * math.ceil(2 * SMOOTH) + 1
    half = gaussian_filter1d(maximum_filter1d(extent, span, mode="nearest"), SMOOTH, mode="nearest", truncate=2.0)
    sides = 2 * (1 + MARGIN) * half
    known = np.asarray(times)
    at = [np.interp(wanted, known, values) for values in (middle[:, 0], middle[:, 1], sides)]
    return [Crop(float(x - side / 2), float(y - side / 2), float(side), *size) for x, y, side in zip(*at, strict=True)]


def cut(rgb: np.ndarray, mask: np.ndarray, crop: Crop, size: int) -> np.ndarray:
    """Return the crop as a premultiplied image, averaged down or enlarged to ``size``, uint8 [size, size, 4].

    Args:
        rgb: the original frame, uint8 [h, w, 3].
        mask: uint8 [h, w].
        crop: may reach over the border; there the image is empty.
        size: of the result in pixels.
    """
    fine = size * max(1, math.ceil(crop.side / size))  # drawn this large, then averaged down by a whole factor
    scale = crop.side / fine
    # Pixel centres at +0.5 here, at whole numbers in OpenCV.
    shift = 0.5 * scale - 0.5
    matrix = np.array(((scale, 0, crop.left + shift), (0, scale, crop.top + shift)))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    matte = cv2.warpAffine(mask, matrix, (fine, fine), flags=flags, borderMode=cv2.BORDER_CONSTANT)
    color = cv2.warpAffine(rgb, matrix, (fine, fine), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    premultiplied = np.empty((fine, fine, 4), dtype=np.float32)
    premultiplied[..., 3] = matte
    np.multiply(color, matte[..., None].astype(np.float32) / 255, out=premultiplied[..., :3])
    small = premultiplied if fine == size else cv2.resize(premultiplied, (size, size), interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)


def lost_share(mask: np.ndarray, crop: Crop) -> float:
    """Return the share of the animal that lies outside a crop, in [0, 1]."""
    solid = mask > 127
    total = int(solid.sum())
    left, top = max(0, math.floor(crop.left)), max(0, math.floor(crop.top))
    right, bottom = max(0, math.ceil(crop.left + crop.side)), max(0, math.ceil(crop.top + crop.side))
    return 1 - int(solid[top:bottom, left:right].sum()) / total if total else 0.0
