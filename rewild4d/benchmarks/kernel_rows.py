"""What each fused kernel saves: the whole training step with all kernels, without one of them, and in plain torch."""

from collections.abc import Callable
from functools import partial
from typing import Protocol

from rewild4d.benchmarks.results import Row, timed_row
from rewild4d.benchmarks.timing import Sample, measure, per
from rewild4d.kernels.switch import KERNELS, without_kernels

ALL, NONE = "all kernels", "no kernel: plain torch"
SCENES = {"quick": (2_000, 128), "paper": (20_000, 256)}
"""Preset -> Gaussians and image side of the step that is timed."""


class Stepper(Protocol):
    """A training that goes on from turn to turn, as `step_bench.Stepper`."""

    period: int

    def turn(self) -> None: ...


Make = Callable[[int, int, str], Stepper]


def kernel_rows(make: Make, repeats: int) -> list[Row]:
    """Time the step at presets `quick` and `paper`, each kernel switched off alone, in turns.

    Args:
        make: builds the training of so many Gaussians, an image side and a preset.
        repeats: rounds of measurement.
    """
    rows = []
    for preset, (count, size) in SCENES.items():
        found = _steps(make, preset, count, size, repeats)
        rows += [timed_row(name, f"step, preset {preset}", sample, count, size) for name, sample in found.items()]
    return rows


def _steps(make: Make, preset: str, count: int, size: int, repeats: int) -> dict[str, Sample]:
    stepper = make(count, size, preset)
    before = {name: kernel.calls for name, kernel in KERNELS.items()}
    stepper.turn()
    used = [name for name, kernel in KERNELS.items() if kernel.calls > before[name]]
    choices: dict[str, tuple[str, ...]] = {ALL: (), **{f"without {name}": (name,) for name in used}, NONE: tuple(used)}

    def turn(names: tuple[str, ...]) -> None:
        with without_kernels(*names):
            stepper.turn()

    samples = measure({name: partial(turn, off) for name, off in choices.items()}, repeats, f"kernels, {preset}")
    return {name: per(sample, stepper.period) for name, sample in samples.items()}
