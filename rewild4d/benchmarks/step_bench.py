"""`bench step`: time one training step of `ours`, profile it, and time the rendering of its result."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from rewild4d.benchmarks import probes
from rewild4d.benchmarks.results import OURS, Row, single_row, timed_row
from rewild4d.benchmarks.scenes import posed_clip, step_config, training
from rewild4d.benchmarks.timing import measure, per, progress
from rewild4d.harmonics import seen_colors
from rewild4d.kernels.switch import KERNELS, without_kernels
from rewild4d.kernels.threads import torch_on_one
from rewild4d.ours.config import Config, WarmUp
from rewild4d.ours.method import Ours
from rewild4d.rasterizer import rasterize
from rewild4d.types import Camera, Splats

CPU = torch.device("cpu")

STEP, CACHED, UNCACHED = "step", "rendering, frames cached", "rendering, frames not cached"

REPORTED = Row(
    subject="the paper, one A6000", quantity=STEP, value=13 * 60 * 1000 / 10_000, unit="ms", size=512, repeats=0,
    note="reported: 10,000 iterations at 512² in 13 minutes",
)  # fmt: skip

PROFILED = 4
"""Most periods that are profiled: reading the profiler's log takes longer than the steps."""
SPAN = 10
"""Periods after which the step index restarts, so that long measurements stay at one point of the schedule."""
OPERATORS, NAMED = 12, 90
"""Number of listed operators, and most letters of a name."""
ALL, NONE = "all kernels", "no kernel: plain torch"
SCENES = {"quick": (2_000, 128), "paper": (20_000, 256)}
"""Preset -> Gaussians and image side of the timed step."""


def bench_step(
    count: int,
    sizes: Sequence[int],
    repeats: int,
    preset: str,
    probe: bool = True,
    device: torch.device = CPU,
    kernels: bool = False,
) -> list[Row]:
    """Time steps with ``count`` Gaussians at every image side, alternately; profile them; time the rendering.

    ``probe`` adds memory, in processes of their own, and ``kernels`` the step with each fused kernel switched off (both
    on the CPU only).

    Raises:
        UserError: no such preset.
    """
    steppers = {size: Stepper(count, size, preset, device) for size in sizes}
    calls = {(STEP, size): stepper.run_period for size, stepper in steppers.items()}
    if device.type == "cuda":
        calls |= {
            (f"{STEP}, no CUDA graph", size): partial(stepper.run_period, False) for size, stepper in steppers.items()
        }
    for call in (*calls.values(), *calls.values()):
        call()  # compiles kernels and records graphs, untimed
    samples = measure(calls, repeats, "training step")
    rows = [timed_row(OURS, name, per(samples[name, size], steppers[size].period), count, size) for name, size in calls]
    rows.append(REPORTED)
    if device.type == "cuda":
        peak = torch.cuda.max_memory_allocated(device) / 2**20
        rows.append(single_row(OURS, "peak memory", peak, "MiB", count, max(sizes), "of the GPU, all sizes"))
    for size, stepper in steppers.items():
        rows += stepper.operators(min(repeats, PROFILED))
        if probe and device.type == "cpu":
            rows.append(probes.step_row(count, size, preset))
    rows += render_rows(count, max(sizes), repeats, preset, device)
    return rows + (kernel_rows(repeats) if kernels and device.type == "cpu" else [])


class Stepper:
    """A training that continues by periods of steps: some losses act only in every n-th step."""

    def __init__(self, count: int, size: int, preset: str, device: torch.device = CPU) -> None:
        self.count, self.size, self.device = count, size, device
        self.training, self.first = training(size, count, preset, device)
        self.period, self.taken, self.graphs = loss_period(self.training.config), 0, self.training.graphs

    def run_period(self, recorded: bool = True) -> None:
        """Take `period` steps, as `ours.fit.train` does; on a GPU also without CUDA graphs."""
        self.training.graphs = self.graphs if recorded else None
        with torch_on_one():
            for _ in range(self.period):
                self.training.step(self.first + self.taken % (SPAN * self.period))
                self.taken += 1
        _wait(self.device)

    def operators(self, periods: int) -> list[Row]:
        """Return the operators of torch and our autograd functions that take most time, as shares of all; on a GPU its
        kernels."""
        on_gpu = self.device.type == "cuda"
        with (
            progress(f"profile of a step at {self.size}²", periods) as bar,
            profile(activities=[ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]) as profiler,
        ):
            for _ in range(periods):
                self.run_period()
                bar.update()
        steps = periods * self.period
        spent = {
            event: event.self_device_time_total if on_gpu else event.self_cpu_time_total
            for event in profiler.key_averages()
        }
        found, total = sorted(spent, key=lambda event: -spent[event]), sum(spent.values())
        return [
            Row(
                subject=event.key[:NAMED], quantity="share of a step", value=spent[event] / total, unit="1",
                gaussians=self.count, size=self.size, repeats=steps, note=f"{event.count / steps:.3g} calls a step",
            )
            for event in found[:OPERATORS]
        ]  # fmt: skip


def loss_period(config: Config) -> int:
    """Return the number of steps after which the same losses act again."""
    geometry = config.geometry
    return math.lcm(geometry.smooth_every, geometry.tv_every, geometry.compact_every)


def kernel_rows(repeats: int) -> list[Row]:
    """Time the step at presets `quick` and `paper`: all fused kernels, each switched off alone, and plain torch."""
    rows = []
    for preset, (count, size) in SCENES.items():
        stepper = Stepper(count, size, preset)
        before = {name: kernel.calls for name, kernel in KERNELS.items()}
        stepper.run_period()
        used = [name for name, kernel in KERNELS.items() if kernel.calls > before[name]]
        choices: dict[str, list[str]] = {ALL: [], **{f"without {name}": [name] for name in used}, NONE: used}

        def run(off: list[str], stepper: Stepper = stepper) -> None:
            with without_kernels(*off):
                stepper.run_period()

        calls = {name: partial(run, off) for name, off in choices.items()}
        samples = measure(calls, repeats, f"kernels, {preset}")
        rows += [
            timed_row(name, f"step, preset {preset}", per(sample, stepper.period), count, size)
            for name, sample in samples.items()
        ]
    return rows


def render_rows(count: int, size: int, repeats: int, preset: str, device: torch.device = CPU) -> list[Row]:
    """Time the rendering of a fitted clip's frames, with their Gaussians computed for each frame or kept."""
    clip, prior = posed_clip(size, count)
    config = msgspec.structs.replace(
        step_config(size, count, preset), iterations=1, warmup=WarmUp(iterations=0, regress=0)
    )
    with progress("a fitted clip", 1) as bar:  # one iteration: quality does not matter for time
        made = Ours().fit(clip, prior, config=config, seed=0, device=device, log=lambda *_: None, workdir=None)
        bar.update()
    views = [(frame.time, frame.camera) for frame in clip.frames if frame.camera is not None]
    kept = {time: made.at(time) for time, _ in views}

    def draw(splats_at: Callable[[float], Splats]) -> list[Tensor]:
        images = [_render(splats_at(time), camera) for time, camera in views]
        _wait(device)
        return images

    calls = {CACHED: partial(draw, kept.__getitem__), UNCACHED: partial(draw, made.at)}
    samples = measure(calls, repeats, f"rendering at {size}²")
    return [timed_row(OURS, name, per(sample, len(views)), count, size) for name, sample in samples.items()]


@torch.no_grad()
def _render(splats: Splats, camera: Camera) -> Tensor:
    """Render a frame as a viewer sees it, on black, [3, h, w]."""
    image, _, _ = rasterize(
        splats.means, splats.quats, splats.scales, splats.opacities, seen_colors(splats, camera.center),
        camera.world_to_camera[None], camera.intrinsics[None], camera.width, camera.height,
    )  # fmt: skip
    return image[0]


def _wait(device: torch.device) -> None:
    """Wait for a GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
