"""The `bench` command from end to end: what it prints and writes, and what it refuses. No time is ever asserted."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from markdown_lines import cells

from rewild4d import cli
from rewild4d.benchmarks import floor
from rewild4d.benchmarks.results import BOTH, FLOOR, FORWARD, OURS, Result, default_path
from rewild4d.benchmarks.scenes import splat_scene
from rewild4d.benchmarks.step_bench import REPORTED
from rewild4d.benchmarks.timing import threads


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tiny tensors on a busy machine: threads only wait for each other."""
    with threads(1):
        yield


def run(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", *words, "--threads", "1", "--no-probes"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    assert "data: " in err
    return out


def test_bench_rasterizer_from_end_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("rasterizer", "--gaussians", "200", "--sizes", "32", "--repeats", "2", "--no-peers")
    out = run(capsys, *words)
    assert len(cells(out, "200", "32²")) == 8
    path = tmp_path / default_path("rasterizer")
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [path]
    result = msgspec.json.decode(path.read_bytes(), type=Result)
    assert (result.schema, result.benchmark, result.threads) == (1, "rasterizer", 1)
    assert result.command == ["bench", *words, "--threads", "1", "--no-probes"]
    assert result.settings == {"gaussians": [200], "sizes": [32], "repeats": 2}
    assert {"processor", "torch", "numba"} <= set(result.machine) and result.code["sources"]
    found = {(row.subject, row.quantity): row for row in result.rows}
    assert set(found) == {
        ("scene", "useful blends"), (FLOOR, "multiply-adds"), (FLOOR, FORWARD), (FLOOR, BOTH), (OURS, FORWARD),
        (OURS, BOTH),
    }  # fmt: skip
    assert found["scene", "useful blends"].value == floor.count_blends(splat_scene(200, 32))
    rate = found[FLOOR, "multiply-adds"].value or math.nan
    assert found[FLOOR, BOTH].value == pytest.approx(found["scene", "useful blends"].value * 110 / rate / 1e6)
    for row in result.rows:
        assert row.value is not None and math.isfinite(row.value) and row.value > 0 and row.unit
    assert found[OURS, FORWARD].repeats == 2


def test_bench_step_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new" / "step.json"
    words = ("--gaussians", "150", "--sizes", "32", "--repeats", "1", "--preset", "quick", "--out", str(file), "--json")
    out = run(capsys, "step", *words)
    assert json.loads(out) == json.loads(file.read_text())
    rows = msgspec.json.decode(file.read_bytes(), type=Result).rows
    quantities = {row.quantity for row in rows if row.subject == OURS}
    assert quantities == {"step", "rendering, frames cached", "rendering, frames not cached"}
    shares = [row.value for row in rows if row.quantity == "share of a step"]
    assert 0 < sum(shares) <= 1 and shares == sorted(shares, reverse=True)
    assert REPORTED in rows


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["rasteriser"], "unknown benchmark 'rasteriser'. Did you mean 'rasterizer'?"),
        (["rasterizer", "--gausians", "9"], "unknown option '--gausians'. Did you mean '--gaussians'?"),
        (["rasterizer", "--gaussians", "0"], "--gaussians: expected at least one number, none below 100, got 0"),
        (["rasterizer", "--sizes", "64", "8"], "--sizes: expected at least one number, none below 16, got 64 8"),
        (["step", "--repeats", "0"], "--repeats: expected at least one number, none below 1, got 0"),
        (["step", "--threads", "0"], "--threads: expected at least one number, none below 1, got 0"),
        (["step", "--preset", "papr"], "unknown preset of 'ours' 'papr'. Did you mean 'paper'?"),
        (["step", "--out", "/proc/nowhere/x.json"], "expected a folder that can be written"),
    ],
)
def test_bad_input_is_one_sentence(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str],
                                   tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", *words])
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "")
    assert sentence in err and len(err.strip().splitlines()) == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_bench_alone_tells_its_use(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench"])
    assert stop.value.code == 2
    assert "usage: rewild4d-bench bench rasterizer|step" in capsys.readouterr().out
