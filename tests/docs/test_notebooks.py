"""The scripts of docs/notebooks run from start to end."""

import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


def run(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run a script in the repository's root and return its names."""
    monkeypatch.chdir(ROOT)
    return runpy.run_path(str(ROOT / "docs" / "notebooks" / name))


def test_first_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    found = run("first_fit.py", monkeypatch)
    prior, ours = (found["scores"][name]["value"] for name in ("prior-only", "ours"))
    assert prior["psnr"] > 15 and ours["psnr"] > 15
    assert found["images"]["ours"].shape == found["images"]["truth"].shape


def test_records(monkeypatch: pytest.MonkeyPatch) -> None:
    psnr = run("records.py", monkeypatch)["psnr"]
    means = psnr.groupby(["method", "case"]).value.mean().groupby("method").mean()
    assert means.idxmax() == "ours" and means["ours"] == pytest.approx(25.65, abs=0.005)  # docs/experiments/methods.md
