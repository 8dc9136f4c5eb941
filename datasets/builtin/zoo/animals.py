"""Animals of the zoo by seed: a kind, its proportions, coat, motions and place; and their rendering.

Seeds 0 to 99 are animals to develop on. Seeds from 1,000 on are the test set: scored at the end, never tuned on.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rewild4d.datasets import surface_nets
from rewild4d.datasets.artemis.recipe import ingredients
from rewild4d.datasets.builtin import anatomy, coats, implicit
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
    body = bodies.body(animal.proportions)
    skeleton, flesh = anatomy.assemble(body)
    vertices, faces = implicit.polygonise(flesh, body.cell)
    indices, weights = implicit.skinning(vertices, faces, flesh, len(skeleton.names))
    labels = np.array([part.paint for part in flesh])[implicit.nearest_part(vertices, flesh)]
    eye = np.abs(vertices[:, :1]) * (1, 0, 0) + vertices * (0, 1, 1) - body.eye[:3]
    labels = np.where(np.linalg.norm(eye, axis=1) < body.eye[3], "eye", labels)
    colors = coats.painted(animal.coat, vertices, surface_nets.normals(vertices, faces), labels, animal.paints)
    return skeleton, Surface(vertices, faces, indices, weights, colors)


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
    angle = np.radians(animal.heading)
    world = np.eye(4)
    world[:3, :3] = ((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle)))
    world[:3] = np.roll(world[:3], animal.up - 1, axis=0)
    world[:3, 3] = animal.place
    vertices = rest.vertices @ world[:3, :3].T + world[:3, 3]
    surface = Surface(vertices, rest.faces, rest.bone_indices, rest.bone_weights, rest.colors)
    size = animal.proportions.size
    lowering = 0.5 * (animal.proportions.neck_angle + 30)
    postures = motions.clip(animal.motions, frames, lowering)
    moved = np.stack([motions.pose(skeleton, posture, size) for posture in postures])
    return AnimatedAnimal(
        name=animal.name,
        species=animal.kind,
        licence=LICENCE,
        surfaces=(surface,),
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
    folders = [root / draw(seed).name for seed in seeds]
    size = {"views": views, "frames": frames, "width": width, "height": height}
    recipes = {seed: {"zoo": VERSION, "seed": seed, "truth": "mesh", **size} for seed in seeds}
    missing = [(s, f) for s, f in zip(seeds, folders, strict=True) if not _holds(f, recipes[s])]
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{root}: expected a folder that can be written, but: {error.strerror}.") from error
    each = views * frames
    for i, (seed, folder) in enumerate(missing):

        def shifted(done: int, _: int, before: int = i * each) -> None:
            if progress:
                progress(before + done, len(missing) * each)

        animal = build(seed, frames)
        with tempfile.TemporaryDirectory(dir=root, prefix=f".{folder.name}-") as scratch:
            made = Path(scratch) / folder.name
            render_artemis(
                [animal], made, views=views, width=width, height=height, recipe=recipes[seed],
                mesh=joined(animal.surfaces), progress=shifted,
            )  # fmt: skip
            made.rename(folder)
    return folders


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
