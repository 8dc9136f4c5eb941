"""Fit a prior to a clip: image size, square crops, times, and cameras for frames without one."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rewild4d.cameras.recropping import recropped
from rewild4d.errors import UserError
from rewild4d.priors.io import seal
from rewild4d.priors.motion import camera_at, pose_at, world_camera
from rewild4d.priors.silhouettes import require_mask
from rewild4d.transforms import camera_in_object
from rewild4d.types import Camera, Clip, Prior

SAME = 0.1
"""Times are equal within this share of the clip's frame interval."""
NEAR = 0.01
"""Cameras are equal where they project every joint within this share of the image's longer side."""


def resized(prior: Prior, width: int, height: int) -> Prior:
    """Return the same prior for frames of another size."""
    cameras, flipped = (
        tuple(camera.resized(width, height) for camera in each) for each in (prior.cameras, prior.cameras_flip)
    )
    return seal(replace(prior, cameras=cameras, cameras_flip=flipped))


def placed(prior: Prior, clip: Clip) -> Prior:
    """Fit a prior from a file to the frames of a clip with unknown cameras.

    It may be for the clip's own images (then its times are the clip's) or for whole frames of the video that the clip
    was cut from (then they are the video's). Frames that it lacks are interpolated.

    Raises:
        UserError: it is for images of another size, or for other times.
    """
    first, frame = prior.cameras[0], clip.frames[0]
    sizes = {(camera.width, camera.height) for camera in (*prior.cameras, *prior.cameras_flip)}
    size, crop = (frame.mask.shape[2], frame.mask.shape[1]), frame.crop
    if sizes == {size} and (crop is None or size != (crop.width, crop.height)):
        return at_times(prior, clip.times, clip)
    if crop is None:
        raise UserError(
            f"{clip.name}: expected a prior for images of {size[0]}x{size[1]} pixels, but prior '{prior.name}' is for "
            f"{first.width}x{first.height}."
        )
    return in_crops(at_times(prior, [time + clip.start for time in clip.times], clip), clip)


def in_world(prior: Prior, clip: Clip, file: str) -> Prior:
    """Fit a prior from a file to a clip with known cameras: at its times, seen by its cameras.

    Raises:
        UserError: it is for other times, or its cameras and `object_to_world` contradict the clip's cameras, or no mask
            shows the animal.
    """
    require_mask(clip.frames, clip.name)
    try:
        found = at_times(prior, clip.times, clip)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    cameras, flipped = [], []
    for row, frame in enumerate(clip.frames):
        assert frame.camera is not None
        width, height = frame.camera.width, frame.camera.height
        cameras.append(camera_in_object(frame.camera, found.object_to_world[row]))
        flipped.append(found.cameras_flip[row].resized(width, height))
        apart = _apart(found, row, found.cameras[row].resized(width, height), cameras[-1])
        is_known = float((prior.times - frame.time).abs().min()) * clip.fps <= SAME
        if is_known and not apart <= NEAR * max(width, height):
            raise UserError(
                f"{file}: expected a prior whose cameras agree with those of {clip.name}, but at {frame.time:.3f} s "
                f"they put the template's joints up to {apart:.3g} pixels apart (was it made for this clip, and with "
                "known cameras?)."
            )
    return seal(replace(found, cameras=tuple(cameras), cameras_flip=tuple(flipped)))


def _apart(prior: Prior, row: int, first: Camera, second: Camera) -> float:
    """Return the largest distance between the projections of a posed bone's end by two cameras, pixels."""
    transforms = prior.transforms[row].double()
    ends = prior.bones.double() @ transforms[:, :3, :3].transpose(1, 2) + transforms[:, None, :3, 3]
    return float((first.project(ends)[0] - second.project(ends)[0]).norm(dim=-1).max())


def at_times(prior: Prior, times: Sequence[float], clip: Clip) -> Prior:
    """Return the prior with a row for each of the clip's frames, and the clip's times; a note counts interpolated rows.

    ``times`` are those of the frames in the prior's time, seconds.

    Raises:
        UserError: the prior does not span the times, or has less than half of them.
    """
    wanted = torch.tensor(times, dtype=torch.float64)
    apart, rows = (prior.times[:, None] - wanted).abs().min(0)
    between = [row for row, distance in enumerate((apart * clip.fps).tolist()) if distance > SAME]
    low, high = float(prior.times[0]), float(prior.times[-1])
    outside = (wanted < low - 1 / clip.fps) | (wanted > high + 1 / clip.fps)
    if bool(outside.any()) or 2 * len(between) > len(wanted):
        raise UserError(
            f"{clip.name}: expected a prior that knows its {len(wanted)} frames from {wanted[0]:.3f} to "
            f"{wanted[-1]:.3f} s, but prior '{prior.name}' has {len(prior.times)} from {low:.3f} to {high:.3f} s, of "
            f"which {len(wanted) - len(between)} are at their times (was it made with another --fps?)."
        )
    note = f"{len(between)} of {len(wanted)} frames are not in the prior's file: cameras and poses lie between those of"
    taken = prior.times[rows]
    taken[between] = wanted[between]
    roots, transforms, cameras = _sampled(prior, taken)
    mirrored = replace(prior, cameras=prior.cameras_flip, transforms=prior.transforms_flip)
    _, transforms_flip, cameras_flip = _sampled(mirrored, taken)
    return seal(
        replace(
            prior,
            times=torch.tensor(clip.times, dtype=torch.float64),
            object_to_world=roots,
            transforms=transforms,
            cameras=cameras,
            cameras_flip=cameras_flip,
            transforms_flip=transforms_flip,
            notes=(*prior.notes, *([f"{note} its neighbours"] if between else [])),
        )
    )


def _sampled(prior: Prior, times: Tensor) -> tuple[Tensor, Tensor, tuple[Camera, ...]]:
    """Return object_to_world, transforms and cameras at some times."""
    roots, transforms = zip(*(pose_at(prior, time) for time in times.tolist()), strict=True)
    return torch.stack(roots), torch.stack(transforms), tuple(camera_at(prior, time) for time in times.tolist())


def in_crops(prior: Prior, clip: Clip) -> Prior:
    """Convert a prior of whole frames, with a row for each of the clip's, for a clip of square crops of them.

    Raises:
        UserError: a frame is no crop, or the prior is for frames of another size.
    """
    cameras, flipped = [], []
    for row, frame in enumerate(clip.frames):
        plain, crop, size = prior.cameras[row], frame.crop, frame.mask.shape[2]
        if crop is None or (plain.width, plain.height) != (crop.width, crop.height):
            came = "a whole frame" if crop is None else f"a crop of {crop.width}x{crop.height} pixels"
            raise UserError(
                f"{clip.name}: expected crops of {plain.width}x{plain.height} frames as prior '{prior.name}' knows, "
                f"got {came}."
            )
        cameras.append(crop.cropped_camera(plain, size))
        # flipping the frame swaps the crop's distances from the left and the right border
        mirrored = replace(crop, left=crop.width - crop.left - crop.side)
        flipped.append(mirrored.cropped_camera(prior.cameras_flip[row], size))
    return seal(replace(prior, cameras=tuple(cameras), cameras_flip=tuple(flipped)))


def has_cameras(clip: Clip) -> bool:
    """Tell whether all cameras of the clip are known."""
    return all(frame.camera is not None for frame in clip.frames)


def with_cameras(clip: Clip, prior: Prior) -> Clip:
    """Return the clip with the prior's cameras, by time and in the prior's world, for frames without one."""
    if has_cameras(clip):
        return clip
    shown = known_frames(clip, prior)
    frames = tuple(
        replace(frame, camera=frame.camera or recropped(world_camera(prior, frame.time), shown, frame))
        for frame in clip.frames
    )
    return replace(clip, frames=frames, guessed_cameras=True)


def known_frames(clip: Clip, prior: Prior) -> Clip:
    """Return the clip's frames that have a camera or a row in the prior: a filtered prior lacks unreliable ones."""
    if has_cameras(clip):
        return clip
    distance = (torch.tensor(clip.times, dtype=torch.float64)[:, None] - prior.times).abs().min(1).values
    rows = torch.nonzero(distance * clip.fps <= SAME)[:, 0].tolist()
    if len(rows) == len(clip.frames) or not rows:
        return clip
    return clip.only(rows)
