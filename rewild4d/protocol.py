"""Evaluation protocols: a TOML file says what is held out and measured; this renders, composites and scores."""

from collections.abc import Iterable, Iterator
from importlib import resources
from typing import Literal

import msgspec
import torch
from torch import Tensor

from rewild4d.contracts import Log, Reconstruction, Selection
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import digest
from rewild4d.harmonics import seen_colors
from rewild4d.image_scores import Beside, measure, summarize
from rewild4d.leaderboard.records import Score
from rewild4d.rasterizer import rasterize
from rewild4d.types import Camera, Frame, Splats, Truth

ScoreName = Literal["psnr", "ssim", "psnr_fg", "iou"]


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One named, versioned way to score a reconstruction.

    Attributes:
        name: equals the file's name; ends in the version.
        dataset: which reader it is for.
        title: for table captions.
        description: one paragraph that travels with the numbers.
        background: grey level in [0, 1] behind prediction and truth alike.
        scores: what is measured on each held-out image.
        floors: methods that are always printed beside the others.
        selection: what a method gets and what is held out.
        default: the data set's protocol where the user names none.
    """

    name: str
    dataset: str
    title: str
    description: str
    background: float
    scores: tuple[ScoreName, ...]
    floors: tuple[str, ...]
    selection: Selection
    default: bool = False

    @property
    def digest(self) -> str:
        """SHA-256 over every setting."""
        return digest(msgspec.json.encode(self, order="deterministic"))


def load_protocols() -> dict[str, Protocol]:
    """All protocols that ship with the package, by name."""
    folder = resources.files("rewild4d.leaderboard") / "protocols"
    found = {}
    for file in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if file.name.endswith(".toml"):
            protocol = msgspec.toml.decode(file.read_bytes(), type=Protocol)
            found[protocol.name] = protocol
    return found


def find_protocol(dataset: str, name: str | None) -> Protocol:
    """The protocol of that name, or the data set's default.

    Raises:
        UserError: unknown, or made for another data set.
    """
    protocols = load_protocols()
    if name is None:
        name = next((p.name for p in protocols.values() if p.dataset == dataset and p.default), None)
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
    reconstruction: Reconstruction, truth: Truth, protocol: Protocol, log: Log
) -> tuple[dict[str, Score], list[str]]:
    """Score a reconstruction on all that is held out.

    Returns:
        The scores by name, and the label of each held-out image.
    """
    values: dict[str, list[float | None]] = {name: [] for name in protocol.scores}
    labels = []
    total = len(truth.held_out)
    for batch in _batches(truth.held_out, 16):
        rendered = list(_render_frames(reconstruction, batch))
        for name, scored in _score_batch(batch, rendered, protocol).items():
            values[name] += scored
        labels += [f"view {frame.view} at {frame.time:.4f} s" for frame in batch]
        log(len(labels), total, {})
    return {name: summarize(name, items) for name, items in values.items()}, labels


def _render_frames(reconstruction: Reconstruction, frames: Iterable[Frame]) -> Iterator[tuple[Tensor, Tensor]]:
    """Render each frame's camera at its time; the Gaussians of one time are asked for once."""
    time, splats = None, None
    for frame in frames:
        if frame.camera is None:
            raise UserError("held-out frames need a camera in the world, but the data set gives none.")
        if splats is None or frame.time != time:
            time, splats = frame.time, reconstruction.at(frame.time)
            _require_finite(splats, frame.time)
        yield render(splats, frame.camera)


def _require_finite(splats: Splats, time: float) -> None:
    for name in ("means", "quats", "scales", "opacities", "colors"):
        if not bool(torch.isfinite(getattr(splats, name)).all()):
            raise UserError(f"the reconstruction's {name} at {time:.4f} s hold a NaN or an infinite value.")


def _score_batch(
    frames: list[Frame], rendered: list[tuple[Tensor, Tensor]], protocol: Protocol
) -> dict[str, list[float | None]]:
    target = torch.stack([frame.over(protocol.background) for frame in frames])
    mask = torch.stack([frame.mask for frame in frames])
    alpha = torch.stack([alpha for _, alpha in rendered])
    image = (torch.stack([color for color, _ in rendered]) + (1 - alpha) * protocol.background).clamp(0, 1)
    shown = Beside(image, target, alpha, mask, protocol.background)
    return {name: measure(name, shown, {}) for name in protocol.scores}


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
