"""Read Artemis / DFA folders into clips and truths (the format: `files`, `volume`).

Choices that the format leaves open: RGB files hold straight colour, so premultiplying by the matte is ours; a motion
plays at 30 frames a second unless its name says otherwise; no world axis is assumed to point up.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rewild4d.contracts import Finding, Selection
from rewild4d.datasets.artemis import files
from rewild4d.datasets.artemis.check import check_animal
from rewild4d.datasets.artemis.mesh import read_mesh
from rewild4d.datasets.artemis.recipe import read_recipe
from rewild4d.datasets.artemis.rig import read_rig
from rewild4d.datasets.artemis.selection import held_out, placed_view, selected_views, up_direction
from rewild4d.datasets.artemis.views import SOLID, look, strayed, strayed_sentence
from rewild4d.datasets.artemis.volume import SURFACE_POINTS, MovingSurface, Voxels, read_pose, read_surface
from rewild4d.datasets.artemis.writer import ArtemisWriter
from rewild4d.datasets.images import Decoded, ImagePair, decode
from rewild4d.datasets.masking.facts import FRAMED
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import digest
from rewild4d.types import Camera, Clip, Frame, Truth

__all__ = ["Artemis", "ArtemisWriter"]


class Artemis:
    """Artemis / DFA folders: one animal, or a folder of animals.

    Keeps contracts.DatasetReader. A case is "<animal>/<motion>", with "@side", "@oblique" or "@frontal" behind it where
    a fixed camera has placements.

    Raises:
        UserError: no such folder, or neither an animal nor a folder of animals.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise UserError(f"{self.root}: expected an animal's folder or a folder of animals, got no such folder.")
        folders = [self.root] if _is_animal(self.root) else sorted(filter(_is_animal, self.root.iterdir()))
        if not folders:
            raise UserError(
                f"{self.root / 'CamPose.inf'}: expected this file of an animal's folder (or a folder of such folders), "
                "got neither."
            )
        self._animals = {Path(os.path.abspath(folder)).name: folder for folder in folders}

    @property
    def licence(self) -> str:
        """Return the licences of all animals, each once."""
        return "; ".join(sorted({files.read_licence(folder) for folder in self._animals.values()}))

    def cases(self, selection: Selection) -> list[str]:
        """Return names of all cases without reading images; one is "(unreadable)" of an animal with unknown motions.

        Animals are not verified here, so that a faulty one does not stop the others: `load` does that.
        """
        return list(self._table(selection))

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        """Decode one case: the clip holds the selected view of each kept frame, the truth all other views of them.

        Raises:
            UserError: no such case, or files of it that cannot be used.
        """
        if folder := self._animals.get(case.partition("/")[0]):
            files.list_motions(folder)
            files.read_intrinsics(folder / "Intrinsic.inf", len(files.read_cameras(folder / "CamPose.inf")))
        known = self._table(selection)
        if case not in known:
            raise unknown_name("case", case, known)
        animal, motion, placement = known[case]
        return _Motion(self._animals[animal], motion, selection).split(case, animal, placement)

    def check(self) -> list[Finding]:
        """Verify layout and contents of every animal, each file decoded; all faults, not only the first."""
        return [finding for folder in self._animals.values() for finding in check_animal(folder)]

    def recipe(self, case: str) -> str:
        """Return the digest of a rendered case's recipe; "" for one that was filmed, or edited since."""
        return read_recipe(self._animals[case.partition("/")[0]])

    def _table(self, selection: Selection) -> dict[str, tuple[str, str, str]]:
        """Return the case name -> animal, motion, placement ("" for none)."""
        placements = selection.placements if selection.cameras == "fixed" else ()
        table: dict[str, tuple[str, str, str]] = {}
        for animal, folder in self._animals.items():
            for motion in _motion_names(folder):
                for placement in placements or ("",):
                    suffix = f"@{placement}" if placement else ""
                    table[f"{animal}/{motion}{suffix}"] = (animal, motion, placement)
        return table


@dataclass(frozen=True)
class _Motion:
    """The kept frames of one motion."""

    folder: Path
    motion: str
    selection: Selection

    @cached_property
    def frames(self) -> list[int]:
        return list(range(0, files.list_motions(self.folder)[self.motion], self.selection.stride))

    @cached_property
    def camera_to_world(self) -> np.ndarray:
        return files.read_cameras(self.folder / "CamPose.inf")

    @cached_property
    def fps(self) -> float:
        return files.frames_per_second(self.motion) / self.selection.stride

    def split(self, case: str, species: str, placement: str) -> tuple[Clip, Truth]:
        """Return the clip and the truth of a case."""
        views = len(self.camera_to_world)
        surface = read_surface(self.folder)
        bones = len(surface.bones_rest) if surface else 0
        poses = [read_pose(self.folder, self.motion, frame, bones) for frame in self.frames if surface]
        fixed_view = self._fixed_view(placement, surface, poses)
        selected = selected_views(len(self.frames), views, self.selection, fixed_view)
        folders = files.list_frames(self.folder / "img" / self.motion)
        pairs = [files.list_images(folders[number], views) for number in self.frames]
        decoded = decode(pairs, self.selection, case)
        _expect_animal(decoded, pairs, selected)
        cameras = self._cameras(decoded)
        self._expect_meeting(decoded, cameras)
        shown = _Frames(decoded, cameras, list(enumerate(selected)), self.fps)
        hidden = _Frames(decoded, shown.cameras, held_out(selected, views), self.fps)
        notes = tuple(self._notes(decoded, selected))
        clip = Clip(case, species, tuple(shown), self.fps, files.read_licence(self.folder), shown.digest(), notes)
        up = torch.from_numpy(up_direction(self.camera_to_world))
        if surface is None:
            return clip, Truth(hidden, None, hidden.digest(), up=up)
        mesh = read_mesh(self.folder, surface)
        moving = MovingSurface(mesh or surface, poses, self.fps)
        key = digest(hidden.digest(), *map(moving.at, clip.times))
        rig = partial(read_rig, self.folder, poses)
        diagonal, source = (mesh.diagonal, "mesh of the rig") if mesh else (surface.diagonal, "voxels")
        return clip, Truth(hidden, moving.at, key, moving.sample, diagonal, up, rig, source)

    def _fixed_view(self, placement: str, surface: Voxels | None, poses: list[np.ndarray]) -> int:
        """Return the camera at a placement relative to the animal at the first frame; view 0 without one."""
        if not placement:
            return 0
        if surface is None:
            raise UserError(
                f"{self.folder / 'volumes'}: expected the animal's voxels, which tell its {placement}, got none."
            )
        return placed_view(placement, surface.thinned(SURFACE_POINTS).posed(poses[0]), self.camera_to_world)

    def _expect_meeting(self, decoded: Decoded, cameras: list[Camera]) -> None:
        """Fail on cameras that do not look at the animal of their own images."""
        looks = [look(alpha) for alpha in decoded.rgba[0, ..., 3]]
        wrong, shown = len(strayed(cameras, looks)), sum(found is not None for found in looks)
        if 2 * wrong > shown:
            raise UserError(strayed_sentence(self.folder, self.motion, wrong, shown))

    def _notes(self, decoded: Decoded, selected: list[int]) -> Iterator[str]:
        """Yield what a person should know of this motion before its scores."""
        looks = [look(decoded.rgba[index, view, ..., 3]) for index, view in enumerate(selected)]
        framed = sum(found is not None and found.framed > FRAMED for found in looks)
        if framed and self.selection.framing == "full":
            yield f"{framed} of {len(looks)} input mattes are animal all along the image's border: are they inverted?"
        longest = max(decoded.source)
        if self.selection.framing == "full" and longest < self.selection.size:
            yield f"images of {longest} pixels are enlarged to the protocol's {self.selection.size}"
        if len(self.camera_to_world) == 1:
            yield "one view: none is held out, so that no novel view can be scored"

    def _cameras(self, decoded: Decoded) -> list[Camera]:
        """Return the world camera of each view for the decoded images."""
        intrinsics = files.read_intrinsics(self.folder / "Intrinsic.inf", len(self.camera_to_world))
        height, width = decoded.rgba.shape[2:4]
        cameras = []
        for pose, matrix, window in zip(self.camera_to_world, intrinsics, decoded.windows, strict=True):
            full = Camera(torch.from_numpy(np.linalg.inv(pose)), torch.from_numpy(matrix.copy()), *decoded.source)
            cameras.append(window.camera(full, width, height))
        return cameras


class _Frames(Sequence[Frame]):
    """Frames read from the memory map on access."""

    def __init__(self, decoded: Decoded, cameras: list[Camera], pairs: list[tuple[int, int]], fps: float) -> None:
        self.cameras, self._rgba, self._pairs, self._fps = cameras, decoded.rgba, pairs, fps

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[item] for item in range(*index.indices(len(self)))]
        frame, view = self._pairs[index]
        rgba = torch.from_numpy(self._rgba[frame, view].astype(np.float32) / 255).permute(2, 0, 1).contiguous()
        return Frame(frame / self._fps, self.cameras[view], rgba[:3], rgba[3:], view)

    def digest(self) -> str:
        """Return SHA-256 over times, cameras and pixels."""
        parts: list[str | torch.Tensor | np.ndarray] = [repr(self._fps)]
        for frame, view in self._pairs:
            camera = self.cameras[view]
            parts += [f"{frame} {view}", camera.world_to_camera, camera.intrinsics, self._rgba[frame, view]]
        return digest(*parts)


def _expect_animal(decoded: Decoded, pairs: list[list[ImagePair]], selected: list[int]) -> None:
    """Fail on an empty matte among the inputs, or where all of them are next to empty."""
    highest = 0
    for index, view in enumerate(selected):
        highest = max(highest, peak := int(decoded.rgba[index, view, ..., 3].max()))
        if not peak:
            raise UserError(f"{pairs[index][view].alpha}: expected a matte with an animal in it, got an empty one.")
    if highest < SOLID:
        raise UserError(
            f"{pairs[0][selected[0]].alpha}: expected mattes from 0 to 255, but this and all {len(selected)} that "
            f"belong to inputs end at {highest}."
        )


def _motion_names(folder: Path) -> list[str]:
    """Return motions of an animal; of a faulty one the folders that it has, or a word in their place."""
    try:
        return list(files.list_motions(folder))
    except UserError:
        return [path.name for path in files.motion_folders(folder)] or ["(unreadable)"]


def _is_animal(folder: Path) -> bool:
    """Tell whether a folder is meant as an animal's; one that a killed writer left behind starts with a dot."""
    return not folder.name.startswith(".") and ((folder / "CamPose.inf").is_file() or (folder / "img").is_dir())
