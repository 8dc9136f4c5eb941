"""Read DAVIS 2016 and 2017 (Perazzi et al. 2016; Pont-Tuset et al. 2017).

    JPEGImages/<480p | ...>/<sequence>/00000.jpg
    Annotations/<480p | ...>/<sequence>/00000.png
    badja/<sequence>.json

Masks of 2016 are grey (0 and 255) and hold one foreground; those of 2017 are indexed, hold object ids and 255 for void.
A sequence with several objects gives a case for each, "dogs-jump@2", beside the one of all together, "dogs-jump".
BADJA's joints are read where they lie beside it.
"""

from functools import cached_property, partial
from importlib import resources
from pathlib import Path
from typing import Any

from rewild4d.contracts import Selection
from rewild4d.datasets.keypoints.files import read_keypoints
from rewild4d.datasets.keypoints.keypoints import read_badja
from rewild4d.datasets.masking.masks import MaskFiles, list_images, match_masks, open_masks
from rewild4d.datasets.video.frame_files import FRAME_SUFFIXES, image_size, read_images, read_masks
from rewild4d.datasets.video.parts import with_parts
from rewild4d.datasets.video.reader import VideoDataset
from rewild4d.datasets.video.wild import Masks, Moment, Video, files_identity
from rewild4d.errors import UserError, unknown_name
from rewild4d.foreign.texts import read_toml
from rewild4d.types import Keypoints

FPS = 24.0
RESOLUTIONS = ("480p", "1080p", "Full-Resolution")
"""Of which the first that is there is read."""
LICENCE = "CC BY-NC 4.0 (DAVIS, Perazzi et al. 2016, Pont-Tuset et al. 2017): attribute, non-commercial"
_ANNOTATIONS = ("Annotations", "Annotations_unsupervised")
_JOINTS = ("badja", "joint_annotations", "BADJA/joint_annotations")


def known_sequences() -> dict[str, dict[str, Any]]:
    """Return what is known of the animals in DAVIS, by sequence (davis.toml)."""
    return read_toml(resources.files("rewild4d.datasets.video") / "davis.toml", "the sequences of DAVIS")


class Davis(VideoDataset):
    """DAVIS 2016 and 2017: real videos with true masks.

    Args:
        root: the folder that holds JPEGImages (or a folder DAVIS that does).
        masks: other masks for the frames that methods see, <sequence>/00000.png; held-out frames are judged by DAVIS's
            own where they are there.
        keypoints: a file of them (`keypoint_files`) in place of BADJA's.
        parts: of the masks that methods see (`parts.Parts`); held-out frames are judged by all of DAVIS's.

    Raises:
        UserError: no such folder, or no frames in it.
    """

    licence = LICENCE
    options = ("masks", "keypoints", "parts")
    keypoint_mapping, keypoint_use = "badja", "none"

    def __init__(
        self, root: Path, masks: Path | None = None, keypoints: Path | None = None, parts: str = "auto"
    ) -> None:
        self.root = root / "DAVIS" if (root / "DAVIS" / "JPEGImages").is_dir() else root
        self.masks, self.keypoints = (Path(path) if path else None for path in (masks, keypoints))
        self.parts = parts
        images = self.root / "JPEGImages"
        self.resolution = next((name for name in RESOLUTIONS if (images / name).is_dir()), None)
        if self.resolution is None:
            raise UserError(f"{images}: expected frames in one of {', '.join(RESOLUTIONS)}, got none.")
        if self.masks is not None and not self.masks.is_dir():
            raise UserError(f"{self.masks}: expected a folder of masks, got no such folder.")

    def cases(self, selection: Selection) -> list[str]:
        """Return every sequence with masks; where it has several objects, "<sequence>@<id>" for each of them too."""
        return list(self._table)

    def default_cases(self, selection: Selection) -> list[str]:
        """Return the quadrupeds among the known sequences (all sequences where there is none), one object at a time.

        Objects that are known to be people or things are none of them (`animals` in davis.toml).
        """
        known = known_sequences()
        several = {sequence for sequence, number in self._table.values() if number is not None}
        single = {
            case: sequence for case, (sequence, number) in self._table.items() if number or sequence not in several
        }
        fit = [case for case, name in single.items() if known.get(name, {}).get("quadruped", name in known)]
        chosen = [case for case in fit if not self._strangers(case)]
        return chosen or list(single)

    def video(self, case: str) -> Video:
        if case not in self._table:
            raise unknown_name("case", case, self._table)
        sequence, object_id = self._table[case]
        files = self._frames(sequence)
        size = image_size(files[0])
        own = self._own_masks(sequence, files)
        given, note = self._given_masks(sequence, files, object_id)
        used, every = given or own, range(len(files))
        masks = partial(read_masks, used, object_id, every, size)
        joints, outside = self._joints(sequence, files, size, masks)
        facts = known_sequences().get(sequence, {})
        species, strangers = str(facts.get("species", sequence)), self._strangers(case)
        told = f"no {species}: object {', '.join(map(str, strangers))} of its masks" if strangers else ""
        is_odd = not facts.get("quadruped", True)
        odd = f"a {species} is no quadruped: no four-legged template fits" if is_odd else ""
        notes = (note, used.meaning.note, outside, str(facts.get("note", "")), odd, told)
        video = Video(
            title=str(files[0].parent), name=case, species=case if object_id in strangers else species, fps=FPS,
            licence=LICENCE, identity=files_identity(*files, *own.files, *used.files) + f" {object_id}", size=size,
            moments=tuple(Moment(file.name, i / FPS, joints.get(file.stem)) for i, file in enumerate(files)),
            images=partial(read_images, files, size),
            masks=masks,
            true_masks=partial(read_masks, own, object_id, every, size) if given or self.parts == "main" else None,
            notes=tuple(text for text in notes if text),
        )  # fmt: skip
        # what DAVIS itself calls one object is one
        is_named = given is None or (object_id is None and len(given.ids) > 1)
        return with_parts(video, self.parts, is_named)

    @cached_property
    def _table(self) -> dict[str, tuple[str, int | None]]:
        """Case -> sequence and object id (None: the whole foreground)."""
        table: dict[str, tuple[str, int | None]] = {}
        for folder in sorted((self.root / "JPEGImages" / str(self.resolution)).iterdir()):
            masks = self._mask_folder(folder.name)
            if not folder.is_dir() or masks is None:
                continue
            ids = open_masks(list_images(masks)[:1]).ids  # the first frame names all objects
            table[folder.name] = (folder.name, None)
            if len(ids) > 1:
                table |= {f"{folder.name}@{number}": (folder.name, number) for number in ids}
        if not table:
            raise UserError(f"{self.root / 'Annotations'}: expected masks of the sequences in JPEGImages, got none.")
        return table

    def _mask_folder(self, sequence: str) -> Path | None:
        folders = [self.root / name / str(self.resolution) / sequence for name in _ANNOTATIONS]
        given = [self.masks / sequence] if self.masks else []
        return next((folder for folder in (*folders, *given) if folder.is_dir() and list_images(folder)), None)

    def _frames(self, sequence: str) -> list[Path]:
        folder = self.root / "JPEGImages" / str(self.resolution) / sequence
        files = list_images(folder, FRAME_SUFFIXES)
        if not files:
            raise UserError(f"{folder}: expected frames ({', '.join(FRAME_SUFFIXES)}), got none.")
        return files

    def _own_masks(self, sequence: str, files: list[Path]) -> MaskFiles:
        """Return DAVIS's masks; none where it has none."""
        for name in _ANNOTATIONS:
            folder = self.root / name / str(self.resolution) / sequence
            if folder.is_dir() and (found := list_images(folder)):
                return open_masks(match_masks(found, [file.stem for file in files], folder)[0])
        return MaskFiles((None,) * len(files))

    def _given_masks(self, sequence: str, files: list[Path], object_id: int | None) -> tuple[MaskFiles | None, str]:
        """Return masks of --masks and a note on them; those without object ids are of the one animal of the case."""
        if self.masks is None:
            return None, ""
        folder = self.masks / sequence
        found, note = match_masks(list_images(folder), [file.stem for file in files], folder)
        masks, note = open_masks(found), f"masks of the input from {folder}" + (f"; {note}" if note else "")
        if object_id is None or object_id in masks.ids:
            return masks, note
        if masks.ids:
            raise UserError(
                f"{folder}: expected masks of object {object_id} for the case {sequence}@{object_id}, got those of "
                f"{', '.join(map(str, masks.ids))} (masks of one animal alone hold 0 and 255)."
            )
        return masks, f"{note}; they hold no object ids: all of them is taken as object {object_id}"

    def _joints(
        self, sequence: str, files: list[Path], size: tuple[int, int], masks: Masks
    ) -> tuple[dict[str, Keypoints], str]:
        """Return keypoints by the frame's stem, and a sentence on what their file holds but is not used."""
        stems = [file.stem for file in files]
        files_of_joints = [self.root / folder / f"{sequence}.json" for folder in _JOINTS]
        own = next((file for file in files_of_joints if file.is_file()), None)
        if self.keypoints is not None:
            found, told = read_keypoints(self.keypoints, stems, size, lambda: enumerate(masks()))
        elif own is not None:
            found, told = read_badja(own, stems, size)
        else:
            return {}, ""
        known = {stem: points for stem, points in zip(stems, found, strict=True) if points is not None}
        return known, told

    def _strangers(self, case: str) -> list[int]:
        """Return ids of a case's objects that are known to be no animal (`animals` in davis.toml)."""
        sequence, object_id = self._table[case]
        facts, masks = known_sequences().get(sequence, {}), self._mask_folder(sequence)
        # masks from elsewhere may number their objects otherwise
        if "animals" not in facts or masks is None or not masks.is_relative_to(self.root / _ANNOTATIONS[0]):
            return []
        ids = [number for name, number in self._table.values() if name == sequence and object_id in (None, number)]
        return [number for number in ids if number is not None and number not in facts["animals"]]
