"""`bench`: time the rasterizer or a training step on this machine; print a table and write the data."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rewild4d.commands.shared import call_subcommand, require_writable_file
from rewild4d.config import load_preset, parse_flags
from rewild4d.errors import UserError
from rewild4d.ours.config import Config

if TYPE_CHECKING:
    import torch

    from rewild4d.benchmarks.results import Row

USAGE = "usage: rewild4d-bench bench rasterizer|step [options]      (bench rasterizer --help lists its options)"
RASTERIZER = """Time the rasterizer, forward and with backward, against peers from PyPI that run on the same device and
against a lower bound, the time of the arithmetic alone on this machine. Rounds of all contenders alternate."""
STEP = """Time one training step of `ours` with every loss, its parts, and the rendering of the result."""


@dataclass(frozen=True)
class RasterizerOptions:
    """Flags of `bench rasterizer`.

    Attributes:
        gaussians: number of Gaussians of each scene.
        sizes: sides of the square images in pixels; every number of Gaussians is timed at every size.
        repeats: rounds of measurement for each scene.
        device: cpu, or cuda: the Triton backend against gsplat's kernels.
        peers: time the peers too.
        probes: measure peak memory too, and on the CPU start-up times (there in processes of their own).
        threads: number of threads; torch's default where it is left out.
        out: file for the data; results/speed/rasterizer-<processor>-<day>.json where it is left out.
        json: print the data as JSON, and nothing else, to standard output.
    """

    gaussians: tuple[int, ...] = (10_000, 30_000, 100_000)
    sizes: tuple[int, ...] = (256, 512)
    repeats: int = 20
    device: str = "cpu"
    peers: bool = True
    probes: bool = True
    threads: int | None = None
    out: Path | None = None
    json: bool = False


@dataclass(frozen=True)
class StepOptions:
    """Flags of `bench step`.

    Attributes:
        gaussians: number of Gaussians of the model.
        sizes: sides of the square frames in pixels; clips are rendered at the largest.
        repeats: rounds of measurement.
        preset: of `ours`; image size and number of Gaussians are those above.
        device: cpu or cuda.
        probes: measure peak memory too (on the CPU), in processes of their own.
        by_kernel: time the step with each fused kernel switched off too, at presets quick and paper (on the CPU).
        threads: number of threads; torch's default where it is left out.
        out: file for the data; results/speed/step-<processor>-<day>.json where it is left out.
        json: print the data as JSON, and nothing else, to standard output.
    """

    gaussians: int = 20_000
    sizes: tuple[int, ...] = (512, 256)
    repeats: int = 20
    preset: str = "paper"
    device: str = "cpu"
    probes: bool = True
    by_kernel: bool = True
    threads: int | None = None
    out: Path | None = None
    json: bool = False


def main(arguments: list[str]) -> int:
    return call_subcommand(arguments, USAGE, "benchmark", {"rasterizer": _rasterizer, "step": _step})


def _rasterizer(arguments: list[str]) -> int:
    options = parse_flags(RasterizerOptions, arguments, prog="rewild4d-bench bench rasterizer", description=RASTERIZER)
    _check(options, options.gaussians)
    from rewild4d.benchmarks.peers import CUDA_PEERS, PEERS, installed
    from rewild4d.benchmarks.raster_bench import bench_rasterizer
    from rewild4d.machine import pick_device

    settings: dict[str, int | str | list[int]] = {
        "gaussians": list(options.gaussians), "sizes": list(options.sizes), "repeats": options.repeats,
    }  # fmt: skip
    device = pick_device(options.device)
    peers = (CUDA_PEERS if device.type == "cuda" else PEERS) if options.peers else ()
    return _report(
        ["rasterizer", *arguments], options, settings, installed(peers), device,
        lambda: bench_rasterizer(options.gaussians, options.sizes, options.repeats, peers, options.probes, device),
    )  # fmt: skip


def _step(arguments: list[str]) -> int:
    options = parse_flags(StepOptions, arguments, prog="rewild4d-bench bench step", description=STEP)
    _check(options, (options.gaussians,))
    load_preset("ours", Config, options.preset)  # fail on an unknown preset before anything is measured
    from rewild4d.benchmarks.step_bench import bench_step
    from rewild4d.machine import pick_device

    settings: dict[str, int | str | list[int]] = {
        "gaussians": options.gaussians, "sizes": list(options.sizes), "repeats": options.repeats,
        "preset": options.preset,
    }  # fmt: skip
    device = pick_device(options.device)
    return _report(
        ["step", *arguments], options, settings, {}, device,
        lambda: bench_step(
            options.gaussians, options.sizes, options.repeats, options.preset, options.probes, device, options.by_kernel
        ),
    )  # fmt: skip


def _check(options: RasterizerOptions | StepOptions, gaussians: Sequence[int]) -> None:
    least = {"--gaussians": (gaussians, 100), "--sizes": (options.sizes, 16), "--repeats": ((options.repeats,), 1)}
    if options.threads is not None:
        least["--threads"] = ((options.threads,), 1)
    for flag, (values, smallest) in least.items():
        if not values or min(values) < smallest:
            found = " ".join(map(str, values)) or "none"
            raise UserError(f"{flag}: expected at least one number, none below {smallest}, got {found}.")


def _report(
    command: list[str],
    options: RasterizerOptions | StepOptions,
    settings: dict[str, int | str | list[int]],
    peers: dict[str, str],
    device: torch.device,
    measure: Callable[[], list[Row]],
) -> int:
    """Measure, write the data, print the table."""
    from rewild4d.benchmarks.results import Result, default_path, this_machine, to_json, write_result
    from rewild4d.benchmarks.tables import markdown
    from rewild4d.benchmarks.timing import threads
    from rewild4d.rasterizer import pick_rasterizer

    if device.type == "cuda" and pick_rasterizer("auto", device) != "triton":
        raise UserError(f"--device {device}: expected Triton, which is what is timed on a GPU; pip install triton.")
    path = options.out or default_path(command[0], device)
    require_writable_file(path)
    with threads(options.threads) as count:
        result = Result(
            benchmark=command[0], command=["bench", *command], threads=count, settings=settings, peers=peers,
            rows=measure(), machine=this_machine(device),
        )  # fmt: skip
    write_result(result, path)
    print(to_json(result) if options.json else markdown(result))
    print(f"\ndata: {path}", file=sys.stderr)
    return 0
