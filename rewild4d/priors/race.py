"""Fit competing hypotheses: rounds of gradient descent on silhouettes; after each the worst are dropped."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from rewild4d.contracts import Log
from rewild4d.priors.config import PriorConfig, Stage
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.search import match_areas
from rewild4d.priors.shapes.density import ShapeDensity
from rewild4d.priors.silhouettes import Targets, color_mismatch, crop_targets, mean_color, mismatch
from rewild4d.types import Frame

HANDICAP, ONE_SIDE_HANDICAP = 1.4, 1.65
"""The costs of all kinds of body but the usual one are multiplied by this where they are compared: by the second where
one side is seen (a dog that sits has the outline of a biped)."""
LOST = 2.0
"""Once joints have been fitted, a guess whose misfit is more than this times the best's is dropped."""
COLOR_RATE = 0.05
"""Learning rate of the surface's colours."""
STILL_PARAMETERS = ("scale", "rotation", "shift", "shape")


@dataclass
class Steps:
    """Steps of descent, told to a log.

    Attributes:
        log: called after each step.
        total: number of all steps to come.
        done: steps so far.
    """

    log: Log
    total: int
    done: int = 0

    def told(self, cost: float) -> None:
        self.done += 1
        self.log(self.done, self.total, {"prior": cost})


class Race:
    """Guesses of one kind of body that are fitted side by side.

    Attributes:
        guesses: those that remain.
        costs: of each after the last round, [B].
        misfits: the same without `verdict`, which may be negative, [B].
        start_costs: of every start after the first round.
        figures: named figures of the race (facing_margin, ...).
        shapes: where shapes of this kind of body lie; None takes every proportion on its own.
        handicap: factor of the costs of all kinds of body but the usual one.
    """

    shapes: ShapeDensity | None = None
    handicap: float = HANDICAP

    def __init__(
        self, frames: Sequence[Frame], timesteps: Sequence[int], name: str, working: Tensor, config: PriorConfig,
        generator: torch.Generator, steps: Steps,
    ) -> None:  # fmt: skip
        self.frames, self.timesteps, self.name = frames, timesteps, name
        self.working, self.config, self.generator, self.steps = working, config, generator, steps
        self.costs = self.misfits = self.start_costs = torch.zeros(0)
        self.figures: dict[str, float] = {}
        self.guesses: Hypotheses

    def begin(self, guesses: Hypotheses) -> None:
        """Take the starts, of mean shape and scaled to the masks' area."""
        self.guesses = guesses
        if self.shapes is not None:
            shape, relief = self.shapes.start(guesses.body.measures)
            guesses.shape, guesses.relief = shape.repeat(len(guesses), 1), relief.repeat(len(guesses), 1, 1)
        match_areas(self.guesses, self._targets(self.config.stages[0].size), self.config.stages[0])

    def free(self, stage: Stage) -> list[str]:
        """Return names of the parameters that a round fits."""
        return [
            *STILL_PARAMETERS, *("angles",) * stage.joints, *("relief",) * stage.relief, *("colors",) * stage.colors,
        ]  # fmt: skip

    def evidence(self) -> Tensor | float:
        """Return the cost of each guess at every step besides its silhouette and penalties, [B]."""
        return 0.0

    def verdict(self, stage: Stage) -> Tensor | float:
        """Return the cost that is added only when guesses are compared, [B]."""
        return self.config.gait_weight * self.guesses.backward_gait() if stage.joints else 0.0

    def rivals(self, order: list[int]) -> list[int]:
        """Return guesses to keep although others are better, most important first; ``order`` is by cost."""
        return self._reversed(order)[:1]

    def _reversed(self, order: list[int]) -> list[int]:
        """Return the guesses that head against the best, by cost."""
        heads = self.guesses.heading().detach()
        return [row for row in order if heads[row] @ heads[order[0]] < 0]

    def run(self, stage: Stage) -> None:
        """Fit for one round, then drop the worst guesses."""
        targets = self._targets(stage.size)
        if stage.colors:
            self.guesses = self.guesses.painted(mean_color(targets))
        names = self.free(stage)
        leaves = [getattr(self.guesses, name).detach().requires_grad_() for name in names]
        for name, leaf in zip(names, leaves, strict=True):
            setattr(self.guesses, name, leaf)
        rates = [COLOR_RATE if name == "colors" else self.config.learning_rate * stage.pace for name in names]
        groups = [{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves, rates, strict=True)]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.98))
        for step in range(stage.steps):
            share = step / max(stage.steps - 1, 1)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * (1 - 0.85 * share)
            sigma = stage.size * (stage.blur[0] + share * (stage.blur[1] - stage.blur[0]))
            cost = self._cost(self._draw(targets, stage.frames), sigma, stage)
            if not torch.isfinite(cost).all():
                raise FloatingPointError(f"{self.name}: the template fit's cost is not finite at step {step}: {cost}")
            optimizer.zero_grad()
            torch.autograd.backward(cost.sum(), inputs=leaves)
            optimizer.step()
            self.steps.told(float(cost.detach().min()))
        with torch.no_grad():
            self.misfits = self._cost(_spaced(targets, 2 * stage.frames), stage.size * stage.blur[1], stage)
            self.costs = self.misfits + self.verdict(stage)
        if not len(self.start_costs):
            self.start_costs = self.costs
        self._cut(stage.keep, LOST if stage.joints else math.inf)

    def _targets(self, size: int) -> Targets:
        return crop_targets(self.frames, self.timesteps, self.working, size, self.name)

    def _draw(self, targets: Targets, count: int) -> Targets:
        """Return all observations, or ``count`` of them at random."""
        if len(targets.masks) <= count:
            return targets
        rows = torch.randperm(len(targets.masks), generator=self.generator)[:count]
        return targets.select(rows.sort().values)

    def _cost(self, targets: Targets, sigma: float, stage: Stage) -> Tensor:
        shape, relief, swing, root = self.guesses.penalties()
        config = self.config
        if self.shapes is None:
            penalty = config.shape_weight * shape + config.relief_weight * relief
        else:
            penalty = config.density_weight * self.shapes.penalty(self.guesses.shape, self.guesses.relief)
            penalty = penalty + config.straight_weight * self.guesses.sideways()
        penalty = penalty + config.angle_weight * swing + config.root_weight * root + self.evidence()
        if not stage.colors:
            return mismatch(self.guesses.silhouettes(targets, stage), targets, sigma) + penalty
        images, mattes = self.guesses.pictures(targets)
        penalty = penalty + config.color_weight * color_mismatch(images, targets, sigma)
        return mismatch(mattes, targets, stage.size * stage.blur[1]) + penalty

    def _cut(self, keep: int, lost: float) -> None:
        """Keep the best guess, its rivals and the next best, ``keep`` in all, but for those whose misfit is more than
        ``lost`` times the best's: nothing takes their place."""
        order = self.costs.argsort().tolist()
        if away := self._reversed(order):
            self.figures["facing_margin"] = float(self.costs[away[0]] - self.costs[order[0]])
        wanted = [order[0], *(row for row in self.rivals(order) if row != order[0])][:keep]
        rest = [row for row in order if row not in wanted][: keep - len(wanted)]
        kept = [row for row in wanted + rest if self.misfits[row] <= lost * self.misfits[order[0]]]
        rows = torch.tensor(sorted(kept, key=order.index))
        self.guesses, self.costs, self.misfits = self.guesses.select(rows), self.costs[rows], self.misfits[rows]


R = TypeVar("R", bound=Race)


def decided(races: Sequence[R], stages: Sequence[Stage]) -> R:
    """Run races of one kind of body each until joints have been fitted; let the best run the stages that are left.

    The first is the usual one: the misfit of another has to be lower by a factor of its `handicap`, for it bends more
    freely. Of several, `figures` has <body>_cost of each and body_margin, the lead of the best over the next as a
    share, handicap included.
    """
    first = 1 + [stage.joints for stage in stages].index(True) if len(races) > 1 else 0
    for race in races:
        for stage in stages[:first]:
            race.run(stage)
    best = races[0]
    if len(races) > 1:
        found = [float(race.misfits[race.costs.argmin()]) for race in races]
        costs = [cost * (races[0].handicap if index else 1.0) for index, cost in enumerate(found)]
        best = races[costs.index(min(costs))]
        best.figures |= {f"{race.guesses.body.name}_cost": cost for race, cost in zip(races, found, strict=True)}
        best.figures["body_margin"] = sorted(costs)[1] / min(costs) - 1
    for stage in stages[first:]:
        best.run(stage)
    return best


def steps_of(stages: Sequence[Stage], races: int) -> int:
    """Return the number of steps that `decided` takes."""
    first = 1 + [stage.joints for stage in stages].index(True)
    return races * sum(stage.steps for stage in stages[:first]) + sum(stage.steps for stage in stages[first:])


def _spaced(targets: Targets, count: int) -> Targets:
    """Return at most ``count`` evenly spaced observations."""
    count = min(len(targets.masks), count)
    return targets.select(torch.linspace(0, len(targets.masks) - 1, count).round().long())
