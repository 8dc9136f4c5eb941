"""The mapped folders: every package is listed, its data travels in the wheel, and nobody's names are shadowed."""

import ast
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from rewild4d.machine import PACKAGES

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]


def sources() -> list[Path]:
    return [file for folder in SETUPTOOLS["package-dir"].values() for file in sorted((ROOT / folder).glob("*.py"))]


def test_every_folder_with_an_init_is_mapped() -> None:
    skipped = {"build", "dist", ".venv", "tests"}
    found = {str(file.parent.relative_to(ROOT)) for file in ROOT.rglob("__init__.py") if not skipped & set(file.parts)}
    assert found == set(SETUPTOOLS["package-dir"].values())
    assert set(SETUPTOOLS["packages"]) == set(SETUPTOOLS["package-dir"])
    assert {"rewild4d", *(f"rewild4d.{name}" for name in PACKAGES)} == set(SETUPTOOLS["packages"])


def test_the_repository_root_is_off_the_path() -> None:
    import rewild4d.datasets

    assert "datasets" not in sys.modules
    assert Path(rewild4d.datasets.__file__ or "").parent.name == "datasets"


def test_imports_are_absolute_and_run_one_way() -> None:
    """Ground floor below methods, data sets and metrics; metrics alone; tables read records and nothing else."""
    forbidden = {
        "metrics/": ("rewild4d.",),
        "leaderboard/": tuple(
            f"rewild4d.{name}"
            for name in (
                "baselines",
                "commands",
                "config",
                "datasets",
                "ours",
                "planning",
                "priors",
                "protocol",
                "registry",
                "rasterizer",
                "runner",
            )
        ),
        "rewild4d/types.py": ("rewild4d.",),
        "rewild4d/transforms.py": ("rewild4d.ours", "rewild4d.baselines", "rewild4d.datasets", "rewild4d.metrics"),
        "rewild4d/rasterizer/": ("rewild4d.ours", "rewild4d.baselines", "rewild4d.datasets", "rewild4d.metrics"),
        "rewild4d/ours/": ("rewild4d.baselines", "rewild4d.datasets", "rewild4d.leaderboard", "rewild4d.runner"),
        "rewild4d/benchmarks/": (
            "rewild4d.baselines",
            "rewild4d.commands",
            "rewild4d.datasets",
            "rewild4d.metrics",
            "rewild4d.runner",
        ),
        # Competitors read the parts of `ours` that they have in common, never the method itself.
        "baselines/": (
            "rewild4d.datasets",
            "rewild4d.leaderboard",
            "rewild4d.runner",
            *(f"rewild4d.ours.{name}" for name in ("deform", "fit", "method", "model", "reconstruction", "warmup")),
        ),
        "datasets/": (
            "rewild4d.ours",
            "rewild4d.baselines",
            "rewild4d.leaderboard",
            "rewild4d.priors",
            "rewild4d.runner",
        ),
    }
    allowed = (
        "rewild4d.metrics",
        "rewild4d.leaderboard.records",
        "rewild4d.types",
        "rewild4d.datasets.animal",  # what reads glTF files, for the files of others
        "rewild4d.datasets.gltf",  # and its parts
        "rewild4d.datasets.morphs",
        "rewild4d.datasets.rig",
        "rewild4d.errors",
        "rewild4d.files",
    )
    for file in sources():
        relative = str(file.relative_to(ROOT))
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{relative}: relative import"
                for start, banned in forbidden.items():
                    if relative.startswith(start) and node.module and not node.module.startswith(allowed):
                        assert not node.module.startswith(banned), f"{relative} imports {node.module}"


def test_files_stay_readable() -> None:
    lines = {str(file.relative_to(ROOT)): len(file.read_text().splitlines()) for file in sources()}
    assert not {file: count for file, count in lines.items() if count > 350}


def test_the_wheel_carries_code_and_data(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True)
    if built.returncode != 0:
        pytest.fail(built.stdout[-2000:] + built.stderr[-2000:])
    names = set(zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist())
    assert {
        "rewild4d/cli.py",
        "rewild4d/datasets/artemis.py",
        "rewild4d/metrics/image.py",
        "rewild4d/py.typed",
    } <= names
    assert "rewild4d/leaderboard/protocols/artemis-sweep-256-v1.toml" in names
    assert "rewild4d/leaderboard/tables/ablation.toml" in names
    assert "rewild4d/leaderboard/paper/artemis.json" in names
    assert "rewild4d/baselines/presets/ours.toml" in names
    assert "rewild4d/metrics/weights.toml" in names
    assert {name.split("/")[0] for name in names if not name.startswith("rewild4d-")} == {"rewild4d"}
