"""Which prior a run starts from: fitted to its clip, made from the truth with noise, or read from a file."""

from dataclasses import dataclass
from pathlib import Path

import msgspec

from rewild4d.contracts import Log
from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.machine import code_version
from rewild4d.priors.coarse import coarse_prior
from rewild4d.priors.config import FOOTAGE, PriorConfig
from rewild4d.priors.fit import fit_template
from rewild4d.priors.footage import fit_footage
from rewild4d.priors.io import load_prior, save_prior
from rewild4d.types import Clip, Prior, Truth

PRIOR_SEED = 0
"""One seed for all: every method and every seed of a case starts from the same prior."""


@dataclass(frozen=True)
class PriorChoice:
    """What `--prior` said.

    Attributes:
        name: "template" (fitted to the clip alone, with its cameras where it has any), "coarse" or "coarse:<noise>"
            (from the truth, plus noise; for studies of prior quality only) or the path of an npz file.
        config: settings of the template fit.
    """

    name: str
    config: PriorConfig

    @property
    def noise(self) -> float | None:
        """Noise level of a coarse prior, 1 where none is named; None for the others."""
        kind, _, level = self.name.partition(":")
        if kind != "coarse":
            return None
        try:
            return float(level or 1.0)
        except ValueError as error:
            raise UserError(f"--prior {self.name}: expected coarse:<number>, got '{level}'.") from error

    def identity(self, clip: Clip, truth: Truth) -> str:
        """Digest of all that decides the prior, before it is made: sixteen hex digits."""
        parts: list[str | bytes] = [clip.digest, str(code_version())]
        if self.name == "template":
            parts += ["template", msgspec.json.encode(self.config)]
        elif self.noise is not None:
            parts += [f"coarse {self.noise}", truth.digest, msgspec.json.encode(self.config)]
        else:
            parts += ["file", load_prior(Path(self.name)).digest]
        return digest(*parts)[:16]


def make_prior(choice: PriorChoice, clip: Clip, truth: Truth, path: Path, log: Log) -> Prior:
    """The chosen prior; a fitted one is kept at ``path`` and read from there the next time."""
    if choice.name != "template" and choice.noise is None:
        return load_prior(Path(choice.name))
    if not path.is_file():
        if choice.noise is None and any(frame.camera is None for frame in clip.frames):
            prior = fit_footage(clip, config=FOOTAGE, seed=PRIOR_SEED, log=log)
        elif choice.noise is None:
            prior = fit_template(clip, config=choice.config, seed=PRIOR_SEED, log=log)
        else:
            prior = coarse_prior(
                clip, truth.held_out, noise=choice.noise, seed=PRIOR_SEED, config=choice.config, log=log
            )
        save_prior(prior, path)
    return load_prior(path)
