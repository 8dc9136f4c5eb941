"""CONTRIBUTING's worked example: its lines, put where it says, give `ours` a loss, a layer and a head."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STEP = """
import msgspec, torch
from rewild4d.benchmarks.scenes import training
from rewild4d.kernels.switch import KERNELS
from rewild4d.rasterizer import set_default

set_default("reference")  # nothing to compile
step, index = training(32, 60, "quick")
geometry = msgspec.structs.replace(step.config.geometry, solid=0.01)
step.config = msgspec.structs.replace(step.config, geometry=geometry)
assert step.step(index)["solid"] > 0
for layer in (step.model.deform.extra, step.model.deform.gate):
    assert layer.weight.grad.abs().max() > 0
print(*sorted(name for name, kernel in KERNELS.items() if not kernel.is_current()))
"""


def example() -> str:
    """The worked example's diff."""
    (found,) = re.findall(
        r"^```diff\n(.*?)^```$", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.MULTILINE | re.DOTALL
    )
    return found


def hunks(diff: str) -> list[tuple[str, str, str]]:
    """File, lines before and lines after of every part of a diff; a part begins at "@@"."""
    parts, path = [], ""
    for block in re.split(r"^(?=--- |@@)", diff, flags=re.MULTILINE):
        head, _, body = block.partition("\n")
        if head.startswith("--- a/"):
            path = head.removeprefix("--- a/")
        elif head.startswith("@@"):
            lines = body.splitlines(keepends=True)
            before, after = ("".join(line[1:] for line in lines if line[0] in " " + sign) for sign in "-+")
            parts.append((path, before, after))
    return parts


def test_it_is_ten_lines_at_most() -> None:
    assert sum(line.startswith("+") for line in example().splitlines()) <= 10


def test_it_runs_in_torch_and_the_edited_kernel_steps_aside(tmp_path: Path) -> None:
    package = tmp_path / "rewild4d"
    sources = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "rewild4d", package, ignore=sources)
    for name in ("baselines", "datasets", "leaderboard", "metrics"):
        shutil.copytree(ROOT / name, package / name, ignore=sources)
    for path, before, after in hunks(example()):
        text = (tmp_path / path).read_text(encoding="utf-8")
        assert text.count(before) == 1, f"{path}: expected these lines once:\n{before}"
        (tmp_path / path).write_text(text.replace(before, after), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "REWILD4D_KERNELS": "torch"}
    done = subprocess.run(
        [sys.executable, "-c", STEP], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["deformation"]
