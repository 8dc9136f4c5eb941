"""A perfect program of somebody else, and what it knows of the tiny case."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import msgspec
import torch
from one_case import OneCase
from torch import Tensor

from rewild4d.baselines.external import External, ExternalConfig, ExternalReconstruction
from rewild4d.cameras.rendering import render
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.io.meshes import Mesh, discs
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.priors.motion import pose_at
from rewild4d.running import runner
from rewild4d.transforms import skin_points
from rewild4d.types import Case

CPU = torch.device("cpu")
UPPER = "upper bound: rotated, scaled and shifted to the best input-view PSNR"
STUB = Path(__file__).parent / "external_stub.py"


def posed(case: Case, index: int) -> Tensor:
    """The true surface's vertices in the world at a frame."""
    object_to_world, transforms = pose_at(case.prior, case.clip.times[index])
    points = skin_points(case.prior.vertices, case.prior.weights, transforms).double()
    return points @ object_to_world[:3, :3].T + object_to_world[:3, 3]


def bodies(case: Case, matrix: Tensor | None = None) -> list[dict[str, Any]]:
    """What a perfect program knows of each frame, in a frame of reference of its own."""
    found = []
    rest = case.prior.vertices
    colors = 0.5 + 0.4 * torch.sin(3 * rest)
    for index in range(len(case.clip.frames)):
        points = posed(case, index)
        if matrix is not None:
            points = points @ matrix[:3, :3].T + matrix[:3, 3]
        scale = 1.0 if matrix is None else float(torch.linalg.det(matrix[:3, :3]) ** (1 / 3))
        area = discs([Mesh(points.float(), case.prior.faces)], 4000, 0)[0]
        shade = discs([Mesh(points.float(), case.prior.faces, colors)], 4000, 0)[0].colors
        assert shade is not None
        found.append({
            "points": area.points.tolist(), "colors": shade.tolist(), "radius": area.radius, "scale": scale,
            "vertices": points.tolist(), "faces": case.prior.faces.tolist(), "shade": colors.clamp(0, 1).tolist(),
        })  # fmt: skip
    return found


def settings(tmp_path: Path, what: str, content: list[dict[str, Any]], **changes: Any) -> ExternalConfig:
    path = tmp_path / f"{what}.json"
    path.write_text(json.dumps(content))
    command = f"{sys.executable} {STUB} {{clip}} {{out}} {what} {{seed}} {path}"
    return ExternalConfig(**{"command": command, "points": 4000, "timeout": 60.0, **changes})


def fit(case: Case, config: ExternalConfig, workdir: Path | None = None) -> ExternalReconstruction:
    return External().fit(
        case.clip, case.prior, config=config, seed=7, device=CPU, log=lambda *_: None, workdir=workdir
    )


def psnr(found: ExternalReconstruction, case: Case, held_out: bool = False) -> float:
    """Mean over the input or the held-out frames, on white."""
    values = []
    for frame in case.truth.held_out if held_out else case.clip.frames:
        assert frame.camera is not None
        color, alpha = render(found.at(frame.time), frame.camera)
        values.append(-10 * math.log10(float((color + 1 - alpha - frame.over(1.0)).square().mean())))
    return sum(values) / len(values)


def a_plan(case: Case, tmp_path: Path, *configs: ExternalConfig) -> runner.Plan:
    """Runs on the tiny case with its own prior, scored by two quick scores."""
    save_prior(case.prior, tmp_path / "prior.npz")
    protocol = msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou"))
    return runner.Plan(
        dataset="artemis", reader=OneCase(case), root=tmp_path, cases=(case.clip.name,), protocol=protocol,
        entries=tuple(runner.Entry("external", "default", config, (7,)) for config in configs),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD), device=CPU, out=tmp_path / "runs",
    )  # fmt: skip
