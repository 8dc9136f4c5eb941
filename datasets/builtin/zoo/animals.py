"""Animals of the zoo by seed: a kind, its proportions, coat, motions and place; and their rendering.

Seeds 0 to 99 are animals to develop on. Seeds from 1,000 on are the test set: scored at the end, never tuned on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rewild4d.datasets.artemis.recipe import ingredients
from rewild4d.datasets.builtin import anatomy, building, coats
from rewild4d.datasets.builtin.zoo import bodies, motions
from rewild4d.datasets.builtin.zoo import coats as zoo_coats
from rewild4d.datasets.builtin.zoo.kinds import KINDS, NAMES
from rewild4d.datasets.rigs.animal import AnimatedAnimal, Surface
from rewild4d.datasets.rigs.studio import Progress, joined, render_artemis
from rewild4d.errors import UserError

VERSION = 1
"""An edit that changes what a seed gives raises it."""
LICENCE = "CC0 1.0 (made by rewild4d)"
FPS = 20.0
DEVELOPMENT = range(0, 100)
"""Seeds to choose settings on."""
TEST = range(1000, 1_000_000)
"""Seeds to report on."""


@dataclass(frozen=True)
class ZooAnimal:
    """What a seed stands for.

    Attributes:
        seed: see `DEVELOPMENT` and `TEST`.
        kind: name in `kinds.KINDS`.
        proportions: of its body.
        coat: pattern.
        paints: plain colours (six hexadecimal digits) by paint name.
        description: its coat in words.
        motions: names in `motions.MOTIONS`, one after another.
        up: the world's up axis, 1 for y and 2 for z.
        heading: degrees about the up axis.
        place: where it stands in the world, metres, [3].
    """

    seed: int
    kind: str
    proportions: bodies.Proportions
    coat: coats.Coat
    paints: dict[str, str]
    description: str
    motions: tuple[str, ...]
    up: int
    heading: float
    place: np.ndarray

    @property
    def name(self) -> str:
        """Folder and case name, such as "zoo-0012-stag"."""
        return f"zoo-{self.seed:04d}-{self.kind}"


def draw(seed: int) -> ZooAnimal:
    """Return the animal of a seed; consecutive seeds go through all kinds.

    Raises:
        UserError: the seed is of neither set.
    """
    if seed not in DEVELOPMENT and seed not in TEST:
        raise UserError(
            f"zoo: expected a seed of 0 to {DEVELOPMENT[-1]} (development) or of {TEST[0]} to {TEST[-1]} (test), "
            f"got {seed}."
        )
    rng = np.random.default_rng((VERSION, seed))
    name = NAMES[seed % len(NAMES)]
    kind = KINDS[name]
    proportions = bodies.jittered(kind.proportions, rng)
    coat, description = zoo_coats.draw(rng, kind.palettes, kind.patterns, 0.3 * proportions.size)
    clip = kind.clips[int(rng.integers(len(kind.clips)))]
    place = rng.uniform(-2.0, 2.0, 3)
    up = int(rng.integers(1, 3))
    place[up] = 0.0
    return ZooAnimal(seed, name, proportions, coat, dict(kind.paints), description, clip, up,
                     float(rng.uniform(-180, 180)), place)  # fmt: skip


@cache
def _rest(seed: int) -> tuple[anatomy.Skeleton, Surface]:
    """Return skeleton and surface at rest in the body frame."""
    animal = draw(seed)
    return building.dressed(bodies.body(animal.proportions), animal.coat, animal.paints)


def build(seed: int, frames: int = 24) -> AnimatedAnimal:
    """Return the animal of a seed with its clip, in its world, metres.

    Args:
        seed: see `draw`.
        frames: of the clip.

    Raises:
        UserError: the seed is of neither set.
    """
    animal = draw(seed)
    skeleton, rest = _rest(seed)
    world = building.world_matrix(animal.heading, animal.up, animal.place)
    size = animal.proportions.size
    lowering = 0.5 * (animal.proportions.neck_angle + 30)
    postures = motions.clip(animal.motions, frames, lowering)
    moved = np.stack([motions.pose(skeleton, posture, size) for posture in postures])
    return AnimatedAnimal(
        name=animal.name,
        species=animal.kind,
        licence=LICENCE,
        surfaces=(building.placed(rest, world),),
        bone_names=tuple(skeleton.names),
        parents=np.array(skeleton.parents),
        bones_rest=world @ skeleton.rest(),
        bones=world @ moved @ skeleton.rest(),
        fps=FPS,
        motion="-".join(animal.motions),
        up=np.eye(3)[animal.up],
    )


def render(
    root: Path,
    seeds: Sequence[int],
    *,
    views: int,
    frames: int,
    width: int,
    height: int,
    progress: Progress | None = None,
) -> list[Path]:
    """Render animals that ``root`` does not hold yet, each appearing there complete or not at all.

    Args:
        root: folder of animals; made if missing.
        seeds: see `draw`.
        views: number of cameras.
        frames: of each clip.
        width: of the images in pixels.
        height: of the images in pixels.
        progress: called as ``progress(done, total)`` with counts of images.

    Returns:
        The folder of each animal.

    Raises:
        UserError: a seed is of neither set, the folder cannot be written, or it holds an animal of another size.
    """
    size = {"views": views, "frames": frames, "width": width, "height": height}
    folders = {root / draw(seed).name: {"zoo": VERSION, "seed": seed, "truth": "mesh", **size} for seed in seeds}

    def job(recipe: dict[str, Any]) -> building.Job:
        def render_one(folder: Path, shifted: Progress) -> None:
            animal = build(recipe["seed"], frames)
            render_artemis(
                [animal], folder, views=views, width=width, height=height, recipe=recipe,
                mesh=joined(animal.surfaces), progress=shifted,
            )  # fmt: skip

        return building.Job(views * frames, render_one)

    jobs = {folder.name: job(recipe) for folder, recipe in folders.items() if not _holds(folder, recipe)}
    building.render_missing(root, jobs, progress)
    return list(folders)


def _holds(folder: Path, recipe: dict[str, Any]) -> bool:
    """Return whether an animal is there already.

    Raises:
        UserError: it is, but was made otherwise.
    """
    if not folder.is_dir():
        return False
    there = ingredients(folder)
    changed = [f"{name} {there.get(name)}" for name, value in recipe.items() if there.get(name) != value]
    if changed:
        wanted = ", ".join(f"{name} {value}" for name, value in recipe.items() if there.get(name) != value)
        raise UserError(f"{folder}: expected an animal with {wanted}, found one with {', '.join(changed)}.")
    return True
