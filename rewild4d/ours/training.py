"""Train Gaussians step by step: what the fits of `ours` and of its Gaussian competitors have in common."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.optim import Adam

from rewild4d.contracts import Log
from rewild4d.ours.canonical import NAMES, Gaussians
from rewild4d.ours.checkpoint import save_checkpoint
from rewild4d.ours.density import DensityControl
from rewild4d.ours.evidence import Sighting
from rewild4d.ours.gradients import all_finite, require_finite
from rewild4d.ours.holding import HeldSkin
from rewild4d.ours.losses.config import Skin
from rewild4d.ours.schedule import exponential
from rewild4d.ours.symmetry import Supervision, Target
from rewild4d.rasterizer import RasterInfo

LOG_EVERY = 20
EPSILON = 1e-15
"""Of Adam, for Gaussians: their gradients are tiny."""


class GaussianTraining(ABC):
    """One fit; a method defines its losses and the learning rates of its other parameters.

    Attributes:
        model: all that learns; its attribute ``gaussians`` are the canonical Gaussians.
        groups: parameters beside the Gaussians', by name.
        config: of the method; read are `iterations`, `rates`, `density` and, where there is one, `skin`.
        supervision: the clip's images and cameras.
        generator: the only source of randomness.
        optimizer: one group per attribute, in the order of `canonical.NAMES`.
        others: one group for each of `groups`.
        held: what holds them to the skin that the fit starts from; None where nothing does.
        near: neighbours of each Gaussian, for methods that compare them; None where they are to be searched, [n, k].
    """

    SAVED: ClassVar[tuple[str, str]] = ("optimizer", "others")
    """Names of the two optimizers in checkpoints."""

    def __init__(
        self,
        model: nn.Module,
        groups: Mapping[str, list[nn.Parameter]],
        config: Any,
        supervision: Supervision,
        generator: torch.Generator,
    ) -> None:
        self.model, self.groups, self.config = model, dict(groups), config
        self.supervision, self.generator = supervision, generator
        own = self.gaussians
        # The rate of the means is set at every step.
        rates = {name: 0.0 if name == "means" else getattr(config.rates, name) for name in NAMES}
        fixed = [{"params": [getattr(own, name)], "lr": rates[name], "eps": EPSILON} for name in NAMES]
        fixed[NAMES.index("colors")]["eps"] = config.rates.colors_epsilon
        on_gpu = own.means.is_cuda  # where graphs may hold the updates
        self.optimizer = Adam(fixed, fused=True, capturable=on_gpu)
        self.others = Adam([{"params": group} for group in groups.values()], eps=1e-8, fused=True, capturable=on_gpu)
        self.density = DensityControl(config.density, len(own), own.means.device)
        self.near: Tensor | None = None
        skin: Skin = getattr(config, "skin", Skin())
        self.held = HeldSkin(skin, own, self.sightings, supervision) if skin.holds else None

    @property
    def gaussians(self) -> Gaussians:
        """The canonical Gaussians."""
        gaussians = self.model.gaussians
        assert isinstance(gaussians, Gaussians)
        return gaussians

    @abstractmethod
    def drawn_losses(self, index: int) -> tuple[dict[str, Tensor], RasterInfo | None, Target]:
        """Draw a view; return its weighted losses, its render info (None where nothing was rendered) and the view."""

    @abstractmethod
    def rate(self, name: str, progress: float) -> float:
        """Return the learning rate of one of `groups`."""

    @abstractmethod
    def sightings(self) -> Iterable[Sighting]:
        """Show the Gaussians in all training views, as they are placed at the start."""

    def prepare(self) -> None:
        """Search what losses need of each Gaussian, where the set of Gaussians changed; comes before the losses."""
        if self.held is not None:
            self.held.prepare(self.gaussians)

    def skin_losses(self, opacities: Tensor) -> dict[str, Tensor]:
        """Compute the weighted losses that hold Gaussians with opacities [n] to the skin."""
        return {} if self.held is None else self.held.losses(self.gaussians, opacities)

    def step(self, index: int) -> dict[str, float]:
        """Take one step; return the figures for the log."""
        for group, rate in zip(self.rated(), self.step_rates(index), strict=True):
            group["lr"] = rate
        losses, info, target = self.drawn_losses(index)
        values = torch.stack(list(losses.values()))
        figures = self.checked(index, dict(zip(losses, values.tolist(), strict=True)))
        self.backward(values)
        self.check_gradients(index)
        self.update(info if self.observes(index) else None, target)
        self.change_density(index)
        return self.logged(figures)

    def rated(self) -> list[dict[str, Any]]:
        """Return the optimizers' groups whose learning rates follow a schedule, in the order of `step_rates`."""
        means = self.optimizer.param_groups[NAMES.index("means")]
        return [means, *self.others.param_groups, *(self.held.groups() if self.held else ())]

    def step_rates(self, index: int) -> list[float]:
        """Return the learning rates of a step: of the means, then of `groups`, then of the skin."""
        progress = index / self.config.iterations
        first, last = self.config.rates.means
        others = [self.rate(name, progress) for name in self.groups]
        return [exponential(first, last, progress), *others, *(self.held.rates(progress) if self.held else ())]

    def checked(self, index: int, losses: dict[str, float]) -> dict[str, float]:
        """Return the losses; raise a FloatingPointError where one is not finite."""
        for name, value in losses.items():
            if not math.isfinite(value):
                raise FloatingPointError(f"iteration {index}: loss '{name}' is not finite")
        return losses

    def backward(self, losses: Tensor) -> None:
        """Compute the gradients of the sum of losses [k]."""
        self.optimizer.zero_grad(set_to_none=True)
        self.others.zero_grad(set_to_none=True)
        losses.sum().backward()

    def observes(self, index: int) -> bool:
        """Tell whether the density control looks at a step's gradients."""
        return index / self.config.iterations < self.config.density.end

    def update(self, info: RasterInfo | None, target: Target) -> None:
        """Show a render's ``info``, if any, to the density control, and follow the gradients."""
        if info is not None:
            self.density.observe(info, target.side, max(target.camera.width, target.camera.height))
        before = self.gaussians.means.detach().clone() if self.held else None
        self.optimizer.step()
        self.others.step()
        if self.held and before is not None:
            self.held.move(self.gaussians, before)

    def change_density(self, index: int) -> bool:
        """Densify and prune if that is due after a step; tell whether it was."""
        total = self.config.iterations
        due = self.density.round_if_due(index, total, self.gaussians, self.optimizer, self.generator)
        self.near = None if due else self.near
        if due and self.held:
            self.held.forget()
        return due

    def logged(self, losses: Mapping[str, float]) -> dict[str, float]:
        """Return the figures for the log from a step's losses."""
        return {"loss": sum(losses.values()), "gaussians": len(self.gaussians)} | dict(losses)

    def check_gradients(self, index: int) -> None:
        """Raise a FloatingPointError where a gradient is not finite."""
        if not all_finite(list(self.model.parameters())):
            require_finite(self.model, index)

    def state(self) -> dict[str, Any]:
        """Return what a resumed fit needs beside the generator."""
        optimizers = zip(self.SAVED, map(_saved, (self.optimizer, self.others)), strict=True)
        others = {"density": self.density.state(), "near": self.near, "held": self.held and self.held.state()}
        return {"model": self.model.state_dict(), **dict(optimizers), **others}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from `state`; the number of Gaussians may differ from the present one."""
        own = self.gaussians
        for group, name in zip(self.optimizer.param_groups, NAMES, strict=True):
            parameter = nn.Parameter(state["model"][f"gaussians.{name}"].to(own.means.device).clone())
            setattr(own, name, parameter)
            group["params"] = [parameter]
        self.model.load_state_dict(state["model"])
        for name, optimizer in zip(self.SAVED, (self.optimizer, self.others), strict=True):
            optimizer.load_state_dict(state[name])
            for group in optimizer.param_groups:
                group["capturable"] = own.means.is_cuda
        self.density.restore(state["density"])
        # A new search would find neighbours of the present positions, not of those at the last change.
        self.near = state.get("near")
        if self.held is not None:
            self.held.restore(state["held"])


def _saved(optimizer: Adam) -> dict[str, Any]:
    """Return an optimizer's state with learning rates as numbers."""
    state = optimizer.state_dict()
    for group in state["param_groups"]:
        group["lr"] = float(group["lr"])
    return state


def run_steps(
    step: Callable[[int], Mapping[str, float]], steps: range, every: int, identity: str,
    state: Callable[[], dict[str, Any]], log: Log, workdir: Path | None,
) -> None:  # fmt: skip
    """Take steps and log them.

    Args:
        step: takes one step, returns the figures for the log.
        steps: indices that are left to take.
        every: steps between checkpoints.
        identity: of the fit, from `fit_digest`.
        state: returns what a checkpoint holds beside the number of steps.
        log: called every `LOG_EVERY` steps and at the end.
        workdir: folder for checkpoints; None for none.
    """
    for index in steps:
        figures, done = step(index), index + 1
        if index % LOG_EVERY == 0 or done == steps.stop:
            log(done, steps.stop, figures)
        if workdir is not None and done % every == 0 and done < steps.stop:
            save_checkpoint(workdir, identity, {"step": done} | state())
