"""Read APTv2 and APT-36K (Yang et al. 2022, 2023): short clips with boxes, tracks and 17 keypoints, without masks.

    annotations/*.json    data/<easy | hard>/<species>/<clip>/0000.jpg    masks/<same path>/0000_<track>.png

A case is one animal of one clip: "easy/10gorilla/v12C1@3". Masks are made by other programs (`rewild4d-bench
masks`) and lie in a folder beside the data: named as above, or <case>/0000.png.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path

from rewild4d.contracts import Finding, Selection
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.masks import open_masks
from rewild4d.datasets.video.apt_files import UNLISTED, Annotations, Sighting, Subject, read_annotations
from rewild4d.datasets.video.frame_files import image_size, read_images, read_masks
from rewild4d.datasets.video.parts import with_parts
from rewild4d.datasets.video.reader import VideoDataset
from rewild4d.datasets.video.wild import LEAST_FRAMES, Moment, Video, files_identity
from rewild4d.errors import UserError, unknown_name

FPS = 10.0
"""The clips were thinned and nobody says how much: this is assumed."""
LICENCE = "frames from YouTube, no licence stated (APTv2, Yang et al. 2023): do not pass on"
PRIMATES = ("chimpanzee", "gorilla", "howling monkey", "monkey", "noisy night monkey", "orangutan", "spider monkey")
"""Species that a four-legged template does not fit."""


class AptV2(VideoDataset):
    """APTv2 and APT-36K: short real clips with keypoints.

    Args:
        root: the folder that holds the annotations.
        masks: of the animals; root/masks where it is left out.
        parts: of them (`parts.Parts`).

    Raises:
        UserError: no such folder.
    """

    licence = LICENCE
    options = ("masks", "parts")
    keypoint_mapping, keypoint_use = "aptv2", "all"

    def __init__(self, root: Path, masks: Path | None = None, parts: str = "auto") -> None:
        self.root, self.parts = root, parts
        self.masks = Path(masks) if masks and Path(masks) != root / "masks" else None
        for folder in (root, *([Path(masks)] if masks else [])):
            if not folder.is_dir():
                raise UserError(f"{folder}: expected a folder, got no such folder.")

    def cases(self, selection: Selection) -> list[str]:
        """Return every animal that is annotated in enough frames of a clip.

        Raises:
            UserError: annotations that cannot be used.
        """
        enough = [name for name, found in self._annotations.subjects.items() if len(found.sightings) >= LEAST_FRAMES]
        if not enough:
            raise UserError(f"{self.root}: expected an animal that {LEAST_FRAMES} frames of a clip show, got none.")
        return enough

    def default_cases(self, selection: Selection) -> list[str]:
        """Return the quadrupeds that have masks; all where none has."""
        names = self.cases(selection)
        subjects = self._annotations.subjects
        chosen = [name for name in names if subjects[name].species not in PRIMATES and self._masked(subjects[name])]
        return chosen or names

    def video(self, case: str) -> Video:
        subjects = self._annotations.subjects
        if case not in subjects:
            raise unknown_name("case", case, subjects)
        subject = subjects[case]
        files, size = self._images(subject)
        masks = open_masks([self._mask(subject, sighting) for sighting in subject.sightings])
        if not self._masked(subject):
            place = list(self._mask_places(subject, subject.sightings[0]))[1]
            raise UserError(
                f"{place}: expected masks of {case} (this one and its neighbours), got none; APTv2 has none of its "
                "own, `rewild4d-bench masks` makes some."
            )
        first, faults = subject.sightings[0].number, self._annotations.clip_faults
        points = repr([sighting.keypoints.points.tolist() for sighting in subject.sightings])
        track = subject.track if subject.track in masks.ids else None
        notes = (
            f"the frame rate is not known: {FPS:g} frames a second assumed",
            f"{subject.outside} keypoints outside their image taken as not visible" if subject.outside else "",
            f"a {subject.species} is no quadruped: no four-legged template fits" if subject.species in PRIMATES else "",
            "its category is not listed: taken for a quadruped" if subject.species == UNLISTED else "",
            *faults.get(str(subject.sightings[0].file.parent), ()),
            *faults.get("", ()),
            masks.meaning.note,
            f"masks hold objects {', '.join(map(str, masks.ids))}, none of them track {subject.track}: taken together"
            if track is None and len(masks.ids) > 1
            else "",
        )
        video = Video(
            title=str(files[0].parent), name=case, species=subject.species, fps=FPS, licence=LICENCE,
            identity=files_identity(*files, *masks.files) + points, size=size,
            moments=tuple(
                Moment(file.name, (s.number - first) / FPS, s.keypoints)
                for file, s in zip(files, subject.sightings, strict=True)
            ),
            images=partial(read_images, files, size),
            masks=partial(read_masks, masks, track, range(len(files)), size),
            notes=tuple(note for note in notes if note),
        )  # fmt: skip
        return with_parts(video, self.parts, is_named=track is None and len(masks.ids) > 1)

    def check(self, cases: Sequence[str] = (), sheets: Path | None = None) -> list[Finding]:
        """Verify the annotations and some animals that have masks; contact sheets go to ``sheets``."""
        faults = [Finding("warning", str(self.root), fault) for fault in self._annotations.faults]
        return faults + super().check(cases, sheets)

    def unmasked(self, case: str) -> Unmasked:
        """Return the frames of a case and the annotated box in each, for programs that make masks."""
        if case not in self._annotations.subjects:
            raise unknown_name("case", case, self._annotations.subjects)
        subject = self._annotations.subjects[case]
        files, size = self._images(subject)
        stems = tuple(file.stem for file in files)
        boxes = {index: sighting.box for index, sighting in enumerate(subject.sightings)}
        return Unmasked(str(files[0].parent), stems, size, partial(read_images, files, size), boxes)

    @cached_property
    def _annotations(self) -> Annotations:
        return read_annotations(self.root)

    def _images(self, subject: Subject) -> tuple[list[Path], tuple[int, int]]:
        """Return the frames of a subject, and their width and height, which all of its annotations must state."""
        files = [self._image(sighting) for sighting in subject.sightings]
        size = image_size(files[0])
        for file, sighting in zip(files, subject.sightings, strict=True):
            if sighting.size != size:
                raise UserError(
                    f"{file}: expected {sighting.size[0]}x{sighting.size[1]} pixels, for which its boxes and keypoints "
                    f"are, got {size[0]}x{size[1]}."
                )
        return files, size

    def _image(self, sighting: Sighting) -> Path:
        places = [self.root / folder / sighting.file for folder in ("data", "", "images")]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise UserError(f"{places[0]}: expected this image of the annotations (or {places[1]}), got neither.")
        return found

    def _mask(self, subject: Subject, sighting: Sighting) -> Path | None:
        return next((place for place in self._mask_places(subject, sighting) if place.is_file()), None)

    def _mask_places(self, subject: Subject, sighting: Sighting) -> Iterator[Path]:
        clip, stem = sighting.file.parent, sighting.file.stem
        masks = self.masks or self.root / "masks"
        yield masks / subject.name / f"{stem}.png"
        yield masks / clip / f"{stem}_{subject.track}.png"

    def _masked(self, subject: Subject) -> bool:
        return any(self._mask(subject, sighting) for sighting in subject.sightings)
