"""Verifies an Artemis / DFA animal's folder without stopping at the first fault, with the reader's own validators."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, ParamSpec, TypeVar

import numpy as np
from tqdm import tqdm

from rewild4d.contracts import Finding
from rewild4d.datasets.artemis_files import (
    NO_LICENCE,
    ImagePair,
    list_frames,
    list_images,
    list_motions,
    read_cameras,
    read_intrinsics,
    read_licence,
)
from rewild4d.datasets.artemis_volume import read_pose, read_skeleton, read_surface
from rewild4d.datasets.images import read_pair, read_rgb
from rewild4d.datasets.recipe import FILE as RECIPE
from rewild4d.datasets.recipe import read_recipe
from rewild4d.errors import UserError

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def check_animal(animal: Path) -> list[Finding]:
    """All faults of one animal's folder; every image is decoded.

    Returns:
        Errors (the data cannot be used), warnings (it can, but look), and a last "ok" line where there was no error.
    """
    return _Check(animal).run()


class _Check:
    def __init__(self, animal: Path) -> None:
        self.animal = animal
        self.findings: list[Finding] = []

    def run(self) -> list[Finding]:
        animal, images = self.animal, self.animal / "img"
        cameras = self._attempt(read_cameras, animal / "CamPose.inf")
        views = len(cameras) if cameras is not None else 0
        intrinsics = self._attempt(read_intrinsics, animal / "Intrinsic.inf", views) if views else None
        self._attempt(list_motions, animal)
        bones = self._skeleton()
        motions = sorted(path for path in images.iterdir() if path.is_dir()) if images.is_dir() else []
        for motion in motions:
            frames = self._attempt(list_frames, motion) or []
            for number in range(len(frames) if bones else 0):
                self._attempt(read_pose, animal, motion.name, number, bones)
            if views:
                self._images(motion.name, frames, views, intrinsics)
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
        self._attempt(read_surface, self.animal)
        return len(bones) if bones is not None else 0

    def _images(self, motion: str, frames: list[Path], views: int, intrinsics: np.ndarray | None) -> None:
        """Decode every view of every frame."""
        pairs: list[ImagePair] = []
        for frame in frames:
            pairs += self._attempt(list_images, frame, views) or []
        first = self._attempt(read_rgb, pairs[0].rgb) if pairs else None
        source = (first.shape[1], first.shape[0]) if first is not None else None
        title = f"checking {self.animal.name}/{motion}"
        with ThreadPoolExecutor(2) as pool:
            results = pool.map(_is_seen, pairs, [source] * len(pairs))
            progress = tqdm(results, total=len(pairs), desc=title, disable=None, leave=False)
            shown = False
            for pair, seen in zip(pairs, progress, strict=True):
                shown = shown or seen is True
                if isinstance(seen, UserError):
                    self._fault(seen)
                elif not seen:
                    self._add("warning", pair.alpha, "the matte is empty: this image cannot be an input")
        if pairs and not shown:
            self._add("error", self.animal / "img" / motion, "no matte shows an animal that could be an input")
        if source and intrinsics is not None:
            self._principal_points(source, intrinsics)
        if any(pair.rgb.suffix.lower() != ".png" for pair in pairs):
            self._add("warning", self.animal / "img" / motion, "images are JPEG: expect compression at the silhouette")

    def _principal_points(self, source: tuple[int, int], intrinsics: np.ndarray) -> None:
        """Warn of intrinsics that seem to belong to another image size."""
        off = np.abs(intrinsics[:, :2, 2] / source - 0.5).max(axis=1) > 0.25
        if off.any():
            view = int(np.flatnonzero(off)[0])
            cx, cy = intrinsics[view, :2, 2]
            self._add(
                "warning",
                self.animal / "Intrinsic.inf",
                f"the principal point of view {view} is ({cx:.0f}, {cy:.0f}), far from the middle of its "
                f"{source[0]}x{source[1]} image: were the images resized?",
            )

    def _notes(self) -> None:
        if not (self.animal / "sequences").is_file():
            self._add("warning", self.animal / "sequences", "no list of motions: the folders under img/ are taken")
        if read_licence(self.animal) == NO_LICENCE:
            self._add("warning", self.animal, NO_LICENCE)
        recipe = self.animal / RECIPE
        if recipe.is_file() and not read_recipe(self.animal):
            self._add("warning", recipe, "the files are no longer those that were rendered: the data counts as new")

    def _attempt(
        self,
        action: Callable[_Arguments, _Result],
        *args: _Arguments.args,
        **kwargs: _Arguments.kwargs,
    ) -> _Result | None:
        """What an action returns, or None and a finding where it fails."""
        try:
            return action(*args, **kwargs)
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


def _is_seen(pair: ImagePair, source: tuple[int, int] | None) -> bool | UserError:
    """Whether a matte holds anything, or what is wrong with the pair of images."""
    try:
        _, alpha = read_pair(pair, source)
    except UserError as error:
        return error
    return bool(alpha.any())
