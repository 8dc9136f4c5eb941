"""Draw the pictures of a run: input, renders, held-out views."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rewild4d.cameras.input_view import input_camera
from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.cameras.recropping import all_moments
from rewild4d.contracts import Reconstruction
from rewild4d.transforms import look_at
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Frame, Splats, Truth
from rewild4d.visualize.original_view import save_original_view
from rewild4d.visualize.pictures import PANEL, beside, film_rate, header, over, part_colors, save_mp4, save_png
from rewild4d.visualize.turntable import find_framing, four_views, orbit_frames

ROWS = 4
"""Times shown in the comparison picture."""


def save_pictures(
    reconstruction: Reconstruction,
    clip: Clip,
    truth: Truth,
    folder: Path,
    originals: Iterable[np.ndarray] | None = None,
    placement: Placement = IDENTITY,
) -> list[str]:
    """Write all pictures of a run into ``folder`` and return their names.

    comparison.png  rows are times; input, render, and where views are held out their truth and render
    canonical.png   canonical Gaussians coloured by skinning weight (methods that have them)
    input.mp4       input beside render, in the input view
    orbit.mp4       one orbit around the moving animal, upright
    orbit.png       the animal from four sides
    original.mp4    original frame beside the render over its background, held-out frames too (crops of a video)
    original.png    the same at six times

    Args:
        reconstruction: of the clip.
        clip: input of the method.
        truth: held out from it.
        folder: of the run.
        originals: the whole frames that both were cut from, uint8 [h, w, 3], in the order of time, or None.
        placement: by which held-out views are drawn, as they are scored.
    """
    names = ["comparison.png", "input.mp4", "orbit.mp4", "orbit.png"]
    save_png(comparison(reconstruction, clip, truth, placement), folder / names[0])
    fps = film_rate(clip.fps)
    save_mp4((beside(frame.over(1.0), _shot(reconstruction, frame)) for frame in clip.frames), folder / names[1], fps)
    framing = find_framing(reconstruction, clip, truth.up)
    save_mp4(orbit_frames(reconstruction, clip, framing), folder / names[2], fps)
    save_png(four_views(reconstruction, clip, framing), folder / names[3])
    names += save_original_view(reconstruction, all_moments(clip, truth), originals, folder)
    if hasattr(reconstruction, "canonical") and hasattr(reconstruction, "weights"):
        save_png(canonical(reconstruction.canonical(), reconstruction.weights), folder / "canonical.png")
        names.append("canonical.png")
    return names


def comparison(reconstruction: Reconstruction, clip: Clip, truth: Truth, placement: Placement = IDENTITY) -> Tensor:
    """Draw the comparison picture, its held-out views (where there are some) by ``placement``, [3, H, W]."""
    panels, times = [], [frame.time for frame in truth.held_out]
    for row in range(ROWS):
        frame = clip.frames[row * len(clip.frames) // ROWS]
        held = [i for i, time in enumerate(times) if abs(time - frame.time) < 1e-6]
        images = [frame.over(1.0), _shot(reconstruction, frame)]
        if held:
            other = truth.held_out[held[(len(held) // 3 + row * len(held) // (2 * ROWS)) % len(held)]]
            if other.view != frame.view:  # some protocols score the frames that were shown
                images += [other.over(1.0), _shot(reconstruction, other, placement)]
        panels.append(beside(*images))
    titles = ["input", "render", "held-out truth", "held-out render"]
    return torch.cat([header(titles[: len(images)], panels[0].shape[2]), *panels], dim=1)


def canonical(splats: Splats, weights: Tensor) -> Tensor:
    """Draw canonical Gaussians from the side, obliquely, the front and above, coloured by part, [3, H, W]."""
    palette = part_colors(weights.shape[1]).to(weights)
    colored = Splats(splats.means, splats.quats, splats.scales, splats.opacities, (weights @ palette)[:, None])
    center = splats.means.double().median(0).values.cpu()
    up, ahead = torch.tensor((0.0, 1.0, 0.0)).double(), torch.tensor((0.0, 0.0, 1.0)).double()
    focal = PANEL * 1.9
    intrinsics = torch.tensor(((focal, 0, PANEL / 2), (0, focal, PANEL / 2), (0, 0, 1.0))).double()
    panels = []
    for direction, top in (((1, 0.1, 0), up), ((0.8, 0.4, 0.8), up), ((0, 0.1, 1), up), ((0, 1, 0), ahead)):
        toward = torch.nn.functional.normalize(torch.tensor(direction).double(), dim=0)
        camera = Camera(look_at(center + 2.4 * OBJECT_DIAGONAL * toward, center, top), intrinsics, PANEL, PANEL)
        panels.append(over(colored, camera))
    return torch.cat([header(["side", "oblique", "front", "above"], 4 * PANEL), torch.cat(panels, dim=2)], dim=1)


def _shot(reconstruction: Reconstruction, frame: Frame, placement: Placement = IDENTITY) -> Tensor:
    """Render from the frame's camera, on white."""
    camera = input_camera(reconstruction, frame)
    if camera is None:
        return torch.ones_like(frame.rgb)
    return over(reconstruction.at(frame.time), placement.camera(camera))
