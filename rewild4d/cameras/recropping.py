"""Cameras at times that a method was not shown, for square crops that follow the animal through a video.

A method knows the cameras of the images that it was shown, and interpolates between them
(`contracts.Reconstruction.camera`). Where the prior's filter left frames out, the real image has another crop.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import overload

import numpy as np

from rewild4d.contracts import Reconstruction
from rewild4d.types import Camera, Clip, Crop, Frame, Truth


def crop_between(shown: Clip, time: float) -> Crop | None:
    """Interpolate the crop between those of a clip's frames; None where the clip has none.

    Args:
        shown: frames in order.
        time: seconds; before the first or after the last frame its crop is returned.
    """
    crops = [frame.crop for frame in shown.frames if frame.crop is not None]
    if len(crops) < len(shown.frames):
        return None
    left, top, side = (
        float(np.interp(time, shown.times, values))
        for values in zip(*(astuple(crop)[:3] for crop in crops), strict=True)
    )
    return Crop(left, top, side, crops[0].width, crops[0].height)


def recropped(camera: Camera, shown: Clip, frame: Frame) -> Camera:
    """Return the camera of a frame's image, from one for the interpolated crop at its time.

    Args:
        camera: of a square image.
        shown: the frames behind the camera.
        frame: at any time.
    """
    expected = crop_between(shown, frame.time)
    if frame.crop is None or expected is None or camera.width != camera.height:
        return camera
    if np.allclose(astuple(expected), astuple(frame.crop), rtol=0.0, atol=1e-6):
        return camera
    return frame.crop.cropped_camera(expected.original_camera(camera), camera.width)


def all_moments(clip: Clip, truth: Truth) -> Clip:
    """Merge a video with its held-out frames by time: for files and films of a finished run, never for a method.

    Args:
        clip: of a video; other data, whose held-out views add no times, is returned unchanged.
        truth: its held-out frames.
    """
    if any(frame.crop is None for frame in clip.frames):
        return clip
    shown = {*clip.times}  # a protocol may score the frames that it shows
    hidden = [frame for frame in truth.held_out if frame.time not in shown]
    frames = sorted((*clip.frames, *hidden), key=lambda frame: frame.time)
    return replace(clip, frames=tuple(frames), travel=None)


def add_cameras(reconstruction: Reconstruction, clip: Clip, truth: Truth, shown: Clip) -> tuple[Clip, Truth]:
    """Add the reconstruction's cameras to a clip and its truth wherever the data set has none and the method knows one.

    Args:
        reconstruction: of ``shown``.
        clip: all frames of the video.
        truth: its held-out frames are decoded when they are read.
        shown: the frames of the clip that the method saw.
    """
    placed = WithCameras(reconstruction, shown, clip.frames)
    return replace(clip, frames=tuple(placed)), replace(
        truth, held_out=WithCameras(reconstruction, shown, truth.held_out)
    )


@dataclass(frozen=True)
class WithCameras(Sequence[Frame]):
    """Frames, with a camera of the reconstruction for each that has none of its own."""

    reconstruction: Reconstruction
    shown: Clip
    frames: Sequence[Frame]

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "WithCameras": ...
    def __getitem__(self, index: int | slice) -> "Frame | WithCameras":
        if isinstance(index, slice):
            return replace(self, frames=self.frames[index])
        frame = self.frames[index]
        camera = None if frame.camera else self.reconstruction.camera(frame.time)
        return replace(frame, camera=recropped(camera, self.shown, frame)) if camera else frame
