"""Compare sixteen novel views around the animal, as a set, with the frames of the input video.

KID-V uses single images; FVD-F and FVD-Diag, with their kernel companions KVD, use clips. None of them needs a true
view, so they score any reconstruction; all of them need many samples, so every result carries their number.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import torch
from torch import Tensor

from rewild4d.cameras.input_view import finite_at, input_camera, mean_up, world_up
from rewild4d.cameras.orbit import first_across, orbit_cameras
from rewild4d.cameras.rendering import render
from rewild4d.contracts import Log, Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation.coverage import evenly_spaced
from rewild4d.evaluation.networks import family_of
from rewild4d.evaluation.protocol import NovelViews
from rewild4d.metrics.caching import CachedNetwork, cached_features
from rewild4d.metrics.distribution import VIEWS
from rewild4d.metrics.names import KINDS
from rewild4d.metrics.samples import (
    Conditions,
    Distance,
    ImageExtractor,
    Images,
    LazyImages,
    VideoExtractor,
    image_features,
)
from rewild4d.metrics.score import Score
from rewild4d.metrics.sets import Compared, distances, suffix_of
from rewild4d.metrics.video import clip_distances, diagonal_clips, frame_clips, incomparable, video_features
from rewild4d.types import Camera, Clip, Frame

TITLES = {title: name for scores in KINDS.values() for name, title in scores.items()}
"""Title of a distance -> its name among the scores."""


def novel_view_distances(
    reconstruction: Reconstruction,
    clip: Clip,
    settings: NovelViews,
    *,
    names: Sequence[str],
    background: float,
    images: ImageExtractor | None,
    videos: VideoExtractor | None,
    log: Log,
    up: Tensor | None = None,
) -> tuple[list[Distance], list[Compared]]:
    """Compare sixteen novel views with the input video.

    The orbit's centre is the median Gaussian over the clip; its radius and elevation are the medians of the input
    cameras', its first view is in the direction of the first input camera, with that camera's focal lengths and size.

    Args:
        reconstruction: to score.
        clip: the input video, the reference: masked, on the same background, at its own size.
        settings: of the protocol.
        names: out of `metrics.names.SETS`.
        background: grey level in [0, 1] behind both sets.
        images: network of KID-V; None leaves it out.
        videos: network of FVD and KVD; None leaves them out.
        log: progress.
        up: of the world, where the data set knows it, see `world_up`, [3].

    Returns:
        The distances, and the sets of features behind them, for pooling over sequences.

    Raises:
        UserError: neither the clip nor the reconstruction has a camera.
    """
    orbit = _Orbit(reconstruction, clip, background, settings, up)
    reference = [frame.over(background).clamp(0, 1) for frame in clip.frames]
    conditions = Conditions(f"grey {background:g}", "full frame", clip.fps)
    found: list[Distance] = []
    sets: list[Compared] = []

    def progress(done: int, total: int) -> None:
        log(done, total, {})

    if "kid_v" in names and images is not None:
        chosen = evenly_spaced(len(clip.frames), settings.frames)
        shown = LazyImages(len(chosen) * VIEWS, lambda i: orbit.image(i % VIEWS, chosen[i // VIEWS]))
        truth = cached_features(images, reference, lambda network: image_features([reference], network))
        sets.append(Compared("kid_v", image_features([shown], CachedNetwork(images)), truth, conditions))
    windows = _windows(len(clip.frames), settings)
    truths = [[reference[i] for i in window] for window in windows]
    for kind, cut in (("fvd_f", frame_clips), ("fvd_diag", diagonal_clips)):
        if videos is None or not any(name.endswith(kind.removeprefix("fvd")) for name in names):
            continue
        clips = [part for window in windows for part in cut(orbit.matrix(window))]
        if incomparable([clips], [truths], videos):
            suffix = suffix_of(kind)
            found += clip_distances([clips], [truths], videos, paired=False, suffix=suffix, conditions=conditions)
            continue
        truth = cached_features(videos, reference, lambda network: video_features([truths], network), windows)
        made = video_features([clips], CachedNetwork(videos), progress)
        sets.append(Compared(kind, made, truth, conditions))
    found += [distance for compared in sets for distance in distances(compared)]
    return [distance for distance in found if TITLES.get(distance.name.split(" [")[0]) in names], sets


def as_scores(found: Sequence[Distance], names: Sequence[str], missing: dict[str, str]) -> dict[str, Score]:
    """Convert distances to scores of a record; missing ones say why, by family ("kid", "fvd")."""
    by_name = {TITLES[distance.name.split(" [")[0]]: distance for distance in found}
    scores = {}
    for name in names:
        distance = by_name.get(name)
        if distance is None:
            reason = missing.get(family_of(name), "no network")
            scores[name] = Score(None, "1", "lower", 0, [], f"not computed: {reason}")
            continue
        frames = f", T = {distance.frames}" if distance.frames else ""
        note = f"n = {distance.n}, m = {distance.m}{frames}" + (f"; {distance.note}" if distance.note else "")
        if distance.value is None:
            note = distance.note
        scores[name] = Score(distance.value, "1", "lower", distance.n, [], note)
    return scores


class _Orbit:
    """Renders from a closed circle of cameras; the Gaussians of the last few times are cached."""

    def __init__(
        self, reconstruction: Reconstruction, clip: Clip, background: float, settings: NovelViews, up: Tensor | None
    ) -> None:
        self.times, self.background = clip.times, background
        self.at = lru_cache(maxsize=24)(partial(finite_at, reconstruction))
        known = [input_camera(reconstruction, frame) for frame in clip.frames]
        if not any(known) and not len(self.at(self.times[0])):
            known = [_any_camera(clip.frames[0])]
        cameras = [camera for camera in known if camera is not None]
        if not cameras:
            raise UserError(
                "novel views need a camera of the input video, but neither the data nor the method has one."
            )
        if settings.upright:
            cameras = [_centred(camera) for camera in cameras]
        axis = world_up(clip, cameras, up) if settings.upright else mean_up(cameras)
        self.cameras = _cameras(cameras, self._middle(), axis)

    def _middle(self) -> Tensor:
        """Return the median over all Gaussians of some times, [3]; the origin where there are none."""
        means = torch.cat([self.at(self.times[i]).means.double().cpu() for i in evenly_spaced(len(self.times), 8)])
        return means.median(0).values if len(means) else torch.zeros(3, dtype=torch.float64)

    def image(self, view: int, frame: int) -> Tensor:
        """Render one view on the background, [3, h, w]."""
        splats, camera = self.at(self.times[frame]), self.cameras[view]
        if not len(splats):
            return torch.full((3, camera.height, camera.width), self.background)
        color, alpha = render(splats, camera)
        return (color + (1 - alpha) * self.background).clamp(0, 1)

    def matrix(self, window: Sequence[int]) -> list[Images]:
        """Return the image matrix M[v][f] of a window of frames, rendered when read."""

        def row(view: int) -> Images:
            return LazyImages(len(window), lambda i: self.image(view, window[i]))

        return [row(view) for view in range(VIEWS)]


def _any_camera(frame: Frame) -> Camera:
    """Return a camera of the frame's size, for a reconstruction without Gaussians."""
    height, width = frame.mask.shape[1:]
    intrinsics = torch.tensor(((width, 0, width / 2), (0, width, height / 2), (0, 0, 1)), dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 1.0
    return Camera(pose, intrinsics, width, height)


def _centred(camera: Camera) -> Camera:
    """Move the principal point to the middle of the image: a crop's lies where the original's was."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2], intrinsics[1, 2] = camera.width / 2, camera.height / 2
    return replace(camera, intrinsics=intrinsics)


def _cameras(known: Sequence[Camera], middle: Tensor, up: Tensor) -> list[Camera]:
    """Return the sixteen views of a clip, from its input cameras."""
    offsets = torch.stack([camera.center - middle for camera in known])
    radii = offsets.norm(dim=1)
    elevations = torch.asin((offsets @ up / radii.clamp_min(1e-9)).clamp(-1, 1))
    limit = math.radians(80)  # straight above there is no azimuth
    elevation = min(max(float(elevations.median()), -limit), limit)
    first = known[0]
    return orbit_cameras(
        middle, float(radii.median()), elevation, intrinsics=first.intrinsics, width=first.width, height=first.height,
        up=up, ahead=first_across(offsets, up), views=VIEWS,
    )  # fmt: skip


def _windows(frames: int, settings: NovelViews) -> list[list[int]]:
    """Return the frames of each clip: windows of one length, the last at the video's end; a short video is padded."""
    starts = list(range(0, max(0, frames - settings.clip) + 1, settings.stride))
    if starts[-1] + settings.clip < frames:
        starts.append(frames - settings.clip)
    return [[min(start + i, frames - 1) for i in range(settings.clip)] for start in starts]
