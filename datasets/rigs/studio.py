"""Renders an animated animal as an Artemis folder with exact truth: images, mattes, cameras, bones, voxels."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rewild4d.datasets.artemis.mesh import Mesh
from rewild4d.datasets.artemis.writer import ArtemisWriter
from rewild4d.datasets.rigs.animal import AnimatedAnimal, Surface
from rewild4d.datasets.rigs.reader import content, load_rig
from rewild4d.datasets.rigs.shading import SUN_ALONG, SUN_UP, Picture, raycaster
from rewild4d.datasets.rigs.voxels import voxelise
from rewild4d.errors import UserError
from rewild4d.transforms import look_at
from rewild4d.types import Camera

Progress = Callable[[int, int], None]
"""progress(done, total) in images."""

FIELD_OF_VIEW = 30.0
"""Degrees across the longer image side: a moderate tele lens, little perspective."""

ELEVATION, ELEVATION_SWING, ELEVATION_WAVES = 15.0, 20.0, 2
"""Cameras rise and sink between -5 and 35 degrees, twice around the ring: smooth for a sweep, yet not in one plane."""

MARGIN = 0.06
"""Share of the half image that stays empty around the widest pose."""

PENDING = 64
"""Images that may wait for the encoder: bounds the memory."""


def make_artemis(
    rig: Path, clip: str, views: int, frames: int, width: int, height: int, out: Path, progress: Progress | None = None
) -> Path:
    """Render one clip of a rig file as an Artemis folder.

    Args:
        rig: a .glb or .gltf file.
        clip: name of the animation.
        views: number of cameras.
        frames: number of moments, evenly over the clip.
        width: of the images in pixels.
        height: of the images in pixels.
        out: the animal's folder; must not exist, or be empty.
        progress: called after every image.

    Returns:
        The folder.

    Raises:
        UserError: the rig, the clip, the sizes or the folder cannot be used.
    """
    for name, value, least in (
        ("views", views, 1),
        ("frames", frames, 1),
        ("width", width, 16),
        ("height", height, 16),
    ):
        if value < least:
            raise UserError(f"{out}: expected {name} of at least {least}, got {value}.")
    _expect_empty(out)
    animal = load_rig(rig, clip, frames)
    size = {"views": views, "frames": frames, "width": width, "height": height}
    recipe = {"rig": content(rig), "clip": clip, "truth": "mesh", **size}
    return render_artemis(
        [animal], out, views=views, width=width, height=height, recipe=recipe, mesh=joined(animal.surfaces),
        progress=progress,
    )  # fmt: skip


def render_artemis(
    animals: Sequence[AnimatedAnimal],
    out: Path,
    *,
    views: int,
    width: int,
    height: int,
    recipe: dict[str, Any] | None = None,
    mesh: Mesh | None = None,
    progress: Progress | None = None,
) -> Path:
    """Render the motions of one animal as an Artemis folder; nothing stays behind when it fails.

    Args:
        animals: one animal (same surfaces, bones and rest pose), one entry a motion.
        out: the animal's folder; must not exist, or be empty.
        views: number of cameras, the same for all motions.
        width: of the images in pixels.
        height: of the images in pixels.
        recipe: what the animals were made of, by which the folder is known on every processor (see `recipe`).
        mesh: by which shapes are scored; None: by the voxels.
        progress: called after every image.

    Returns:
        The folder.

    Raises:
        UserError: the folder holds files or cannot be written.
    """
    _expect_empty(out)
    first = animals[0]
    posed = [np.concatenate(animal.posed(t)) for animal in animals for t in range(len(animal.bones))]
    cameras = camera_ring(np.stack(posed), first.up, views, width, height)
    volume = voxelise(first.surfaces)
    total = len(posed) * views
    with (
        ArtemisWriter(
            out,
            cameras,
            first.bones_rest,
            first.parents,
            volume.voxels,
            volume.indices,
            volume.weights,
            volume.radius,
            first.licence,
            recipe,
            mesh,
        ) as writer,
        ThreadPoolExecutor(1) as encoder,
    ):
        pending: list[Future[None]] = []
        done = 0
        for animal in animals:
            writer.motion(animal.motion, animal.bones)
            for frame in range(len(animal.bones)):
                drawn = picture(animal, frame)
                for view, camera in enumerate(cameras):
                    rgb, alpha = drawn.render(camera)
                    pending.append(encoder.submit(writer.image, animal.motion, frame, view, rgb, alpha))
                    if len(pending) > PENDING:
                        pending.pop(0).result()
                    done += 1
                    if progress:
                        progress(done, total)
        for job in pending:
            job.result()
    return out


def joined(surfaces: Sequence[Surface]) -> Mesh:
    """Join surfaces to one mesh; a vertex with fewer influences than others gets some of no weight."""
    most = max(surface.bone_indices.shape[1] for surface in surfaces)
    starts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces[:-1])])

    def padded(rows: NDArray[Any]) -> NDArray[Any]:
        return np.pad(rows, ((0, 0), (0, most - rows.shape[1])))

    return Mesh(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts, strict=True)]),
        np.concatenate([padded(surface.bone_indices) for surface in surfaces]),
        np.concatenate([padded(surface.bone_weights) for surface in surfaces]),
    )


def _expect_empty(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out}: expected a new or an empty folder, got one that holds files.")


def picture(animal: AnimatedAnimal, frame: int) -> Picture:
    """Return the animal at one frame; rays are cast relative to its middle, where single precision is best."""
    posed = animal.posed(frame)
    points = np.concatenate(posed)
    origin = (points.min(0) + points.max(0)) / 2
    scene = raycaster([vertices - origin for vertices in posed], animal.surfaces)
    sun = SUN_ALONG * horizontal_axes(animal.up)[0] + SUN_UP * animal.up
    return Picture(scene, animal.surfaces, points - origin, origin, animal.up, sun / np.linalg.norm(sun))


def horizontal_axes(up: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two orthonormal directions perpendicular to `up`, right-handed with it as the third, each [3]."""
    least = np.eye(3)[np.argmin(np.abs(up))]
    along = np.cross(np.cross(up, least), up)
    along /= np.linalg.norm(along)
    return along, np.cross(up, along)


def camera_ring(
    posed: NDArray[np.float64], up: NDArray[np.float64], views: int, width: int, height: int
) -> list[Camera]:
    """Return cameras evenly around the motion, all at one distance, at which every point stays inside every image.

    Args:
        posed: vertices of all frames, [T, n, 3].
        up: unit vector, [3].
        views: number of cameras; neighbours in index are neighbours in azimuth.
        width: image width in pixels.
        height: image height in pixels.

    Returns:
        World cameras that look at the middle of the motion's bounds.
    """
    along, across = horizontal_axes(up)
    basis = np.stack((along, across, up))
    points = posed.reshape(-1, 3) @ basis.T
    target = (points.min(0) + points.max(0)) / 2 @ basis
    points = posed.reshape(-1, 3) - target
    focal = max(width, height) / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    half = np.array([width, height]) / 2 * (1 - MARGIN) / focal
    directions = []
    distance = 0.0
    for view in range(views):
        azimuth = 2 * np.pi * view / views
        elevation = np.radians(ELEVATION + ELEVATION_SWING * np.sin(ELEVATION_WAVES * azimuth))
        flat = np.cos(azimuth) * along + np.sin(azimuth) * across
        direction = np.cos(elevation) * flat + np.sin(elevation) * up
        rotation = look_at(*(torch.from_numpy(v) for v in (direction, np.zeros(3), up)))[:3, :3].numpy()
        local = points @ rotation.T
        distance = max(distance, float((np.abs(local[:, :2]) / half - local[:, 2:]).max()))
        directions.append(direction)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    aim, top = torch.from_numpy(target), torch.from_numpy(up)
    eyes = (torch.from_numpy(target + distance * direction) for direction in directions)
    return [Camera(look_at(eye, aim, top), intrinsics, width, height) for eye in eyes]
