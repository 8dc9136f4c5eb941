"""From a body plan, a coat and a place to an animal in its world, and its rendering into a folder of animals."""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rewild4d.datasets import surface_nets
from rewild4d.datasets.builtin import anatomy, coats, implicit
from rewild4d.datasets.rigs.animal import Surface
from rewild4d.datasets.rigs.studio import Progress
from rewild4d.errors import UserError


@dataclass(frozen=True)
class Job:
    """One animal to render.

    Attributes:
        images: how many.
        render: called with the new folder and what reports progress.
    """

    images: int
    render: Callable[[Path, Progress], object]


def dressed(body: anatomy.Body, coat: coats.Coat, paints: Mapping[str, str]) -> tuple[anatomy.Skeleton, Surface]:
    """Return skeleton and surface of a body at rest in its own frame (see `anatomy`), skinned and coloured.

    Args:
        body: the plan.
        coat: its pattern.
        paints: plain colours (six hexadecimal digits) by paint name; "eye" is one.
    """
    skeleton, flesh = anatomy.assemble(body)
    vertices, faces = implicit.polygonise(flesh, body.cell)
    indices, weights = implicit.skinning(vertices, faces, flesh, len(skeleton.names))
    labels = np.array([part.paint for part in flesh])[implicit.nearest_part(vertices, flesh)]
    eye = np.abs(vertices[:, :1]) * (1, 0, 0) + vertices * (0, 1, 1) - body.eye[:3]
    labels = np.where(np.linalg.norm(eye, axis=1) < body.eye[3], "eye", labels)
    colors = coats.painted(coat, vertices, surface_nets.normals(vertices, faces), labels, paints)
    return skeleton, Surface(vertices, faces, indices, weights, colors)


def world_matrix(heading: float, up: int, place: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Return the rigid matrix from a body frame to a world, [4, 4].

    Args:
        heading: degrees about the up axis.
        up: the world's up axis, 1 for y and 2 for z.
        place: where the animal stands, metres, [3].
    """
    angle = np.radians(heading)
    matrix = np.eye(4)
    matrix[:3, :3] = ((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle)))
    # Cyclic steps of the axes are rotations: y to y, or y to z.
    matrix[:3] = np.roll(matrix[:3], up - 1, axis=0)
    matrix[:3, 3] = place
    return matrix


def placed(rest: Surface, world: np.ndarray) -> Surface:
    """Return a surface moved by a rigid matrix [4, 4]."""
    return replace(rest, vertices=rest.vertices @ world[:3, :3].T + world[:3, 3])


def render_missing(root: Path, jobs: Mapping[str, Job], progress: Progress | None = None) -> None:
    """Render the animals that ``root`` does not hold yet, each appearing there complete or not at all.

    Args:
        root: folder of animals; made if missing.
        jobs: by the name of the animal's folder.
        progress: called as ``progress(done, total)`` with counts of images.

    Raises:
        UserError: the folder cannot be written.
    """
    missing = {name: job for name, job in jobs.items() if not (root / name).is_dir()}
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{root}: expected a folder that can be written, but: {error.strerror}.") from error
    before, total = 0, sum(job.images for job in missing.values())
    for name, job in missing.items():

        def shifted(done: int, _: int, before: int = before) -> None:
            if progress:
                progress(before + done, total)

        with tempfile.TemporaryDirectory(dir=root.parent, prefix=f".{root.name}-") as scratch:
            made = Path(scratch) / name
            job.render(made, shifted)
            try:
                made.rename(root / name)
            except OSError:
                # Another process was faster: its data are the same.
                if not (root / name).is_dir():
                    raise
        before += job.images
