"""What a tab saves: a picture of what it shows, and a film once around the animal."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import viser
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.types import Camera, Splats
from rewild4d.visualize.pictures import beside, film_rate, save_mp4
from rewild4d.visualize.turntable import STEPS, orbit_frames
from rewild4d.visualize.viewer.staging import Paint, Shape, Stage

PATIENCE = 30.0
"""Seconds in which a tab has to draw its picture."""


def save_snapshot(client: viser.ClientHandle | None, title: str) -> None:
    """Let a tab draw what it shows once more, on white, and download it as a PNG."""
    if client is None:
        return
    try:
        size = client.camera.image_height, client.camera.image_width
        drawn = client.get_render(*size, transport_format="png", timeout=PATIENCE)
    except (RuntimeError, TimeoutError) as error:
        client.add_notification("No picture", str(error), color="red")
        return
    client.send_file_download(f"{title}.png", encode_png(drawn), save_immediately=True)


def encode_png(drawn: np.ndarray) -> bytes:
    """Put a render, uint8 [h, w, 3 or 4], on white and return it as a PNG file."""
    color, alpha = drawn[..., :3].astype(np.float32), drawn[..., 3:].astype(np.float32) / 255
    over = color * alpha + 255 * (1 - alpha) if drawn.shape[2] == 4 else color
    return cv2.imencode(".png", over.round().astype(np.uint8)[..., ::-1])[1].tobytes()


def save_film(
    client: viser.ClientHandle,
    stages: Sequence[Stage],
    shape: Shape,
    paint: Paint,
    rendering: AbstractContextManager[Any],
    title: str,
) -> None:
    """Render the runs side by side once around, over time, with our own rasterizer, and let a tab download the film.

    Args:
        client: the tab.
        stages: of the runs.
        shape: what is shown of each that has it; deformed of the others.
        paint: likewise.
        rendering: held for one image at a time, so that the page stays alive.
        title: of the file.
    """
    note = client.add_notification("Film", "It is being rendered.", loading=True, with_close_button=False)
    try:
        films = [_orbit(stage, shape, paint, rendering) for stage in stages]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "orbit.mp4"
            save_mp4(_counted(films, note), path, film_rate(stages[0].run.clip.fps))
            client.send_file_download(f"{title}-orbit.mp4", path.read_bytes(), save_immediately=True)
    except UserError as error:
        client.add_notification("No film", str(error), color="red")
    finally:
        note.remove()


def _counted(films: Sequence[Iterator[Tensor]], note: viser.NotificationHandle) -> Iterator[Tensor]:
    for number, images in enumerate(zip(*films, strict=True)):
        note.body = f"Image {number + 1} of {STEPS}"
        yield beside(*images)


def _orbit(stage: Stage, shape: Shape, paint: Paint, rendering: AbstractContextManager[Any]) -> Iterator[Tensor]:
    shape = shape if shape in stage.shapes else "deformed"
    paint = paint if paint in stage.paints else "appearance"
    with rendering:
        framing = stage.framing(shape)
    images = orbit_frames(_Shown(stage, shape, paint), stage.run.clip, framing)
    while True:
        with rendering:
            image = next(images, None)
        if image is None:
            return
        yield image


@dataclass(frozen=True)
class _Shown:
    """What is shown of a run, as a reconstruction in the frame of the stage (contracts.Reconstruction)."""

    stage: Stage
    shape: Shape
    paint: Paint

    def at(self, time: float) -> Splats:
        return self.stage.splats(time, self.shape, self.paint)

    def camera(self, time: float) -> Camera | None:
        raise NotImplementedError  # an orbit has cameras of its own

    def save(self, folder: Path) -> None:
        raise NotImplementedError  # it is drawn, not kept
