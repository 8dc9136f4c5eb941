"""Make a clip of a video's whole frames, without a split, to fit a prior to."""

from dataclasses import replace

import numpy as np
import torch

from rewild4d.datasets.masking.facts import mask_facts
from rewild4d.datasets.video.travel import TravelMeter, reduced
from rewild4d.datasets.video.wild import Video, usable
from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.types import Clip, Frame

LONGEST = 960
"""Frames are averaged down to this many pixels on the longer side: a fit looks at 80 pixels of the animal."""


def whole_clip(video: Video) -> Clip:
    """Return the usable frames of a video, averaged down where they are large; times are the video's own.

    Raises:
        UserError: no frame shows the animal, or files that cannot be read.
    """
    facts = [mask_facts(mask) if mask is not None else None for mask in video.masks()]
    used, notes = usable(video, facts)
    meter, frames = TravelMeter(), []
    for index, (image, mask) in enumerate(zip(video.images(), video.masks(), strict=False)):
        if index not in used or mask is None:
            continue
        small, matte = reduced(image, LONGEST), reduced(mask, LONGEST)
        meter.add(small, matte)
        alpha = torch.from_numpy(matte.astype(np.float32))[None] / 255
        rgb = torch.from_numpy(small.astype(np.float32)).permute(2, 0, 1) / 255 * alpha
        points = video.moments[index].keypoints
        points = points and replace(points, points=points.points * (matte.shape[1] / video.size[0]))
        frames.append(Frame(video.moments[index].time, None, rgb, alpha, keypoints=points))
    if len(frames) < len(used):
        raise UserError(f"{video.title}: expected {len(used)} frames to read, got {len(frames)}: it is cut off.")
    travel = meter.result()
    key = digest(*(part for frame in frames for part in (repr(frame.time), frame.mask)), travel)
    return Clip(video.name, video.species, tuple(frames), video.fps, video.licence, key, (*video.notes, *notes),
                travel=travel)  # fmt: skip
