"""Gaussians of a fit held to the skin that it starts from, and that skin moved as a whole."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.evidence import Sighting, information
from rewild4d.ours.heights import Heights
from rewild4d.ours.losses.config import Skin
from rewild4d.ours.losses.skin import Bond, StartingSkin, bind_loss, disc_loss
from rewild4d.ours.schedule import exponential
from rewild4d.ours.symmetry import Supervision

FALL = 0.01
"""Share of the heights' rate that is left at the end."""


class HeldSkin:
    """What settings `Skin` ask for, in one fit.

    Attributes:
        skin: of the start; moved by `heights`.
        holds: firmness of each of its points, and of the distance from it (`StartingSkin.holds`); None until `prepare`.
        bond: what holds each Gaussian; None where it is to be found.
        heights: that move the skin, or None.
    """

    def __init__(
        self, config: Skin, gaussians: Gaussians, sightings: Callable[[], Iterable[Sighting]], supervision: Supervision
    ) -> None:
        """Take Gaussians that were placed on a surface and have not moved yet.

        Args:
            config: what is asked for.
            gaussians: of the fit.
            sightings: shows them in all training views.
            supervision: with the views' cameras.
        """
        self.config, self.sightings, self.supervision = config, sightings, supervision
        self.skin = StartingSkin.of(gaussians)
        self.holds: tuple[Tensor, Tensor] | None = None
        self.bond: Bond | None = None
        self.heights = Heights(self.skin) if config.heights else None

    def rates(self, progress: float) -> list[float]:
        """Return the learning rates of `groups` at a share of the fit."""
        first = self.config.heights
        return [exponential(first, FALL * first, progress) for _ in self.groups()]

    def groups(self) -> list[dict[str, Any]]:
        """Return what has a learning rate, as groups of an optimizer."""
        return [self.heights.group] if self.heights else []

    def prepare(self, gaussians: Gaussians) -> None:
        """Find each Gaussian's point of the skin, where it is used and the set of Gaussians changed."""
        if self.holds is None:
            # In the first step the skin's points are the Gaussians.
            if self.config.evidence and self.skin.information is None:
                known = information(gaussians, self.sightings(), self.supervision)
                self.skin = replace(self.skin, information=known)
            self.holds = self.skin.holds(self.config.evidence)
        if self.bond is None:
            self.bond = Bond.at(self.skin.nearest(gaussians.means), self.holds)

    def losses(self, gaussians: Gaussians, opacities: Tensor) -> dict[str, Tensor]:
        """Compute the weighted losses of Gaussians with opacities [n]."""
        config, losses = self.config, dict[str, Tensor]()
        if not config.disc and not config.bind:
            return losses
        bond = self._bond()
        if config.disc:
            lacking = disc_loss(gaussians.scales_log(), opacities, bond.firmness, self.skin.log_radius, config)
            losses["disc"] = config.disc * lacking
        if config.bind:
            losses["bind"] = config.bind * bind_loss(gaussians.means, gaussians.quats, self.skin, bond, config)
        return losses

    @torch.no_grad()
    def move(self, gaussians: Gaussians, before: Tensor) -> None:
        """Undo what centres moved by themselves from ``before`` [n, 3] as far as nothing tells their place, and move
        them with the skin."""
        if self.config.follow:
            gaussians.means.data.lerp_(before, self._bond().firmness[:, None])
        if self.heights is not None:
            assert self.holds is not None, "`prepare` comes first"
            share = self.holds[0] if self.config.follow else torch.ones_like(self.holds[0])
            self.heights.step(gaussians, self.skin, self._bond().nearest, share)

    def forget(self) -> None:
        """Find the points of the skin again: the set of Gaussians changed."""
        self.bond = None

    def state(self) -> dict[str, Any]:
        """Return what `restore` takes."""
        bond = self.bond and (self.bond.nearest, self.bond.firmness, self.bond.depth)
        skin = {"points": self.skin.points, "information": self.skin.information}
        return {"bond": bond, "skin": skin, "heights": self.heights and self.heights.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from `state`."""
        self.skin = replace(self.skin, **state["skin"])
        self.bond = state["bond"] and Bond(*state["bond"])
        if self.heights is not None:
            self.heights.restore(state["heights"])

    def _bond(self) -> Bond:
        assert self.bond is not None, "`prepare` comes first"
        return self.bond
