"""The mapped folders: every package is listed, its data travels in the wheel, and nobody's names are shadowed."""

import ast
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from rewild4d.machine import SHOWING, result_sources

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]


def sources() -> list[Path]:
    return [file for folder in SETUPTOOLS["package-dir"].values() for file in sorted((ROOT / folder).rglob("*.py"))]


def package_of(folder: str) -> str:
    """Name of the package in a folder of the repository."""
    return ".".join(folder.split("/") if folder.startswith("rewild4d") else ["rewild4d", *folder.split("/")])


def test_every_folder_with_an_init_is_mapped() -> None:
    tops = ("baselines", "datasets", "leaderboard", "metrics", "rewild4d")
    found = {str(file.parent.relative_to(ROOT)) for top in tops for file in (ROOT / top).rglob("__init__.py")}
    others = {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()}
    assert others <= {*tops}
    assert set(map(package_of, found)) == set(SETUPTOOLS["packages"])
    assert set(SETUPTOOLS["package-dir"].values()) <= found


def test_the_digest_of_the_code_covers_every_package_that_decides_a_result() -> None:
    folders = {"/".join(name.split("/")[:-1]) for name in result_sources()}
    packages = {".".join(["rewild4d", *filter(None, folder.split("/"))]) for folder in folders}
    deciding = {name for name in SETUPTOOLS["packages"] if not {*name.split(".")} & {*SHOWING}}
    assert deciding <= packages


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
        "rewild4d/ours/": (
            "rewild4d.baselines",
            "rewild4d.datasets",
            "rewild4d.leaderboard",
            "rewild4d.running.runner",
        ),
        "rewild4d/benchmarks/": (
            "rewild4d.baselines",
            "rewild4d.commands",
            "rewild4d.datasets",
            "rewild4d.metrics",
            "rewild4d.running.runner",
        ),
        # Competitors read the parts of `ours` that they have in common, never the method itself.
        "baselines/": (
            "rewild4d.datasets",
            "rewild4d.leaderboard",
            "rewild4d.running.runner",
            *(f"rewild4d.ours.{name}" for name in ("deform", "fit", "method", "model", "reconstruction", "warmup")),
        ),
        "datasets/": (
            "rewild4d.ours",
            "rewild4d.baselines",
            "rewild4d.leaderboard",
            "rewild4d.priors",
            "rewild4d.running.runner",
        ),
    }
    allowed = (
        "rewild4d.metrics",
        "rewild4d.leaderboard.records",
        "rewild4d.types",
        "rewild4d.datasets.rigs.animal",  # what reads glTF files, for the files of others
        "rewild4d.datasets.rigs.colors",  # and its parts
        "rewild4d.datasets.rigs.gltf",
        "rewild4d.datasets.rigs.morphs",
        "rewild4d.datasets.rigs.reader",
        "rewild4d.errors",
        "rewild4d.files",
        "rewild4d.foreign.reading",
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
        "rewild4d/datasets/artemis/reader.py",
        "rewild4d/metrics/image.py",
        "rewild4d/py.typed",
    } <= names
    assert "rewild4d/leaderboard/protocols/artemis-sweep-256-v1.toml" in names
    assert "rewild4d/leaderboard/tables/ablation.toml" in names
    assert "rewild4d/leaderboard/paper/artemis.json" in names
    assert "rewild4d/baselines/presets/ours.toml" in names
    assert "rewild4d/metrics/weights.toml" in names
    page = "rewild4d/visualize/report"
    assert {
        f"{page}/{name}" for name in ("player/player.min.js", "player/licences.txt", "templates/report.html")
    } <= names
    assert {f"rewild4d/datasets/masking/editor/page/{name}" for name in ("index.html", "style.css", "main.js")} <= names
    assert {name.split("/")[0] for name in names if not name.startswith("rewild4d-")} == {"rewild4d"}
