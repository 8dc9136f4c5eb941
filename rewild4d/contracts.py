"""What a method, a reconstruction and a dataset reader promise. Structural: nobody has to inherit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import msgspec

if TYPE_CHECKING:
    import torch

    from rewild4d.types import Camera, Clip, Prior, Splats, Truth

Log = Callable[[int, int, Mapping[str, float]], None]
"""log(step, total, values): progress of a long computation, called every few steps."""


@runtime_checkable
class Reconstruction(Protocol):
    """A function from time to Gaussians.

    It may have more: ``diagnostics()``, figures for the record; ``marks``, sentences that every table prints below its
    row, such as "upper bound: ...", and such a row is not ranked; ``canonical()`` and ``weights``, for pictures.

    ``refined(frames, log)``, itself after a fit to the held-out frames of a video that it is scored on: for competitors
    whose paper scores them so. The evaluation asks for it, never the fit, and what it gives must have ``marks``.
    """

    def at(self, time: float) -> Splats:
        """Return the Gaussians at a time in seconds, in the world frame."""
        ...

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world frame, or None where the method does not know it.

        Where the data set has no cameras (`Frame.camera` is None) the evaluation renders held-out frames of the input
        view with it. It must then answer between the clip's frames too, for the image that the clip would hold at that
        time: its crop lies on the straight line between those of the neighbouring frames (`recropping` does the rest).
        """
        ...

    def save(self, folder: Path) -> None:
        """Write everything `Method.load` needs into an existing, empty folder."""
        ...


@runtime_checkable
class Articulated(Reconstruction, Protocol):
    """A reconstruction that is a skinned shape at rest: what an animated file of it needs.

    Attributes:
        weights: skinning weights of the canonical Gaussians, rows sum to one, [n, J].
        pivots: inner end of each bone at rest, object frame, [J, 3].
        parents: parent of each bone, -1 for a root, [J].
    """

    @property
    def weights(self) -> torch.Tensor: ...
    @property
    def pivots(self) -> torch.Tensor: ...
    @property
    def parents(self) -> torch.Tensor: ...

    def canonical(self) -> Splats:
        """Return the Gaussians at rest, in the object frame."""
        ...

    def articulation(self, time: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Rest -> posed transform of each bone in the object frame, rigid, [J, 4, 4]; object_to_world, [4, 4]."""
        ...


@dataclass(frozen=True)
class MethodInfo:
    """What a table prints about a method: pure data.

    Attributes:
        title: of its rows.
        paper: where it is from.
        licence: of the code here.
        mark: what stands beside all of its numbers and keeps its rows out of the ranking: an advantage of its kind.
        is_floor: whether it is a floor, printed beside the others and never ranked.
        uses_prior: whether it starts from the prior.
        description: a sentence on what it does, for `list`.
    """

    title: str
    paper: str
    licence: str
    mark: str = ""
    is_floor: bool = False
    uses_prior: bool = True
    description: str = ""


class Method(Protocol):
    """One competitor.

    `Config` is a frozen msgspec.Struct; its presets are TOML tables in baselines/presets/<name>.toml. A method that
    reads files beside the clip has ``inputs(config, case)`` too, a digest of them, so that other files are another run;
    one that cannot run with every config has ``require(config, cases)``, which says so before anything is fitted; one
    that runs somebody else's program has ``describe(config)``, facts for the record (whose, licence, digests).
    """

    info: MethodInfo
    Config: type[msgspec.Struct]

    def fit(
        self,
        clip: Clip,
        prior: Prior,
        *,
        config: Any,
        seed: int,
        device: torch.device,
        log: Log,
        workdir: Path | None,
    ) -> Reconstruction:
        """Reconstruct from the clip and the prior, and nothing else.

        Args:
            clip: the frames that the method may see.
            prior: a start.
            config: an instance of `Config`.
            seed: two runs with one seed on one machine give the same result on the CPU.
            device: where to compute.
            log: progress.
            workdir: where checkpoints go; a second call with the same folder resumes to the same result. None: none.
        """
        ...

    def load(self, folder: Path, device: torch.device) -> Reconstruction:
        """Read back what `Reconstruction.save` wrote: the same pixels."""
        ...


Parts = Literal["auto", "all", "main"]
"""Which connected parts of a mask are the animal; auto: the main one where others stand apart from it, else all."""


class Selection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which frames a method gets and which are held out, and at what size: the data part of a protocol.

    Attributes:
        cameras: "fixed" (one camera), "sweep" (the camera index advances per frame), "random" (a seeded one a frame),
            "unknown" (a video, of whose camera nothing is known) or "known" (a video with a camera for each frame).
        size: longest image side in pixels.
        framing: "full" keeps the frame's aspect, "letterbox" pads it to a square, "crop" takes one square window that
            holds the animal in every selected image of a view; of a video, a smoothly moving square around the animal.
        placements: for "fixed": where the camera stands relative to the animal; each is a case of its own.
        step: for "sweep": camera indices advanced per frame.
        stride: keep every stride-th frame of the motion.
        seed: of "random".
        split: of a video: every split-th usable frame is held out; or two numbers, of which the first says how many
            frames are shown and the second how many after them are held out, again and again. (1, 0) shows every frame
            and scores it too.
        frames: of a video: the most that are used, from its start.
        mask_threshold: of a video: a mask is solid above this, in [0, 1], and empty elsewhere; None leaves it soft.
    """

    cameras: Literal["fixed", "sweep", "random", "unknown", "known"]
    size: int
    framing: Literal["full", "letterbox", "crop"] = "full"
    placements: tuple[Literal["side", "oblique", "frontal"], ...] = ()
    step: int = 1
    stride: int = 1
    seed: int = 0
    split: int | tuple[int, int] | None = None
    frames: int | None = None
    mask_threshold: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.split, tuple) and (self.split[0] < 1 or self.split[1] < 0):
            raise ValueError("'split' needs at least one shown frame and no negative number")
        if self.mask_threshold is not None and not 0 <= self.mask_threshold < 1:
            raise ValueError("'mask_threshold' is at least 0 and below 1")
        if self.frames is not None and self.frames < 1:
            raise ValueError("'frames' is at least 1")


@dataclass(frozen=True)
class Finding:
    """One line of `check`: an error keeps the data from being used, a warning does not."""

    level: Literal["error", "warning", "ok"]
    path: str
    message: str


@dataclass(frozen=True)
class Verdict:
    """Whether something can be trusted, in one sentence.

    Attributes:
        about: what is judged.
        level: green: nothing speaks against it; yellow: look at it; red: do not rely on it.
        reason: why.
        advice: what to do; "" where nothing is to be done.
    """

    about: Literal["masks", "prior", "result"]
    level: Literal["green", "yellow", "red"]
    reason: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.about}: {self.level}: {self.reason}" + (f"; {self.advice}" if self.advice else "")


class DatasetReader(Protocol):
    """Reads one dataset folder into clips and truths.

    It may have more: ``title``, what `list` says of it; ``originals(case, selection)``, the whole frames that the
    images of the clip and of the truth were cut from, in the order of time, uint8 [h, w, 3] each, one after the other,
    or None where the data set lacks them; for pictures of a finished run, never for a method;
    ``default_cases(selection)``, what is run where no case is named; ``settings``, options for the record.
    """

    licence: str

    def cases(self, selection: Selection) -> list[str]:
        """Return names of all cases, "<animal>/<motion>" (with "@<placement>" under a fixed camera), cheaply."""
        ...

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        """Decode one case."""
        ...

    def check(self) -> list[Finding]:
        """Verify layout and contents without stopping at the first fault."""
        ...


@dataclass(frozen=True)
class MetricInfo:
    """What a metric of another package measures: pure data.

    Attributes:
        title: of its column.
        definition: one sentence: what is compared, over which pixels or points, and how items are averaged.
        unit: "dB", "px", "1" for a ratio; tables print three digits after the point, so choose it to suit.
        better: which way is better; "" for a figure that rates nothing.
        needs: what `Metric.measure` is given: held-out images beside their renders, or shapes as points.
        paper: where it is from.
        licence: of its code.
    """

    title: str
    definition: str
    unit: str
    better: Literal["higher", "lower", ""]
    needs: Literal["images", "points"]
    paper: str = ""
    licence: str = ""


@dataclass(frozen=True)
class HeldOut:
    """One held-out image beside its render: of one size, on one background, float32 on the CPU.

    Attributes:
        time: seconds.
        view: index of the camera in the data set, or -1.
        prediction: in [0, 1], [3, h, w].
        truth: in [0, 1], [3, h, w].
        prediction_matte: in [0, 1], [1, h, w].
        truth_matte: in [0, 1], [1, h, w].
        background: grey level in [0, 1] behind both.
    """

    time: float
    view: int
    prediction: torch.Tensor
    truth: torch.Tensor
    prediction_matte: torch.Tensor
    truth_matte: torch.Tensor
    background: float


@dataclass(frozen=True)
class Clouds:
    """The shape at one moment as points in the world, not aligned (under a protocol with `free_scale`: after it).

    Attributes:
        time: seconds.
        prediction: centres of Gaussians, float64, [m, 3].
        truth: on the true surface, float64, [n, 3].
        diagonal: of the true animal's bounding box at rest, world units; None where unknown.
    """

    time: float
    prediction: torch.Tensor
    truth: torch.Tensor
    diagonal: float | None


@dataclass(frozen=True)
class Tally:
    """A sum and how many things it is over, so that means over pixels or points pool as they should."""

    total: float
    count: int = 1


class NotComputed(Exception):
    """Raised by `Metric.measure`: the case has no value; the sentence says why and goes into the record."""


class Metric(Protocol):
    """A metric of another package: entry point `rewild4d.metrics`, whose name is the score's.

    Every run is scored by it beside our metrics. Whatever it raises becomes the reason why there is no value; it never
    costs a fit.
    """

    info: MetricInfo

    def measure(self, items: Iterable[Any]) -> Iterable[Tally | float | None]:
        """Measure one case.

        Args:
            items: `HeldOut` in the order of the record's items, or `Clouds` in the order of time; each is made when it
                is asked for, and may be asked for again by a second loop.

        Returns:
            One entry an item, None where it is not defined there; or a single one for the whole case. A number is a
            tally of one. The score is the sum of all totals over the sum of all counts.

        Raises:
            NotComputed: the case has no value.
        """
        ...
