"""Evaluation protocols: a TOML file says what is held out and measured; this renders, composites and scores."""

from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata, resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import torch
from torch import Tensor

from rewild4d import geometry_scores, image_scores, novel_views
from rewild4d.contracts import Log, Reconstruction, Selection
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import digest
from rewild4d.harmonics import seen_colors
from rewild4d.leaderboard.records import Score
from rewild4d.metrics.samples import Distance
from rewild4d.metrics.sets import FILE, Compared, write_features
from rewild4d.metrics.weights import WeightsMissing, is_here
from rewild4d.novel_views import NovelViews, finite_at, input_camera
from rewild4d.rasterizer import rasterize
from rewild4d.scoring import NETWORKS, Networks, load_networks
from rewild4d.types import Camera, Clip, Frame, Splats, Truth

SCORES = (*image_scores.NAMES, *geometry_scores.NAMES, *novel_views.NAMES)
"""Everything that a protocol may ask for."""


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One named, versioned way to score a reconstruction.

    Attributes:
        name: equals the file's name; ends in the version.
        dataset: which reader it is for.
        title: for table captions.
        description: one paragraph that travels with the numbers.
        background: grey level in [0, 1] behind prediction and truth alike.
        scores: what is measured: on each held-out image, on the shape, on novel views as a set; out of `SCORES`.
        floors: methods that are always printed beside the others.
        selection: what a method gets and what is held out.
        default: the data set's protocol where the user names none; the highest version where several say so.
        points: drawn from each cloud for scores of the shape.
        novel: how novel views are drawn for scores of sets.
    """

    name: str
    dataset: str
    title: str
    description: str
    background: float
    scores: tuple[str, ...]
    floors: tuple[str, ...]
    selection: Selection
    default: bool = False
    points: int | None = None
    novel: NovelViews | None = None

    def __post_init__(self) -> None:
        for name in self.scores:
            if name not in SCORES:
                raise ValueError(f"unknown score '{name}'")
        if self.points is None and any(name in geometry_scores.NAMES for name in self.scores):
            raise ValueError("scores of the shape need 'points'")
        if self.novel is None and any(name in novel_views.NAMES for name in self.scores):
            raise ValueError("scores of novel views need a table 'novel'")

    @property
    def digest(self) -> str:
        """SHA-256 over every setting; one that is left out, and came later than the protocol, changes nothing."""
        later = {"points": self.points, "novel": self.novel}
        given = msgspec.to_builtins(self)
        for name, value in later.items():
            if value is None:
                del given[name]
        if self.selection.split is None:
            del given["selection"]["split"]
        if self.novel is not None and self.novel.upright is None:
            del given["novel"]["upright"]
        return digest(msgspec.json.encode(given))


class Evaluation(NamedTuple):
    """What was measured.

    Attributes:
        scores: by name.
        items: label of each held-out image, as in ``Score.per_item`` of image scores.
        distances: between sets of images or clips, with all that decides their values.
        alignments: by which shapes were laid on the truth.
        networks: SHA-256 of the weights that scores leaned on.
        sets: the features that ``distances`` were computed from.
    """

    scores: dict[str, Score]
    items: list[str]
    distances: list[Distance]
    alignments: list[dict[str, Any]]
    networks: dict[str, str]
    sets: list[Compared]

    def keep(self, folder: Path) -> dict[str, Any]:
        """The fields of a record; features of sets are written into its folder, for scores pooled over cases."""
        fields = self._asdict()
        sets = fields.pop("sets")
        return fields | {"features": write_features(sets, folder / FILE) if sets else ""}


def load_protocols() -> dict[str, Protocol]:
    """All protocols by name: our own, then those of packages that installed some (entry point `rewild4d.protocols`).

    Raises:
        UserError: a package's protocol cannot be read, or has a name that is taken.
    """
    folder = resources.files("rewild4d.leaderboard") / "protocols"
    found = {protocol.name: protocol for protocol in map(_decode, _tomls(folder))}
    for entry in metadata.entry_points(group="rewild4d.protocols"):
        try:
            added = [_decode(file) for file in _tomls(resources.files(entry.value))]
        except (ImportError, OSError, msgspec.DecodeError) as error:
            raise UserError(f"protocols '{entry.name}': {entry.value}: {error}.") from error
        for protocol in added:
            if found.setdefault(protocol.name, protocol) is not protocol:
                raise UserError(f"protocols '{entry.name}': {entry.value}: the name '{protocol.name}' is taken.")
    return found


def _tomls(folder: Traversable) -> list[Traversable]:
    files = (entry for entry in folder.iterdir() if entry.name.endswith(".toml"))
    return sorted(files, key=lambda entry: entry.name)


def _decode(file: Traversable) -> Protocol:
    return msgspec.toml.decode(file.read_bytes(), type=Protocol)


def find_protocol(dataset: str, name: str | None) -> Protocol:
    """The protocol of that name, or the data set's default.

    Raises:
        UserError: unknown, or made for another data set.
    """
    protocols = load_protocols()
    if name is None:
        names = [p.name for p in protocols.values() if p.dataset == dataset and p.default]
        name = max(names, key=lambda text: int(text.rpartition("-v")[2]), default=None)
        if name is None:
            raise UserError(f"--protocol: the data set '{dataset}' has no default; name one of its protocols.")
    if name not in protocols:
        raise unknown_name("protocol", name, protocols)
    if protocols[name].dataset != dataset:
        raise UserError(f"protocol '{name}' is for the data set '{protocols[name].dataset}', not for '{dataset}'.")
    return protocols[name]


@torch.no_grad()
def render(splats: Splats, camera: Camera, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Render one view.

    Returns:
        Colour premultiplied by alpha [3, h, w] and alpha [1, h, w], float32 on the CPU.
    """
    device = device or splats.means.device
    colors, alpha, _ = rasterize(
        splats.means.to(device),
        splats.quats.to(device),
        splats.scales.to(device),
        splats.opacities.to(device),
        seen_colors(splats, camera.center).to(device),
        camera.world_to_camera[None].to(device, torch.float32),
        camera.intrinsics[None].to(device, torch.float32),
        camera.width,
        camera.height,
    )
    return colors[0].cpu(), alpha[0].cpu()


def evaluate(
    reconstruction: Reconstruction, clip: Clip, truth: Truth, protocol: Protocol, log: Log, device: torch.device
) -> Evaluation:
    """Score a reconstruction by all that a protocol asks for.

    Args:
        reconstruction: of the clip.
        clip: what the method saw: the reference of novel views, and the moments at which shapes are compared.
        truth: what it did not see.
        protocol: what is measured.
        log: progress.
        device: where the metric networks compute.
    """
    networks = load_networks(_families(protocol.scores), device)
    scores, items = _score_images(reconstruction, truth, protocol, networks, log)
    shape = [name for name in protocol.scores if name in geometry_scores.NAMES]
    found, alignments = geometry_scores.score_geometry(reconstruction, truth, clip.times, shape, protocol.points or 0)
    scores |= found
    sets = [name for name in protocol.scores if name in novel_views.NAMES]
    distances: list[Distance] = []
    compared: list[Compared] = []
    if protocol.novel is not None and sets:
        distances, compared = novel_views.novel_view_distances(
            reconstruction, clip, protocol.novel, names=sets, background=protocol.background, render=render,
            images=networks.images, videos=networks.videos, log=log, up=truth.up,
        )  # fmt: skip
        scores |= novel_views.as_scores(distances, sets, dict(networks.missing))
    used = {name: network.digest for name, network in networks.lpips.items()}
    used |= {distance.extractor: distance.digest for distance in distances}
    return Evaluation({name: scores[name] for name in protocol.scores}, items, distances, alignments, used, compared)


@torch.no_grad()
def input_psnr(reconstruction: Reconstruction, shown: Clip, background: float) -> Score:
    """PSNR of the frames that the method was shown, over the full frame: how closely it fits them, which tells nothing
    of what it was not shown, and beside the held-out PSNR whether it lacks freedom or evidence.

    Args:
        reconstruction: of the clip.
        shown: what the method saw, with cameras where the reconstruction knows none.
        background: grey level in [0, 1] behind prediction and truth alike.
    """
    values: list[float | None] = []
    for batch in _batches(shown.frames, 16):
        beside = _beside(batch, list(_render_frames(reconstruction, batch)), background)
        values += image_scores.measure("psnr", beside, {})
    return image_scores.summarize("psnr", values)


def _families(scores: Iterable[str]) -> list[str]:
    """The networks that scores need, by the names of `scoring.load_networks`."""
    found = set()
    for name in scores:
        metric = image_scores.split_name(name)[0]
        if metric.startswith("lpips"):
            found.add(metric.replace("_", "-"))
        elif name in novel_views.NAMES:
            found.add("kid" if name == "kid_v" else "fvd")
    return sorted(found)


def may_be_scored_now(scores: Mapping[str, Score]) -> bool:
    """Whether any of a record's scores was left out for want of a network that is here now."""
    missing = str(WeightsMissing())
    families = _families(name for name, score in scores.items() if score.value is None and score.note.endswith(missing))
    return any(is_here(NETWORKS[family]) for family in families)


def _score_images(
    reconstruction: Reconstruction, truth: Truth, protocol: Protocol, networks: Networks, log: Log
) -> tuple[dict[str, Score], list[str]]:
    """The scores of held-out images, and the label of each image."""
    names = [name for name in protocol.scores if name in image_scores.NAMES]
    absent = {name: networks.missing.get(image_scores.split_name(name)[0].replace("_", "-")) for name in names}
    values: dict[str, list[float | None]] = {name: [] for name in names if not absent[name]}
    labels = []
    total = len(truth.held_out) if names else 0
    for batch in _batches(truth.held_out if names else (), 16):
        rendered = list(_render_frames(reconstruction, batch))
        shown = _beside(batch, rendered, protocol.background)
        for name in values:
            values[name] += image_scores.measure(name, shown, networks.lpips)
        labels += [f"view {frame.view} at {frame.time:.4f} s" for frame in batch]
        log(len(labels), total, {})
    scores = {name: image_scores.summarize(name, items) for name, items in values.items()}
    scores |= {name: image_scores.without_value(name, reason) for name, reason in absent.items() if reason}
    return scores, labels


def _render_frames(reconstruction: Reconstruction, frames: Iterable[Frame]) -> Iterator[tuple[Tensor, Tensor]]:
    """Render each frame's camera at its time; the Gaussians of one time are asked for once."""
    time, splats = None, None
    for frame in frames:
        if splats is None or frame.time != time:
            time, splats = frame.time, finite_at(reconstruction, frame.time)
        camera = input_camera(reconstruction, frame)
        if camera is not None:
            yield render(splats, camera)
        elif not len(splats):
            yield torch.zeros_like(frame.rgb), torch.zeros_like(frame.mask)
        else:
            raise UserError(
                f"the frame at {frame.time:.4f} s needs a camera, but neither the data set nor the "
                "reconstruction knows it."
            )


def _beside(frames: list[Frame], rendered: list[tuple[Tensor, Tensor]], background: float) -> image_scores.Beside:
    target = torch.stack([frame.over(background) for frame in frames])
    mask = torch.stack([frame.mask for frame in frames])
    alpha = torch.stack([alpha for _, alpha in rendered])
    image = (torch.stack([color for color, _ in rendered]) + (1 - alpha) * background).clamp(0, 1)
    return image_scores.Beside(image, target.clamp(0, 1), alpha, mask, background)


def _batches(frames: Iterable[Frame], size: int) -> Iterator[list[Frame]]:
    """Groups of equally sized frames, in order."""
    batch: list[Frame] = []
    for frame in frames:
        if batch and (len(batch) == size or frame.mask.shape != batch[0].mask.shape):
            yield batch
            batch = []
        batch.append(frame)
    if batch:
        yield batch
