"""Measure start-up times, compiled kernels and peak memory in fresh processes.

The memory probes run `python -m rewild4d.benchmarks.probes KIND ...`.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from rewild4d.benchmarks.results import OURS, Row, single_row
from rewild4d.benchmarks.scenes import SplatScene, splat_scene, training
from rewild4d.benchmarks.timing import progress

START_COUNT, START_SIZE = 1000, 64
"""Gaussians and image side of the start-up image; imports and compilation dominate."""
STATUS = Path("/proc/self/status")


def raster_rows(count: int, size: int) -> list[Row]:
    """Measure cold and cached start, and the peak memory of forward and backward of a scene."""
    with tempfile.TemporaryDirectory() as folder, progress("start-up and memory", 3) as bar:
        file = Path(folder, "scene.pt")
        _save(splat_scene(START_COUNT, START_SIZE), file)
        cache = {"REWILD4D_CACHE": str(Path(folder, "cache")), "NUMBA_CACHE_DIR": ""}
        rows = []
        for title in ("cold start", "cached start"):
            rows += _start_rows(title, _child("first_image", str(file), environment=cache))
            bar.update()
        _save(splat_scene(count, size), file)
        rows.append(_memory_row(_child("probes", "rasterizer", str(file)), count, size))
        bar.update()
    return rows


def gpu_memory_row(scene: SplatScene) -> Row:
    """Measure the peak memory of forward and backward on the scene's GPU."""
    device = scene.intrinsics.device
    forward_backward(scene)  # loads kernels and allocates torch's workspaces
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    forward_backward(scene)
    torch.cuda.synchronize(device)
    found = {"before": before / 2**20, "peak": torch.cuda.max_memory_allocated(device) / 2**20}
    return _memory_row(found, len(scene), scene.size)


def step_row(count: int, size: int, preset: str) -> Row:
    """Measure the peak memory of training steps of `ours`."""
    with progress(f"memory of a step at {size}²", 1) as bar:
        found = _child("probes", "step", str(count), str(size), preset)
        bar.update()
    return _memory_row(found, count, size)


def _start_rows(title: str, found: Mapping[str, float]) -> list[Row]:
    rows = (
        ("", "seconds", "s", "interpreter, imports, first image with gradients, and the process's end"),
        (": torch", "torch", "s", "its own import, whatever comes after"),
        (": after torch", "after_torch", "s", "imports of the rasterizer, first image with gradients"),
        (": first image", "first_image", "s", ""),
        (": kernels compiled", "compiled", "1", ""),
    )
    scene = START_COUNT, START_SIZE
    return [single_row(OURS, title + part, found[key], unit, *scene, note) for part, key, unit, note in rows]


def _memory_row(found: Mapping[str, float], count: int, size: int) -> Row:
    value, note = None, f"not measured: no {STATUS} here"
    if found:
        value = found["peak"] - found["before"]
        note = f"above the {found['before']:.0f} MiB of the process with its inputs"
    return single_row(OURS, "peak memory", value, "MiB", count, size, note)


def _child(module: str, *words: str, environment: Mapping[str, str] | None = None) -> dict[str, float]:
    """Run a module of this package in its own process; return the figures that it prints, and ``seconds``."""
    command = [sys.executable, "-m", f"rewild4d.benchmarks.{module}", *words]
    settings = {"OMP_NUM_THREADS": str(torch.get_num_threads()), **(environment or {})}
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | settings)
    seconds = time.perf_counter() - begin
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
    found = json.loads(done.stdout)
    return found | {"seconds": seconds} if found else found


def _save(scene: SplatScene, file: Path) -> None:
    torch.save((scene.gaussians, scene.world_to_camera, scene.intrinsics, scene.size), file)


def forward_backward(scene: SplatScene) -> None:
    """Render one image, with gradients of all five inputs."""
    leaves = tuple(tensor.clone().requires_grad_() for tensor in scene.gaussians)
    image, _ = scene.render(leaves)
    torch.autograd.grad(image, leaves, torch.ones_like(image))


def _raster_memory(file: str) -> dict[str, float]:
    forward_backward(splat_scene(64, 32))  # loads the kernels
    scene = SplatScene(*torch.load(file, weights_only=True))
    return _peak(lambda: forward_backward(scene))


def _step_memory(count: str, size: str, preset: str) -> dict[str, float]:
    trainer, first = training(int(size), int(count), preset)

    def steps() -> None:
        for index in range(4):
            trainer.step(first + index)

    return _peak(steps)


def _peak(work: Callable[[], None]) -> dict[str, float]:
    """Return the resident memory in MiB before some work and at its peak; empty on systems that do not tell."""
    if not STATUS.is_file():
        return {}
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak of the imports
    before = _status_mib("VmRSS")
    work()
    # ru_maxrss starts at the parent's after a fork
    return {"before": before, "peak": _status_mib("VmHWM")}


def _status_mib(field: str) -> float:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(f"{field}:"))
    return int(line.split()[1]) / 1024


PROBES: dict[str, Callable[..., dict[str, float]]] = {"rasterizer": _raster_memory, "step": _step_memory}

if __name__ == "__main__":
    print(json.dumps(PROBES[sys.argv[1]](*sys.argv[2:])))
