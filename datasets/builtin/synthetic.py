"""The built-in data: procedural animals with a skeleton, a coat and a gait, rendered on first use.

A horse (y up), a tiger (z up) and a giraffe, each with its own size, place and heading in its world, so that
nothing downstream can lean on an axis. Everything is deterministic.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from rewild4d.datasets import surface_nets
from rewild4d.datasets.artemis import writer as artemis_writer
from rewild4d.datasets.builtin import anatomy, bodies, building, coats, gait, implicit
from rewild4d.datasets.builtin.gait import Gait, Wave
from rewild4d.datasets.rigs import animal, closest_points, shading, studio, voxels
from rewild4d.datasets.rigs.animal import AnimatedAnimal, Surface
from rewild4d.datasets.rigs.studio import Progress, render_artemis
from rewild4d.errors import unknown_name
from rewild4d.files import cache_folder, digest

LICENCE = "CC0 1.0 (made by rewild4d)"
FPS = 20.0
FRAMES = 20
"""Frames of one loop."""

VIEWS, WIDTH, HEIGHT = 24, 384, 216
"""Cameras and image size of the built-in data."""

WALK_PHASES = (0.0, 0.25, 0.5, 0.75)
GALLOP_PHASES = (0.0, 0.42, 0.10, 0.54)


@dataclass(frozen=True)
class Recipe:
    """One built-in animal.

    Attributes:
        species: as a person says it.
        body: rest shape.
        coat: pattern.
        paints: plain colours (six hexadecimal digits) by paint name.
        motions: by name.
        up: the world's up axis, 1 for y and 2 for z.
        heading: degrees about the up axis.
        place: where it stands in the world, metres.
    """

    species: str
    body: anatomy.Body
    coat: coats.Coat
    paints: dict[str, str]
    motions: dict[str, Gait]
    up: int
    heading: float
    place: tuple[float, float, float]


RECIPES = {
    "horse": Recipe(
        "horse",
        bodies.HORSE,
        coats.chestnut_pinto,
        {"mane": "2b1c14", "hoof": "3a322c", "eye": "120c0a"},
        {
            "walk": Gait(WALK_PHASES, 0.62, 0.62, 0.13, 45, (0.04, 0.06), (
                Wave("spine.0", "rise", 0.018, 2, 0.1, offset=-0.025), Wave("spine.0", "roll", 2.0, 1, 0.1),
                Wave("spine", "yaw", 1.5, 1, 0.0, 0.15), Wave("neck", "pitch", 3.5, 2, 0.3, 0.05),
                Wave("head", "pitch", 3.0, 2, 0.55), Wave("tail", "yaw", 9.0, 1, 0.0, 0.12),
                Wave("tail", "pitch", 2.0, 2, 0.2, 0.1),
            )),
            "gallop": Gait(GALLOP_PHASES, 0.30, 0.60, 0.30, 60, (0.20, 0.08), (
                Wave("spine.0", "rise", 0.055, 1, 0.30, offset=-0.02), Wave("spine.0", "pitch", 5.0, 1, 0.05),
                Wave("spine.1", "pitch", 3.0, 1, 0.55), Wave("spine.2", "pitch", 3.0, 1, 0.55),
                Wave("neck", "pitch", 6.0, 1, 0.6, 0.03, offset=9.0), Wave("head", "pitch", 5.0, 1, 0.1, offset=-14.0),
                Wave("tail", "pitch", 8.0, 1, 0.2, 0.12, offset=14.0), Wave("tail", "yaw", 5.0, 1, 0.0, 0.12),
            )),
        },
        up=1,
        heading=35.0,
        place=(0.4, 0.0, -0.7),
    ),
    "tiger": Recipe(
        "tiger",
        bodies.TIGER,
        coats.tiger,
        {"ear": "231a15", "nose": "b5675a", "tip": "1d1612", "eye": "17130c"},
        {
            "walk": Gait(WALK_PHASES, 0.64, 0.48, 0.15, 50, (0.02, 0.05), (
                Wave("spine.0", "rise", 0.010, 2, 0.1, offset=-0.025), Wave("spine.0", "roll", 3.0, 1, 0.1),
                Wave("spine", "yaw", 3.5, 1, 0.0, 0.2), Wave("neck", "pitch", 2.5, 2, 0.3, 0.05, offset=4.0),
                Wave("neck", "yaw", 2.0, 1, 0.5), Wave("head", "pitch", 3.0, 2, 0.6, offset=-6.0),
                Wave("tail", "yaw", 11.0, 1, 0.0, 0.16), Wave("tail", "pitch", 3.0, 1, 0.3, 0.1),
            )),
        },
        up=2,
        heading=130.0,
        place=(2.0, -1.0, 0.3),
    ),
    "giraffe": Recipe(
        "giraffe",
        bodies.GIRAFFE,
        coats.giraffe,
        {"mane": "7a4a22", "horn": "33241a", "tuft": "2a1c14", "hoof": "4a3a2e", "eye": "140d0a"},
        {
            "walk": Gait(WALK_PHASES, 0.64, 1.0, 0.28, 40, (0.06, 0.10), (
                Wave("spine.0", "rise", 0.03, 2, 0.1, offset=-0.05), Wave("spine.0", "roll", 1.5, 1, 0.1),
                Wave("spine", "yaw", 1.0, 1, 0.0, 0.15), Wave("neck", "pitch", 3.0, 2, 0.3, 0.06, offset=2.0),
                Wave("head", "pitch", 4.0, 2, 0.6), Wave("tail", "yaw", 10.0, 1, 0.0, 0.12),
            )),
        },
        up=1,
        heading=-110.0,
        place=(-1.5, 0.0, 3.0),
    ),
}  # fmt: skip


def animals() -> list[str]:
    """Return names of the built-in animals."""
    return list(RECIPES)


@cache
def rest_surface(name: str) -> Surface:
    """Return the rest surface of a built-in animal in its body frame (see `anatomy`), skinned and coloured.

    Raises:
        UserError: no such animal.
    """
    if name not in RECIPES:
        raise unknown_name("built-in animal", name, RECIPES)
    recipe = RECIPES[name]
    return building.dressed(recipe.body, recipe.coat, recipe.paints)[1]


def placement(name: str) -> np.ndarray:
    """Return the rigid matrix from an animal's body frame to its world, [4, 4]."""
    recipe = RECIPES[name]
    return building.world_matrix(recipe.heading, recipe.up, recipe.place)


@cache
def build(name: str) -> list[AnimatedAnimal]:
    """Return every motion of a built-in animal, in its world, metres.

    Raises:
        UserError: no such animal.
    """
    rest, recipe, world = rest_surface(name), RECIPES[name], placement(name)
    skeleton, _ = anatomy.assemble(recipe.body)
    surface = building.placed(rest, world)
    return [
        AnimatedAnimal(
            name=name,
            species=recipe.species,
            licence=LICENCE,
            surfaces=(surface,),
            bone_names=tuple(skeleton.names),
            parents=np.array(skeleton.parents),
            bones_rest=world @ skeleton.rest(),
            bones=world @ gait.animate(skeleton, steps, FRAMES) @ skeleton.rest(),
            fps=FPS,
            motion=motion,
            up=np.eye(3)[recipe.up],
        )
        for motion, steps in recipe.motions.items()
    ]


def recipe_digest() -> str:
    """SHA-256 over everything that decides what the built-in data looks like: the sources, the size and the count."""
    made_by = (anatomy, bodies, building, coats, gait, implicit, surface_nets)
    rendered_by = (animal, artemis_writer, closest_points, shading, studio, voxels)
    sources = [Path(module.__file__ or "").read_bytes() for module in (*made_by, *rendered_by)]
    return digest(Path(__file__).read_bytes(), *sources)


def ensure(progress: Progress | None = None) -> Path:
    """Return the folder of all built-in animals in Artemis format, rendered on first use and kept in the cache.

    Its name begins with their version: records of one version stand in one table, whichever processor rendered them
    (leaderboard/variants.py). An edit that changes the pictures by more than rounding raises it.

    Args:
        progress: called as ``progress(done, total)`` with counts of images.

    Returns:
        A folder with one Artemis folder per animal.

    Raises:
        UserError: the cache folder cannot be written.
    """
    root = cache_folder() / f"builtin-v1-{recipe_digest()[:12]}"
    return render(root, animals(), views=VIEWS, width=WIDTH, height=HEIGHT, progress=progress)


def render(
    root: Path, names: Sequence[str], *, views: int, width: int, height: int, progress: Progress | None = None
) -> Path:
    """Render the named built-in animals that ``root`` does not hold yet, each appearing there complete or not at all.

    Args:
        root: folder of animals; made if missing.
        names: of built-in animals.
        views: number of cameras.
        width: of the images in pixels.
        height: of the images in pixels.
        progress: called as ``progress(done, total)`` with counts of images.

    Returns:
        ``root``.

    Raises:
        UserError: the folder cannot be written, or there is no such animal.
    """

    def job(name: str) -> building.Job:
        def render_one(folder: Path, shifted: Progress) -> None:
            render_artemis(build(name), folder, views=views, width=width, height=height, progress=shifted)

        return building.Job(sum(views * len(motion.bones) for motion in build(name)), render_one)

    missing = [name for name in names if not (root / name).is_dir()]
    building.render_missing(root, {name: job(name) for name in missing}, progress)
    return root
