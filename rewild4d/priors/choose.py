"""Choose the prior of a run: fitted to its clip, made from the truth, or read from a file."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import torch

from rewild4d.contracts import Log
from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.kernels.switch import chosen_kernels
from rewild4d.machine import code_version
from rewild4d.priors.bodies.body import Body
from rewild4d.priors.bodies.choice import bodies, identity, is_rig_file
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR
from rewild4d.priors.coarse import coarse_prior
from rewild4d.priors.config import FOOTAGE, PriorConfig, Use, with_points, without_colors
from rewild4d.priors.fit import fit_template
from rewild4d.priors.footage import Evidence, fit_footage
from rewild4d.priors.heading.weights import package_digest, package_weights
from rewild4d.priors.io import load_prior, save_prior, seal
from rewild4d.priors.judge import doubts, joint_scores, measured
from rewild4d.priors.landmarks import Marks, load_mapping, marks
from rewild4d.priors.learned.weights import load_weights
from rewild4d.priors.placing import has_cameras, in_world, placed
from rewild4d.priors.rig import rig_prior
from rewild4d.priors.shapes.weights import package_density, package_density_digest
from rewild4d.priors.steady import without_hops
from rewild4d.priors.trained import UNTRAINED, Trained
from rewild4d.types import Clip, Prior, Truth

PRIOR_SEED = 0
"""Of the fit: every method and every seed of a case starts from the same prior."""

ELSEWHERE = "made elsewhere: it may have seen the frames that are held out here"
OTHER_BONES = (
    "keypoints are not scored: their mapping names bones of the template, and this prior's skeleton is another"
)


@dataclass(frozen=True)
class PriorChoice:
    """The prior that a run asks for.

    Attributes:
        name: "template" (fitted to the clip's masks, to its colours where known cameras see several sides, else to
            headings and, under known cameras, shapes; of the package's templates the one that fits best),
            "template:<which>" (a template's name or a rig file), "masks" and "masks:<which>" (the same from masks
            alone), "learned:<weights>" (the quadruped, fitted to masks and to points of the body that a network finds),
            "coarse" or "coarse:<noise>" (from the truth, plus noise; for studies of prior quality only), "rig" (the
            data set's own shape and skeleton: a bound) or the path of an npz file.
        config: settings of the template fit under known cameras.
        mapping: names the template's point of each keypoint (`landmarks.load_mapping`); None ignores keypoints.
        use: frames whose keypoints a fit under unknown cameras sees.
    """

    name: str
    config: PriorConfig
    mapping: str | None = None
    use: Use = "none"

    @property
    def noise(self) -> float | None:
        """Noise level of a coarse prior, 1 by default; None for other priors."""
        kind, _, level = self.name.partition(":")
        if kind != "coarse":
            return None
        try:
            noise = float(level or 1.0)
        except ValueError as error:
            raise UserError(f"--prior {self.name}: expected coarse:<number>, got '{level}'.") from error
        if not 0 <= noise < math.inf:
            raise UserError(f"--prior {self.name}: expected a finite noise of 0 or more, got '{level}'.")
        return noise

    def require(self) -> None:
        """Check the name.

        Raises:
            UserError: a noise that is no number, an unknown template, or a file that is missing or damaged.
        """
        if self.is_learned:
            self.trained()
        elif self.is_fitted:
            self.bodies()
        elif not self.is_from_truth:
            load_prior(Path(self.name))

    @property
    def is_learned(self) -> bool:
        """Whether a network's points take part in the fit."""
        return self._kind == "learned"

    @property
    def is_fitted(self) -> bool:
        """Whether the template is fitted to the clip, which alone decides the prior."""
        return self._kind in ("template", "masks", "learned")

    @property
    def is_made(self) -> bool:
        """Whether the prior is made for the run, so that `make_prior` keeps it in a file; else it comes from one."""
        return self.is_fitted or self.is_from_truth

    @property
    def is_own_rig(self) -> bool:
        """Whether the template is a rig file."""
        return self.is_fitted and not self.is_learned and is_rig_file(self.name)

    @property
    def _kind(self) -> str:
        return self.name.partition(":")[0]

    def bodies(self) -> tuple[Body, ...]:
        """Return the templates among which the fit chooses.

        Raises:
            UserError: an unknown name, or a rig file that cannot be used.
        """
        if self.is_learned:
            return (QUADRUPED,)
        return bodies(self.name.partition(":")[2] if self.is_fitted else "")

    @property
    def _weights_file(self) -> Path:
        path = self.name.partition(":")[2]
        if not path:
            raise UserError(
                "--prior learned: expected learned:<weights>, since no weights come with the package yet; "
                "`prior train` makes some."
            )
        return Path(path)

    @property
    def weights_digest(self) -> str:
        """Sixteen hex digits of the SHA-256 of a learned prior's weights; "" for other priors."""
        return digest(self._weights_file.read_bytes())[:16] if self.is_learned else ""

    def trained(self) -> Trained:
        """Return what takes part in the fit: of a learned prior its points, of a template headings and shapes.

        Raises:
            UserError: weights are missing or damaged.
        """
        if self._kind == "template":
            return Trained(headings=package_weights(), shapes=package_density())
        return Trained(points=load_weights(self._weights_file)) if self.is_learned else UNTRAINED

    @property
    def is_from_truth(self) -> bool:
        """Whether the prior is made from held-out data, so that results with it are bounds."""
        return self.name == "rig" or self.noise is not None

    def identity(self, clip: Clip, truth: Truth) -> str:
        """Return a digest of all that decides the prior, before it is made, sixteen hex digits.

        Raises:
            UserError: "rig", and the data set has none.
        """
        if self.name == "rig" and truth.rig is None:
            raise UserError(f"--prior rig: expected a data set with bones and a volume, but {clip.name} has none.")
        parts: list[str | bytes] = [clip.digest, str(code_version())]
        if self.is_fitted:
            parts += ["template", msgspec.json.encode(self.settings(clip)), repr(self._pairs), self.use]
            parts += [package_digest(), package_density_digest()] if self._kind == "template" else []
            parts += [f"{name} {mode}" for name, mode in chosen_kernels().items()]
            if self.is_learned:
                parts += ["learned", self._weights_file.read_bytes()]
            else:
                parts.append(identity(self.name.partition(":")[2]))
        elif self.is_from_truth:
            named = "rig" if self.noise is None else f"coarse {self.noise}"
            parts += [named, truth.digest, msgspec.json.encode(self.settings(clip))]
        else:
            parts += ["file", load_prior(Path(self.name)).digest, repr(self._pairs)]
        return digest(*parts)[:16]

    def settings(self, clip: Clip) -> PriorConfig:
        """Return settings of the fit to this clip: footage without cameras has its own."""
        return self.settings_under(has_cameras(clip))

    def settings_under(self, known_cameras: bool) -> PriorConfig:
        """Return settings of the fit where cameras are known or not; only "template" looks at colours."""
        config = FOOTAGE if self.is_fitted and not known_cameras else self.config
        if self._kind == "template":
            return config
        return with_points(without_colors(config)) if self.is_learned else without_colors(config)

    def keypoints(self, clip: Clip) -> tuple[Marks | None, Marks | None]:
        """Return the clip's keypoints for the fit and those to score it by; None where there are none."""
        return split_marks(marks([frame.keypoints for frame in clip.frames], self._pairs), self.use)

    @property
    def _pairs(self) -> dict[str, str]:
        return load_mapping(self.mapping) if self.mapping else {}


def split_marks(found: Marks, use: Use) -> tuple[Marks | None, Marks | None]:
    """Split marks into those for the fit and those to score it by; None for no marks."""
    frames, every = found.frames.unique(), {"all": 1, "half": 2, "none": 0}[use]
    seen = torch.isin(found.frames, frames[::every] if every else frames[:0])
    given, scored = found.chosen(seen), found.chosen(~seen)
    return given if len(given) else None, scored if len(scored) else None


def make_prior(choice: PriorChoice, clip: Clip, truth: Truth, path: Path, log: Log) -> Prior:
    """Make the chosen prior; a fitted one is kept at ``path`` and read from there the next time.

    For a clip without cameras it has only frames whose camera agrees with the others' (`steady`), and its `notes` name
    those left out and the reasons to doubt it.

    Raises:
        UserError: a file that cannot be used or is for another clip, or masks that show nothing.
    """
    footage = not has_cameras(clip)
    if not choice.is_made:
        prior = load_prior(Path(choice.name))
        prior = placed(prior, clip) if footage else in_world(prior, clip, choice.name)
        figures = measured(prior, clip.frames)
        if not footage:  # known cameras may jump
            figures = {name: value for name, value in figures.items() if not name.startswith("hops")}
        prior = seal(replace(prior, quality=prior.quality | figures, notes=(*prior.notes, ELSEWHERE)))
        prior = _scored(prior, clip, choice.keypoints(clip)[1])
    else:
        if not path.is_file():
            save_prior(_fitted(choice, clip, truth, log), path)
        prior = load_prior(path)
    if not footage:
        return prior
    filtered = without_hops(prior)
    return replace(filtered.prior, notes=(*prior.notes, *filtered.notes, *doubts(prior.quality)))


def _fitted(choice: PriorChoice, clip: Clip, truth: Truth, log: Log) -> Prior:
    config = choice.settings(clip)
    if choice.noise is not None:
        return coarse_prior(clip, truth.held_out, noise=choice.noise, seed=PRIOR_SEED, config=config, log=log)
    if choice.name == "rig" or has_cameras(clip):
        fitted = fit_template(
            clip, config=config, seed=PRIOR_SEED, log=log, trained=choice.trained(), bodies=choice.bodies(),
        )  # fmt: skip
        return rig_prior(clip, truth.rig(), fitted) if choice.name == "rig" and truth.rig else fitted
    given, scored = choice.keypoints(clip)
    if choice.is_own_rig:  # keypoints are mapped to bones of the package's templates
        given = None
    prior = fit_footage(
        clip, config=config, seed=PRIOR_SEED, log=log, said=Evidence(given, clip.travel),
        trained=choice.trained(), bodies=choice.bodies(),
    )  # fmt: skip
    return _scored(prior, clip, scored)


def _scored(prior: Prior, clip: Clip, found: Marks | None) -> Prior:
    """Add `joint_scores` on keypoints that the fit did not see, or a note where the skeleton is not the template's."""
    if found is None:
        return prior
    if prior.mirror.tolist() != list(MIRROR):
        return replace(prior, notes=(*prior.notes, OTHER_BONES))
    return seal(replace(prior, quality=prior.quality | joint_scores(prior, clip.frames, found)))
