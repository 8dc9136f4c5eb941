"""Score a reconstruction by a protocol: render, composite, align, compare."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import torch
from torch import Tensor

from rewild4d.cameras.input_view import finite_at, input_camera
from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.cameras.rendering import render
from rewild4d.contracts import Clouds, HeldOut, Log, NotComputed, Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation import definitions, geometry_scores, image_scores, novel_views, placing
from rewild4d.evaluation.networks import Networks, families_of, family_of, load_networks
from rewild4d.evaluation.plugged import Source, score_plugged
from rewild4d.evaluation.protocol import Protocol
from rewild4d.io.sampling import sample_gaussians
from rewild4d.metrics import names
from rewild4d.metrics.samples import batches
from rewild4d.metrics.score import Distance, Score
from rewild4d.metrics.sets import FILE, Compared, write_features
from rewild4d.types import Clip, Frame, Truth

POINTS = 20_000
"""Points of each cloud that metrics of other packages get where the protocol names no number."""


class Evaluation(NamedTuple):
    """Result of an evaluation.

    Attributes:
        scores: by name.
        items: label of each held-out image, as in ``Score.per_item`` of image scores.
        distances: between sets of images or clips.
        alignments: of the shapes with the truth.
        networks: SHA-256 of the weights of every network used.
        sets: the features behind ``distances``.
        metrics: of each score that is another package's: what the record says of it.
    """

    scores: dict[str, Score]
    items: list[str]
    distances: list[Distance]
    alignments: list[dict[str, Any]]
    networks: dict[str, str]
    sets: list[Compared]
    metrics: dict[str, dict[str, str]]

    def keep(self, folder: Path) -> dict[str, Any]:
        """Return the fields of a record, and write the features of sets into its folder (`metrics.sets.pool`)."""
        fields = self._asdict()
        sets = fields.pop("sets")
        return fields | {"features": write_features(sets, folder / FILE) if sets else ""}


def evaluate(
    reconstruction: Reconstruction, clip: Clip, truth: Truth, protocol: Protocol, log: Log, device: torch.device
) -> Evaluation:
    """Score a reconstruction by all that a protocol asks for, then by the metrics of other packages.

    Args:
        reconstruction: of the clip.
        clip: input of the method: the reference of novel views, and the times at which shapes are compared.
        truth: held out from the method.
        protocol: what is measured.
        log: progress.
        device: of the metric networks.
    """
    networks = load_networks(families_of(protocol.scores), device)
    points = protocol.points or 0
    placed = placing.Placed()
    if protocol.free_scale:
        placed = placing.free_scale(reconstruction, clip, truth, points)
    shape = [name for name in protocol.scores if name in names.GEOMETRY]
    scores, alignments = geometry_scores.score_geometry(
        reconstruction, truth, clip.times, shape, points, placement=placed.scale, even=bool(protocol.even_alignment)
    )
    scores[names.SCALE] = placing.scale_score(placed)
    drawn = {"": placed.scale, names.RIGID: placed.rigid}
    measured, items = _score_images(reconstruction, truth, protocol, networks, log, drawn)
    scores |= measured
    alignments += placed.alignments
    film = [name for name in protocol.scores if name in names.FILM]
    if film:
        scores |= definitions.film_scores(reconstruction, truth.held_out, protocol.dataset, networks, log, film)
    sets = [name for name in protocol.scores if name in names.SETS]
    distances: list[Distance] = []
    compared: list[Compared] = []
    if protocol.novel is not None and sets:
        distances, compared = novel_views.novel_view_distances(
            reconstruction, clip, protocol.novel, names=sets, background=protocol.background,
            images=networks.images, videos=networks.videos, log=log, up=truth.up,
        )  # fmt: skip
        scores |= novel_views.as_scores(distances, sets, dict(networks.missing))
    used = {name: network.digest for name, network in networks.lpips.items()}
    used |= {distance.extractor: distance.digest for distance in distances}
    found = {name: scores[name] for name in protocol.scores}
    added, metrics = score_plugged(_sources(reconstruction, clip, truth, protocol, placed.scale))
    return Evaluation(found | added, items, distances, alignments, used, compared, metrics)


@torch.no_grad()
def input_psnr(reconstruction: Reconstruction, shown: Clip, background: float) -> Score:
    """Compute PSNR over the full input frames: with the held-out PSNR it tells lack of freedom from lack of evidence.

    Args:
        reconstruction: of the clip.
        shown: input of the method, with cameras where the reconstruction knows none.
        background: grey level in [0, 1] behind prediction and truth alike.
    """
    values: list[float | None] = []
    for batch in batches(shown.frames, 16, _size):
        beside = _beside(batch, list(_render_frames(reconstruction, batch)), background)
        values += image_scores.measure("psnr", beside, {})
    return image_scores.summarize("psnr", values)


def _score_images(
    reconstruction: Reconstruction,
    truth: Truth,
    protocol: Protocol,
    networks: Networks,
    log: Log,
    placed: Mapping[str, Placement],
) -> tuple[dict[str, Score], list[str]]:
    """Compute the scores of held-out images, and the label of each image.

    Args:
        reconstruction: to render.
        truth: with the images.
        protocol: what is measured.
        networks: of LPIPS.
        log: progress.
        placed: end of a score's name -> how its images are drawn.
    """
    asked = {name: placed[_placing(name)] for name in protocol.scores if name in names.HELD_OUT}
    absent = {name: one.reason or networks.missing.get(family_of(name)) for name, one in asked.items()}
    values: dict[str, list[float | None]] = {name: [] for name in asked if not absent[name]}
    labels = []
    total = len(truth.held_out) if asked else 0
    for batch in batches(truth.held_out if asked else (), 16, _size):
        for end, placement in placed.items():
            here = [name for name in values if _placing(name) == end]
            if here:
                rendered = list(_render_frames(reconstruction, batch, placement))
                shown = _beside(batch, rendered, protocol.background)
            for name in here:
                values[name] += image_scores.measure(name, shown, networks.lpips)
        labels += [f"view {frame.view} at {frame.time:.4f} s" for frame in batch]
        log(len(labels), total, {})
    scores = {name: _noted(image_scores.summarize(name, items), asked[name].note) for name, items in values.items()}
    scores |= {name: image_scores.without_value(name, reason) for name, reason in absent.items() if reason}
    return scores, labels


def _sources(
    reconstruction: Reconstruction, clip: Clip, truth: Truth, protocol: Protocol, placement: Placement
) -> dict[str, Source]:
    """Return what metrics of other packages may ask for (`MetricInfo.needs`), made when they do."""

    def images() -> Iterator[HeldOut]:
        for batch in batches(truth.held_out, 16, _size):
            shown = _beside(batch, list(_render_frames(reconstruction, batch, placement)), protocol.background)
            assert shown.prediction_matte is not None
            for i, frame in enumerate(batch):
                yield HeldOut(
                    frame.time, frame.view, shown.prediction[i], shown.truth[i], shown.prediction_matte[i],
                    frame.mask.clone(), protocol.background,
                )  # fmt: skip

    def clouds() -> Iterator[Clouds]:
        count = protocol.points or POINTS
        for time in clip.times:
            assert truth.sample is not None
            cloud = placement.apply(sample_gaussians(reconstruction.at(time), count, 0))
            if not len(cloud):
                raise NotComputed("the prediction has no points")
            yield Clouds(time, cloud.clone(), truth.sample(time, count, 1).clone(), truth.diagonal)

    unseen = placement.reason or ("" if truth.held_out else "no image")
    shapeless = placement.reason or ("" if truth.sample else "the data set has no geometry")
    return {
        "images": Source(images, len(truth.held_out), unseen, "image"),
        "points": Source(clouds, len(clip.times), shapeless, "moment"),
    }


def _placing(name: str) -> str:
    return names.RIGID if name.endswith(names.RIGID) else ""


def _noted(score: Score, note: str) -> Score:
    return msgspec.structs.replace(score, note="; ".join(filter(None, (score.note, note))))


def _render_frames(
    reconstruction: Reconstruction, frames: Iterable[Frame], placement: Placement = IDENTITY
) -> Iterator[tuple[Tensor, Tensor]]:
    """Render each frame's camera at its time; the Gaussians of one time are computed once."""
    time, splats = None, None
    for frame in frames:
        if splats is None or frame.time != time:
            time, splats = frame.time, finite_at(reconstruction, frame.time)
        camera = input_camera(reconstruction, frame)
        if camera is not None:
            yield render(splats, placement.camera(camera))
        elif not len(splats):
            yield torch.zeros_like(frame.rgb), torch.zeros_like(frame.mask)
        else:
            raise UserError(
                f"the frame at {frame.time:.4f} s needs a camera, but neither the data set nor the "
                "reconstruction knows it."
            )


def _beside(frames: list[Frame], rendered: list[tuple[Tensor, Tensor]], background: float) -> image_scores.ImagePairs:
    target = torch.stack([frame.over(background) for frame in frames])
    mask = torch.stack([frame.mask for frame in frames])
    alpha = torch.stack([alpha for _, alpha in rendered])
    image = (torch.stack([color for color, _ in rendered]) + (1 - alpha) * background).clamp(0, 1)
    return image_scores.ImagePairs(image, target.clamp(0, 1), alpha, mask, background)


def _size(frame: Frame) -> torch.Size:
    return frame.mask.shape
