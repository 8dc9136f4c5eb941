"""Contact sheet of animals of the zoo: a row each, three moments from the front and three from the side."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from rewild4d.datasets.builtin.zoo import animals
from rewild4d.datasets.rigs.studio import camera_ring, picture
from rewild4d.files import atomic

TILE = (192, 144)
"""Width and height of a picture, pixels."""
FRAMES, MOMENTS, RING, VIEWS = 24, (0, 8, 16), 8, (1, 3)


def contact_sheet(seeds: Sequence[int]) -> Image.Image:
    """Draw animals of the zoo.

    Args:
        seeds: one row each, from top to bottom.

    Returns:
        RGB, six tiles wide, with each animal's name, clip and coat above its row.

    Raises:
        UserError: a seed is of neither set.
    """
    return Image.fromarray(np.concatenate([_row(seed) for seed in seeds]))


def write(path: Path, seeds: Sequence[int]) -> None:
    """Write the contact sheet of some seeds as a PNG."""
    drawn = contact_sheet(seeds)
    with atomic(path) as scratch:
        drawn.save(scratch, format="PNG")


def _row(seed: int) -> np.ndarray:
    animal = animals.build(seed, FRAMES)
    posed = np.stack([np.concatenate(animal.posed(frame)) for frame in range(FRAMES)])
    cameras = camera_ring(posed, animal.up, RING, *TILE)
    tiles = []
    for view in VIEWS:
        for moment in MOMENTS:
            rgb, alpha = picture(animal, moment).render(cameras[view])
            share = alpha[..., None] / 255
            tiles.append((rgb * share + 255 * (1 - share)).round().astype(np.uint8))
    row = Image.fromarray(np.concatenate(tiles, axis=1))
    ImageDraw.Draw(row).text(
        (4, 2), f"{animal.name}: {animal.motion}; {animals.draw(seed).description}", fill=(0, 0, 0)
    )
    return np.asarray(row)
