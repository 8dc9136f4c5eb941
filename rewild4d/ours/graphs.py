"""Training steps on a CUDA GPU as recorded graphs, so that a thousand kernels start with two calls.

The small inputs of a step are copied to the GPU as one vector (`slots.Slots`). A first graph computes losses and
gradients, the host looks once at the losses and at whether all went well, and a second graph follows the gradients.
There are two graphs for each kind of step (`slots.Kind`). The first step of a kind runs without them: it compiles
kernels and measures the room that the rasterizer needs. The second step is recorded. When the set of Gaussians changes,
all is recorded anew.
"""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from rewild4d.kernels.switch import kernel_mode
from rewild4d.ours.gradients import require_finite
from rewild4d.ours.slots import Kind, Slots
from rewild4d.ours.symmetry import Target
from rewild4d.rasterizer import RasterInfo, rooms
from rewild4d.rasterizer.backends import resolve

if TYPE_CHECKING:
    from rewild4d.ours.fit import Training

logger = logging.getLogger(__name__)

SPARE, LEAST = 1.4, 1 << 14
"""Room of a recorded render over the pairs that were measured, and the least room."""


def can_record(device: torch.device) -> bool:
    """Tell whether steps on a device are recorded: a CUDA GPU with Triton, and kernels not switched off."""
    return device.type == "cuda" and kernel_mode() == "auto" and resolve("auto", device, torch.float32) == "triton"


def room_for(pairs: int) -> int:
    """Return the room of a recorded render that had so many pairs when it was measured."""
    return max(LEAST, round(SPARE * pairs))


class Recorder(Protocol):
    """Records work on a device."""

    def stream(self) -> AbstractContextManager[None]:
        """Return the `with` block in which all work is queued, recorded or not."""

    def record(self, *calls: Callable[[], object]) -> tuple[Callable[[], None], ...]:
        """Record calls without doing their work; return what does the work of each, on the same tensors."""


class CudaRecorder:
    """CUDA graphs on a stream of their own."""

    def __init__(self, device: torch.device) -> None:
        self.side = torch.cuda.Stream(device)

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Queue work behind what the caller's stream has, and the caller's further work behind it."""
        current = torch.cuda.current_stream(self.side.device)
        self.side.wait_stream(current)
        try:
            with torch.cuda.stream(self.side):
                yield
        finally:
            current.wait_stream(self.side)

    def record(self, *calls: Callable[[], object]) -> tuple[Callable[[], None], ...]:
        """Record calls without doing their work; return what does the work of each, on the same tensors.

        Their graphs share memory that is theirs alone: torch does not use a pool again whose graphs are all gone.
        """
        pool, made = torch.cuda.graph_pool_handle(), []
        for call in calls:
            graph = torch.cuda.CUDAGraph()
            self.side.synchronize()
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                call()
            finally:
                graph.capture_end()
            made.append(graph.replay)
        return tuple(made)


@dataclass
class Step:
    """One kind of step, run or recorded.

    Attributes:
        names: of its losses.
        status: the losses, whether all gradients are finite, and whether a render lacked room, [k + 2].
        info: of the render that the density control looks at.
        target: its view.
        room: of its renders; empty where it is measured.
        pairs: that they found (`rooms.Rooms`).
        replays: the two graphs; empty where it is not recorded.
    """

    room: tuple[int, ...] = ()
    names: list[str] = field(default_factory=list)
    status: Tensor = field(default_factory=lambda: torch.zeros(2))
    info: RasterInfo | None = None
    target: Target | None = None
    pairs: list[int] = field(default_factory=list)
    replays: tuple[Callable[[], None], ...] = ()


class StepGraphs:
    """The steps of one training.

    Attributes:
        steps: the last step of each kind since the set of Gaussians changed, run or recorded.
        most: most pairs that each render of a kind had.
    """

    def __init__(self, training: "Training", recorder: Recorder) -> None:
        self.training, self.recorder = training, recorder
        self.slots: Slots | None = None
        self.steps: dict[Kind, Step] = {}
        self.most: dict[Kind, list[int]] = {}
        self.records = True

    def forget(self) -> None:
        """Drop all graphs: the tensors that they work on were replaced."""
        self.steps.clear()

    def step(self, index: int) -> dict[str, float]:
        """Take one step as `GaussianTraining.step` does; return the figures for the log."""
        training = self.training
        training.prepare()
        given, rates = training.drawn_input(index), training.step_rates(index)
        kind = Kind.of(given, training.observes(index))
        with self.recorder.stream():
            if self.slots is None:
                self.slots = Slots(given, len(rates), training.model.pivots.device)
            self.slots.fill(given, rates)
            for group, rate in zip(training.rated(), self.slots.rates(), strict=True):
                group["lr"] = rate
            figures = training.checked(index, self._replay(kind) or self._run(kind, index))
            training.change_density(index)
        return training.logged(figures)

    def _replay(self, kind: Kind) -> dict[str, float]:
        """Take a step from graphs, recorded where the last one of its kind ran without; return its losses, or nothing
        where it could not be recorded or has to be run."""
        last = self.steps.get(kind)
        if last is None or not self.records:
            return {}
        step = last if last.replays else self._record(kind)
        if not step.replays:
            return {}
        step.replays[0]()
        *losses, finite, short = step.status.tolist()
        if short or not finite or not all(map(math.isfinite, losses)):
            del self.steps[kind]
            return {}
        step.replays[1]()
        return dict(zip(step.names, losses, strict=True))

    def _record(self, kind: Kind) -> Step:
        step = Step(tuple(map(room_for, self.most[kind])))
        try:
            step.replays = self.recorder.record(lambda: self._compute(kind, step), lambda: self._follow(kind, step))
        except RuntimeError as error:
            logger.warning("steps are not recorded as CUDA graphs and take longer: %s", error)
            self.records, step.replays = False, ()
        self.steps[kind] = step
        return step

    def _run(self, kind: Kind, index: int) -> dict[str, float]:
        """Take a step without graphs; return its losses."""
        training, step = self.training, Step()
        self._compute(kind, step)
        *losses, finite, _ = step.status.tolist()
        figures = training.checked(index, dict(zip(step.names, losses, strict=True)))
        if not finite:
            require_finite(training.model, index)
        self._follow(kind, step)
        before = self.most.get(kind, step.pairs)
        self.most[kind] = [max(pair) for pair in zip(before, step.pairs, strict=True)]
        self.steps[kind] = step
        return figures

    def _compute(self, kind: Kind, step: Step) -> None:
        """Compute losses, gradients and status."""
        training, slots = self.training, self.slots
        assert slots is not None, "`step` fills them first"
        given = slots.input(kind)
        with rooms.given(step.room) if step.room else rooms.measured() as found:
            losses, step.info = training.losses_of(given)
        values = torch.stack(list(losses.values()))
        training.backward(values)
        short = values.new_zeros(())
        if step.room:
            lacking = [torch.as_tensor(pairs > room) for pairs, room in zip(found.pairs, step.room, strict=True)]
            short = torch.stack(lacking).any()
        else:
            step.pairs = [int(pairs) for pairs in found.pairs]
        step.names, step.target = list(losses), given.target
        step.status = torch.cat((values.detach(), torch.stack((training.limited(), short.to(values)))))

    def _follow(self, kind: Kind, step: Step) -> None:
        """Follow the gradients."""
        assert step.target is not None, "`_compute` comes first"
        self.training.update(step.info if kind.observes else None, step.target)
