"""What the readers of real videos share."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rewild4d.contracts import Finding, Selection, Verdict
from rewild4d.datasets.masking.trust import MaskTrust
from rewild4d.datasets.video.mask_check import MOST_CASES, SPLIT, check_video, finding_of
from rewild4d.datasets.video.wild import Video, original_images, split_video
from rewild4d.errors import UserError
from rewild4d.types import Clip, Truth

_JUDGED: dict[str, Verdict] = {}
"""Verdicts on masks by what decides them: a run asks before its fit and again for its record."""


class VideoDataset(ABC):
    """Videos with masks, each one a case. Keeps contracts.DatasetReader.

    Attributes:
        options: names of what may be set beside the root; each is an attribute too.
    """

    options: tuple[str, ...]

    @property
    def settings(self) -> dict[str, str]:
        """The options that differ from their defaults, for the record."""
        given = {name: getattr(self, name) for name in self.options}
        return {
            name: str(value.resolve() if isinstance(value, Path) else value)
            for name, value in given.items()
            if value is not None and value != "auto"
        }

    @abstractmethod
    def cases(self, selection: Selection) -> list[str]:
        """Return the names of all cases."""

    @abstractmethod
    def default_cases(self, selection: Selection) -> list[str]:
        """Return the cases that are taken where none is named."""

    @abstractmethod
    def video(self, case: str) -> Video:
        """Return the frames and masks of a case, and its keypoints where it has some.

        Raises:
            UserError: no such case, no masks for it, or files that cannot be used.
        """

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        """Decode one case; its errors are those of `video`."""
        return split_video(self.video(case), selection)

    def originals(self, case: str, selection: Selection) -> Iterator[np.ndarray] | None:
        """Return the whole frames behind the images of a clip, uint8 [h, w, 3]; its errors are those of `video`.

        None where the data set lacks them.
        """
        return original_images(self.video(case), selection)

    def judge_masks(self, case: str) -> Verdict:
        """Return whether the masks of a case can be trusted; its errors are those of `video`."""
        video = self.video(case)
        if video.identity not in _JUDGED:
            trust = MaskTrust(len(video.moments))
            for index, (image, mask) in enumerate(zip(video.images(), video.masks(), strict=False)):
                trust.add(index, image, mask)
            _JUDGED[video.identity] = trust.verdict([moment.label for moment in video.moments])
        return _JUDGED[video.identity]

    def check(self, cases: Sequence[str] = (), sheets: Path | None = None) -> list[Finding]:
        """Verify every frame and mask of some cases (the first few default ones where none is named).

        Contact sheets go to the folder ``sheets``; None draws none.
        """
        try:
            names = list(cases) or self.default_cases(SPLIT)
        except UserError as error:
            return [finding_of(error)]
        findings = []
        for name in names if cases else names[:MOST_CASES]:
            try:
                findings += check_video(self.video(name), sheets)
            except UserError as error:
                findings.append(finding_of(error))
        if not cases and len(names) > MOST_CASES:
            told = f"{MOST_CASES} of {len(names)} cases looked at; --case names others"
            findings.append(Finding("warning", "check", told))
        return findings
