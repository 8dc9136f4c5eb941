"""Verify an Artemis / DFA animal's folder without stopping at the first fault, with the reader's own validators."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from rewild4d.contracts import Finding
from rewild4d.datasets.artemis import files
from rewild4d.datasets.artemis.recipe import FILE as RECIPE
from rewild4d.datasets.artemis.recipe import read_recipe
from rewild4d.datasets.artemis.views import SOLID, Look, covered, look, strayed, strayed_sentence
from rewild4d.datasets.artemis.volume import SURFACE_POINTS, Voxels, read_pose, read_skeleton, read_surface
from rewild4d.datasets.images import ImagePair, read_alpha, read_pair, read_rgb
from rewild4d.datasets.masking.facts import FRAMED
from rewild4d.errors import UserError
from rewild4d.types import Camera

WHITE = 250
"""Of 255: an animal as light as this all over cannot be told from the white that protocols put behind it."""
COVERED = 0.75
"""Share of the posed voxels that fall on the mattes, below which they are of another world: 0.9 where all is well."""
LOOKED_AT = 12
"""Views whose mattes are held against the voxels."""

_Result = TypeVar("_Result")
_Study = tuple[Look | None, float]
"""What a pair of images holds: the matte's look, and the darkest value of the animal's mean colour."""


def check_animal(animal: Path) -> list[Finding]:
    """Return all faults of one animal's folder; every image is decoded.

    Returns:
        Errors (the data cannot be used), warnings (it can, but look), and a last "ok" line where there was no error.
    """
    return _Check(animal).run()


class _Check:
    def __init__(self, animal: Path) -> None:
        self.animal = animal
        self.findings: list[Finding] = []
        self.surface: Voxels | None = None

    def run(self) -> list[Finding]:
        animal = self.animal
        cameras = self._attempt(files.read_cameras, animal / "CamPose.inf")
        views = len(cameras) if cameras is not None else 0
        intrinsics = self._attempt(files.read_intrinsics, animal / "Intrinsic.inf", views) if views else None
        self._attempt(files.list_motions, animal)
        bones = self._skeleton()
        motions = files.motion_folders(animal)
        for motion in motions:
            frames = self._attempt(files.list_frames, motion) or []
            for number in range(len(frames) if bones else 0):
                self._attempt(read_pose, animal, motion.name, number, bones)
            if cameras is not None:
                self._images(motion.name, frames, cameras, intrinsics)
        if views == 1:
            self._add("warning", animal / "CamPose.inf", "one view: none is held out, so no novel view can be scored")
        self._notes()
        if all(finding.level != "error" for finding in self.findings):
            self._add("ok", animal, f"{len(motions)} motions, {views} views, {bones} bones")
        return self.findings

    def _skeleton(self) -> int:
        """Check bones and voxels; the number of bones, 0 where they cannot be used or are not there."""
        has_voxels = (self.animal / "volumes").is_dir()
        if not has_voxels:
            self._add("warning", self.animal / "volumes", "no voxels: geometry cannot be scored")
        if not has_voxels and not (self.animal / "bones").is_dir():
            return 0
        bones = self._attempt(read_skeleton, self.animal)
        self.surface = self._attempt(read_surface, self.animal)
        return len(bones) if bones is not None else 0

    def _images(
        self, motion: str, frames: list[Path], camera_to_world: np.ndarray, intrinsics: np.ndarray | None
    ) -> None:
        """Decode every view of every frame, and hold what the first one shows against cameras and voxels."""
        views = len(camera_to_world)
        listed = [self._attempt(files.list_images, frame, views) for frame in frames]
        pairs = [pair for found in listed for pair in found or []]
        first = self._attempt(read_rgb, pairs[0].rgb) if pairs else None
        source = (first.shape[1], first.shape[0]) if first is not None else None
        studies = self._studies(motion, pairs, source)
        usable = bool(pairs) and self._mattes(motion, pairs, studies)
        if source and intrinsics is not None:
            self._principal_points(source, intrinsics)
            if usable and listed[0]:
                world_to_camera = torch.from_numpy(np.linalg.inv(camera_to_world))
                cameras = [
                    Camera(*pair, *source) for pair in zip(world_to_camera, torch.from_numpy(intrinsics), strict=True)
                ]
                looks = [study[0] if study else None for study in studies[:views]]
                self._geometry(motion, cameras, pairs[:views], looks)
        if any(pair.rgb.suffix.lower() != ".png" for pair in pairs):
            self._add("warning", self.animal / "img" / motion, "images are JPEG: expect compression at the silhouette")

    def _studies(self, motion: str, pairs: list[ImagePair], source: tuple[int, int] | None) -> list[_Study | None]:
        """Return what each pair of images holds, None where it cannot be read."""
        title = f"checking {self.animal.name}/{motion}"
        with ThreadPoolExecutor(2) as pool:
            results = pool.map(_study, pairs, [source] * len(pairs))
            found = list(tqdm(results, total=len(pairs), desc=title, disable=None, leave=False))
        for pair, study in zip(pairs, found, strict=True):
            if isinstance(study, UserError):
                self._fault(study)
            elif study[0] is None:
                self._add("warning", pair.alpha, "the matte is empty: this image cannot be an input")
        return [None if isinstance(study, UserError) else study for study in found]

    def _mattes(self, motion: str, pairs: list[ImagePair], studies: list[_Study | None]) -> bool:
        """Add what the mattes of a motion have in common; whether they show an animal at all."""
        place = self.animal / "img" / motion
        studied = zip(pairs, studies, strict=True)
        shown = [(pair, study[0], study[1]) for pair, study in studied if study and study[0]]
        highest = max((found.highest for _, found, _ in shown), default=0)
        if highest < SOLID:
            said = f": they end at {highest}; are they 0 and 1 in place of 0 and 255?" if highest else ""
            self._add("error", place, f"no matte shows an animal that could be an input{said}")
            return False
        if framed := [pair for pair, found, _ in shown if found.framed > FRAMED]:
            told = f"{len(framed)} of {len(pairs)} mattes are animal all along the image's border: are they inverted?"
            self._add("warning", framed[0].alpha, told)
        if all(darkest >= WHITE for _, _, darkest in shown):
            self._add("warning", place, "the animal is white all over, as is the background of the protocols")
        return True

    def _geometry(self, motion: str, cameras: list[Camera], pairs: list[ImagePair], looks: list[Look | None]) -> None:
        """Hold cameras, mattes and voxels of the first frame against each other."""
        wrong, shown = strayed(cameras, looks), sum(found is not None for found in looks)
        if 2 * len(wrong) > shown:
            self._fault(UserError(strayed_sentence(self.animal, motion, len(wrong), shown)))
            return
        if wrong:
            names = ", ".join(map(str, wrong[:6])) + (", ..." if len(wrong) > 6 else "")
            told = f"views {names} do not look at the animal where the others see it ('{motion}', first frame)"
            self._add("warning", self.animal / "CamPose.inf", told)
        if self.surface is None or not shown:
            return
        pose = self._attempt(read_pose, self.animal, motion, 0, len(self.surface.bones_rest))
        if pose is None:
            return
        points = self.surface.thinned(SURFACE_POINTS).posed(pose)
        views = [view for view, found in enumerate(looks) if found is not None]
        spread = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, LOOKED_AT).round().astype(int))]
        share = np.mean([covered(points, cameras[view], read_alpha(pairs[view].alpha)) for view in spread])
        if share < COVERED:
            told = f"{share:.0%} of the voxels fall on the mattes of '{motion}', first frame"
            asked = "other voxels, bones, or order of the views? Geometry scores would be wrong"
            self._add("warning", self.animal / "volumes", f"{told}: {asked}")

    def _principal_points(self, source: tuple[int, int], intrinsics: np.ndarray) -> None:
        """Warn of intrinsics that seem to belong to another image size."""
        off = np.abs(intrinsics[:, :2, 2] / source - 0.5).max(axis=1) > 0.25
        if off.any():
            view = int(np.flatnonzero(off)[0])
            cx, cy = intrinsics[view, :2, 2]
            told = f"the principal point of view {view} is ({cx:.0f}, {cy:.0f}), far from the middle of its "
            told += f"{source[0]}x{source[1]} image: were the images resized?"
            self._add("warning", self.animal / "Intrinsic.inf", told)

    def _notes(self) -> None:
        if not (self.animal / "sequences").is_file():
            self._add("warning", self.animal / "sequences", "no list of motions: the folders under img/ are taken")
        if files.read_licence(self.animal) == files.NO_LICENCE:
            self._add("warning", self.animal, files.NO_LICENCE)
        recipe = self.animal / RECIPE
        if recipe.is_file() and not read_recipe(self.animal):
            self._add("warning", recipe, "the files are no longer those that were rendered: the data counts as new")

    def _attempt(self, action: Callable[..., _Result], *args: Any) -> _Result | None:
        """Return what an action returns, or None and a finding where it fails."""
        try:
            return action(*args)
        except UserError as error:
            self._fault(error)
            return None

    def _fault(self, error: UserError) -> None:
        """Add an error once: validators build on each other and so repeat themselves."""
        path, separator, message = str(error).removesuffix(".").partition(": ")
        if not any(str(finding.path) == path and finding.message == message for finding in self.findings):
            self._add("error", Path(path) if separator else self.animal, message or str(error))

    def _add(self, level: Literal["error", "warning", "ok"], path: Path, message: str) -> None:
        self.findings.append(Finding(level, str(path), message.rstrip(".")))


def _study(pair: ImagePair, source: tuple[int, int] | None) -> _Study | UserError:
    """Return what a pair of images holds, or what is wrong with it."""
    try:
        rgb, alpha = read_pair(pair, source)
    except UserError as error:
        return error
    found = look(alpha)
    solid = alpha >= SOLID
    darkest = float(rgb[solid].mean(axis=0).min()) if found and solid.any() else 0.0
    return found, darkest
