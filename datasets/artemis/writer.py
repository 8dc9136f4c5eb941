"""Writes one animal's folder in the Artemis / DFA format, whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import torch

from rewild4d.datasets.artemis.files import write_intrinsics, write_matrices
from rewild4d.datasets.artemis.mesh import Mesh, write_mesh
from rewild4d.datasets.artemis.recipe import write_recipe
from rewild4d.errors import UserError
from rewild4d.files import save_tensors
from rewild4d.types import Camera


class ArtemisWriter:
    """A context manager that builds an animal's folder beside its place and moves it there at the end.

    Args:
        folder: the animal's folder; must not exist, or be empty.
        cameras: one a view, at the full size of the images, the same for all frames and motions.
        bones_rest: global bone-to-world matrices at rest, [J, 4, 4].
        parents: parent of each bone, -1 for the root, [J].
        voxels: rest-pose voxel centres in the world, on a lattice, [V, 3].
        voxel_indices: bones that move each voxel, [V, K].
        voxel_weights: their skinning weights, [V, K].
        radius: half extent of the volume's box per axis, [3].
        licence: first line of the licence file; "" writes none.
        recipe: what decides the contents, except the processor (see `recipe`); None writes none.
        mesh: the rig's own triangles, by which shapes are scored; None: by the voxels.

    Raises:
        UserError: the folder is not empty or cannot be written.
        ValueError: at the end, an image of a motion was not written.
    """

    def __init__(
        self,
        folder: Path,
        cameras: Sequence[Camera],
        bones_rest: np.ndarray,
        parents: np.ndarray,
        voxels: np.ndarray,
        voxel_indices: np.ndarray,
        voxel_weights: np.ndarray,
        radius: np.ndarray,
        licence: str = "",
        recipe: dict[str, Any] | None = None,
        mesh: Mesh | None = None,
    ) -> None:
        self.folder = Path(folder).absolute()
        self._cameras = tuple(cameras)
        self._bones_rest = np.asarray(bones_rest, dtype=np.float64)
        self._parents = np.asarray(parents, dtype=np.int64)
        self._voxels = np.asarray(voxels, dtype=np.float32)
        self._indices = np.asarray(voxel_indices, dtype=np.int32)
        self._weights = np.asarray(voxel_weights, dtype=np.float32)
        self._radius = np.asarray(radius, dtype=np.float64)
        self._licence = licence
        self._recipe = recipe
        self._mesh = mesh
        self._frames: dict[str, int] = {}
        self._written: set[tuple[str, int, int]] = set()

    def __enter__(self) -> Self:
        try:
            if self.folder.exists() and any(self.folder.iterdir()):
                raise UserError(f"{self.folder}: expected a new or an empty folder, got one that holds files.")
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self._build = Path(tempfile.mkdtemp(dir=self.folder.parent, prefix=f".{self.folder.name}."))
        except OSError as error:
            raise UserError(f"{self.folder}: expected a folder that can be written, but: {error.strerror}.") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        except OSError as fault:
            raise UserError(f"{self.folder}: could not be written: {fault.strerror or fault}.") from fault
        finally:
            shutil.rmtree(self._build, ignore_errors=True)

    def motion(self, name: str, bones: np.ndarray) -> None:
        """Write the poses of one motion: global bone-to-world matrices, [T, J, 4, 4]."""
        folder = self._build / "bones" / name
        try:
            folder.mkdir(parents=True)
            for frame, pose in enumerate(np.asarray(bones, dtype=np.float64)):
                write_matrices(folder / f"Bones_{frame:04d}.inf", pose)
                (self._build / "img" / name / str(frame)).mkdir(parents=True)
        except OSError as error:
            raise UserError(f"{self.folder}: could not be written: {error.strerror}.") from error
        self._frames[name] = len(bones)

    def image(self, motion: str, frame: int, view: int, rgb: np.ndarray, alpha: np.ndarray) -> None:
        """Write one view: straight (not premultiplied) sRGB colour, uint8 [h, w, 3], and matte, uint8 [h, w].

        Any thread may call it, after `motion` for the same name.
        """
        camera = self._cameras[view]
        if rgb.shape != (camera.height, camera.width, 3) or alpha.shape != (camera.height, camera.width):
            raise ValueError(f"view {view} is {camera.width}x{camera.height}, got {rgb.shape} and {alpha.shape}")
        stem = self._build / "img" / motion / str(frame) / f"img_{view:04d}"
        try:
            for path, pixels in ((f"{stem}.png", rgb[..., ::-1]), (f"{stem}_alpha.png", alpha)):
                _, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels), (cv2.IMWRITE_PNG_COMPRESSION, 3))
                Path(path).write_bytes(encoded.tobytes())
        except OSError as error:
            raise UserError(f"{self.folder}: could not be written: {error.strerror}.") from error
        self._written.add((motion, frame, view))

    def _finish(self) -> None:
        """Write what does not depend on a frame, and give the folder its name."""
        views = len(self._cameras)
        for motion, frames in self._frames.items():
            for frame in range(frames):
                for view in range(views):
                    if (motion, frame, view) not in self._written:
                        raise ValueError(f"no image of motion {motion}, frame {frame}, view {view} was written")
        build = self._build
        world_to_camera = np.stack([camera.world_to_camera.numpy() for camera in self._cameras])
        write_matrices(build / "CamPose.inf", np.linalg.inv(world_to_camera))
        write_intrinsics(build / "Intrinsic.inf", np.stack([camera.intrinsics.numpy() for camera in self._cameras]))
        (build / "bones").mkdir(exist_ok=True)
        write_matrices(build / "bones" / "Bones_0000.inf", self._bones_rest)
        np.save(build / "bones" / "bone_parents.npy", self._parents)
        volumes = build / "volumes"
        volumes.mkdir()
        save_tensors(torch.from_numpy(self._voxels), volumes / "coords_init.pth")
        save_tensors(torch.from_numpy(self._indices), volumes / "volume_indices.pth")
        save_tensors(torch.from_numpy(self._weights), volumes / "volume_weights.pth")
        (volumes / "radius.txt").write_text(" ".join(f"{value:.9g}" for value in self._radius) + "\n", encoding="utf-8")
        if self._mesh is not None:
            write_mesh(build, self._mesh)
        listing = "".join(f"{name} {count}\n" for name, count in self._frames.items())
        (build / "sequences").write_text(listing, encoding="utf-8")
        if self._licence:
            (build / "licence.txt").write_text(self._licence + "\n", encoding="utf-8")
        if self._recipe is not None:
            write_recipe(build, self._recipe)
        os.chmod(build, 0o755)
        if self.folder.exists():
            self.folder.rmdir()  # Windows moves nothing onto a folder, not even onto an empty one
        os.replace(build, self.folder)
