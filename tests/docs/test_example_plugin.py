"""The example of docs/example-plugin, installed as a stranger installs it: listed, checked, run, in the record."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from calling import output

from rewild4d.contracts import HeldOut
from rewild4d.leaderboard.records import find_records
from rewild4d.priors.io import save_prior
from rewild4d.registry import load_metric, plugged_in
from rewild4d.running.conformance import tiny_case

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "example-plugin"
DATA = FOLDER / "data"


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed package; the sources are copied first, as pip builds inside of them."""
    source, target = (tmp_path_factory.mktemp(name) / "example" for name in ("source", "target"))
    shutil.copytree(FOLDER, source)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
               "--target", str(target), str(source)]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return target


@pytest.fixture
def installed(target: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This process sees the package."""
    monkeypatch.syspath_prepend(str(target))
    plugged_in.cache_clear()
    yield
    for name in [name for name in sys.modules if name.split(".")[0] == "example_plugin"]:
        monkeypatch.delitem(sys.modules, name)
    plugged_in.cache_clear()


@pytest.mark.usefixtures("installed")
def test_list_names_all_four_parts_and_their_package(capsys: pytest.CaptureFixture[str]) -> None:
    said = output(capsys, "list")
    package = "[rewild4d-example-plugin 0.1]"
    for start in ("blob ", "example ", "centroid_offset "):
        (line,) = [line for line in said.splitlines() if line.strip().startswith(start)]
        assert line.endswith(package), line
    assert "example-96-v1            Example, 96 pixels (default)" in said


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    "words", [("--method", "blob"), ("--metric", "centroid_offset"), ("--dataset", "example", "--data", str(DATA))]
)
def test_each_part_keeps_its_contract(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert "0 errors, 0 warnings" in output(capsys, "check", *words)


@pytest.mark.usefixtures("installed")
def test_the_metric_measures_what_it_says() -> None:
    """One pixel at column 3, row 0 against one at column 0, row 4; an empty matte has no centroid."""
    here, there, nothing = torch.zeros(3, 1, 5, 5)
    here[0, 0, 3] = there[0, 4, 0] = 1.0
    images = [HeldOut(0.0, 0, here, here, matte, here, 1.0) for matte in (there, here, nothing)]
    assert list(load_metric("centroid_offset").measure(images)) == [(3**2 + 4**2) ** 0.5, 0.0, None]


def test_a_run_of_all_four_parts_has_the_metric_in_its_record(target: Path, tmp_path: Path) -> None:
    save_prior(tiny_case().prior, tmp_path / "prior.npz")  # the data were rendered from it
    command = [sys.executable, "-m", "rewild4d", "run", "--method", "blob", "--dataset", "example", "--data", str(DATA),
               "--prior", str(tmp_path / "prior.npz"), "--out", str(tmp_path / "runs"), "--jobs", "1"]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(target), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "centroid offset, px ↓" in done.stdout
    found = {record.method: record for _, record in find_records(tmp_path / "runs")}
    record = found["blob"]
    assert (record.dataset, record.case, record.protocol["name"]) == ("example", "quadruped/walk", "example-96-v1")
    score = record.scores["centroid_offset"]
    assert score.value is not None and 0 < score.value < 96 / 10 and score.count == len(record.items) == 4
    about = record.metrics["centroid_offset"]
    assert (about["package"], about["version"]) == ("rewild4d-example-plugin", "0.1")
    assert len(record.code["method"]) == 16, "an edited package is another run"
    assert found["empty"].scores["centroid_offset"].note == "not computed: no image in which it is defined"
