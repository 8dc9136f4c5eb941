"""Whole fits on a GPU, where one is: what is written, read back and resumed there, and that the CPU finds the same."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch

from rewild4d.cameras.rendering import render
from rewild4d.contracts import Reconstruction
from rewild4d.io.export import export, why_not
from rewild4d.rasterizer import pick_rasterizer
from rewild4d.registry import load_method
from rewild4d.running.conformance import tiny_case
from rewild4d.running.runner import save_reconstruction
from rewild4d.types import Case
from rewild4d.visualize import run_pictures as view

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
SHORT: dict[str, Any] = {
    "image_size": 64,
    "iterations": 24,
    "checkpoint_every": 10,
    "canonical": {"samples": 400, "sh_degree": 3},
    "density": {"every": 0.25, "start": 0.0, "end": 0.8, "cap": 480},
}
NETWORK = {"network": {"width": 16, "time_width": 8, "time_features": 4}}
GRID = {"skinning": {"resolution": 8, "neighbours": 4, "sweeps": 1}}
TINY: dict[str, dict[str, Any]] = {
    "ours": SHORT
    | {
        "skinning": {"resolution": 10, "sweeps": 5},
        "deform": {"width": 16},
        "warmup": {"iterations": 12, "regress": 8, "samples": 300, "size": 48, "views": 2},
        "geometry": {"smooth_size": 24, "temporal": 0.1, "rigid": 0.1},
    },
    "d3dgs": SHORT | NETWORK,
    "d3dgs-star": SHORT | NETWORK,
    "gart": SHORT | GRID,
    "gart-star": SHORT | GRID | {"refine": {"steps": 3}},
}


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def fitted(name: str, case: Case, device: torch.device, workdir: Path | None = None) -> Reconstruction:
    method = load_method(name)
    config = msgspec.convert(TINY[name], method.Config)
    return method.fit(case.clip, case.prior, config=config, seed=0, device=device, log=lambda *_: None, workdir=workdir)


def likeness(one: Reconstruction, other: Reconstruction, case: Case) -> float:
    """PSNR in dB between the two, over the input frames."""
    errors = []
    for frame in case.clip.frames:
        assert frame.camera is not None
        first, second = (render(each.at(frame.time), frame.camera)[0] for each in (one, other))
        errors.append(float((first - second).square().mean()))
    return -10 * math.log10(max(sum(errors) / len(errors), 1e-12))


@pytest.mark.parametrize("name", TINY)
def test_a_method_runs_on_a_gpu(name: str, case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def count(images: Iterable[torch.Tensor], path: Path, fps: float) -> None:
        path.write_text(f"{len(list(images))} at {fps}")  # films need no GPU, and here no encoder

    monkeypatch.setattr(view, "save_mp4", count)
    made = fitted(name, case, CUDA, tmp_path)
    assert made.at(0.0).means.device.type == "cuda" and len(made.at(0.05)) >= 400
    assert likeness(made, fitted(name, case, CPU), case) > 30
    assert likeness(made, fitted(name, case, CUDA, tmp_path), case) > 60, "a finished fit was not taken up again"
    save_reconstruction(made, tmp_path / "saved")
    for device in (CUDA, CPU):
        assert likeness(made, load_method(name).load(tmp_path / "saved", device), case) > 60
    (tmp_path / "pictures").mkdir()
    written = view.save_pictures(made, case.clip, case.truth, tmp_path / "pictures")
    assert "comparison.png" in written and all((tmp_path / "pictures" / one).is_file() for one in written)
    kinds = [kind for kind in ("ply", "glb", "cameras") if not why_not(made, kind, case.clip)]
    assert len(export(made, case.clip, kinds, tmp_path / "export")) >= len(case.clip.frames)


def test_a_gpu_is_picked() -> None:
    assert pick_rasterizer("auto", CUDA) == "triton"
