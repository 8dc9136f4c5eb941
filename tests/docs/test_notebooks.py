"""The scripts of docs/notebooks run from start to end."""

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


def run(name: str, monkeypatch: pytest.MonkeyPatch, cache: Path) -> dict[str, Any]:
    """Run a script in the repository's root, with a cache of its own, and return its names."""
    monkeypatch.setenv("REWILD4D_CACHE", str(cache))
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return runpy.run_path(str(ROOT / "docs" / "notebooks" / name))


def test_first_fit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = run("first_fit.py", monkeypatch, tmp_path)
    prior, ours = (found["scores"][name]["value"] for name in ("prior-only", "ours"))
    assert prior["psnr"] > 15 and ours["psnr"] > 15
    assert found["images"]["ours"].shape == found["images"]["truth"].shape


def test_records(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    psnr = run("records.py", monkeypatch, tmp_path)["psnr"]
    means = psnr.groupby(["method", "case"]).value.mean().groupby("method").mean()
    assert means.idxmax() == "ours" and means["ours"] == pytest.approx(25.65, abs=0.005)  # docs/experiments/methods.md
