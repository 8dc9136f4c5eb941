"""The command `prior train`: wrong flags are told before anything starts, and what it writes is a prior of a run."""

from pathlib import Path

import numpy as np
import pytest
from calling import call, refusal

from rewild4d.priors.heading import examples as heading_examples
from rewild4d.priors.heading import training as heading_training
from rewild4d.priors.learned import examples, training


def test_wrong_numbers_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refusal(capsys, "prior", "train", "--out", tmp_path, "--rounds", 0)
    assert said == "rewild4d-bench: --rounds: expected 1 or more, got 0.\n"
    said = refusal(capsys, "prior", "train", "--out", tmp_path, "--workers", -1)
    assert said == "rewild4d-bench: --workers: expected 0 or more, got -1.\n"
    said = refusal(capsys, "prior", "train", "--out", tmp_path, "--two-legged", 1.5)
    assert said == "rewild4d-bench: --two-legged: expected a share from 0 to 1, got 1.5.\n"
    said = refusal(capsys, "prior", "train", "--out", tmp_path, "--part", "shapes", "--start", tmp_path / "a")
    assert said == "rewild4d-bench: --start: expected with --part headings alone, got --part shapes.\n"
    said = refusal(capsys, "prior", "train", "--out", tmp_path, "--start", tmp_path / "a")
    assert said.startswith(f"rewild4d-bench: {tmp_path / 'a'}: expected weights of the learned prior")
    (tmp_path / "file").write_text("")
    assert "expected a folder that can be written" in refusal(
        capsys, "prior", "train", "--out", tmp_path / "file" / "a"
    )


def test_a_prior_of_something_else_than_the_clip_is_no_fit(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    flags = ("--frames", tmp_path, "--out", tmp_path / "p.npz", "--prior", "rig")
    said = refusal(capsys, "prior", "fit", *flags)
    assert said == "rewild4d-bench: --prior rig: expected template, template:<which>, masks or learned:<weights>.\n"


def test_it_trains_the_network_of_headings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module, name, value in (
        (heading_training, "BATCH", 4),
        (heading_examples, "SEQUENCES", 2),
        (heading_examples, "FRAMES", 2),
    ):
        monkeypatch.setattr(module, name, value)
    assert call("prior", "train", "--out", tmp_path, "--animals", 1, "--epochs", 1, "--workers", 0) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("epoch 1  loss ") and lines[1] == str(tmp_path / "weights.safetensors")
    files = {file.name for file in tmp_path.iterdir()}
    assert files == {"checkpoint.pt", "curve.json", "pictures", "weights.safetensors"}


def test_it_writes_weights_and_a_curve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in (("ANIMALS", 1), ("CHECKED", 2), ("BATCH", 2)):
        monkeypatch.setattr(training, name, value)
    monkeypatch.setattr(training, "draw_sequences", lambda rng: examples.draw_sequences(rng, 2, 4))
    assert call("prior", "train", "--out", tmp_path, "--part", "points", "--rounds", 1, "--workers", 0) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("round 1  seconds ") and lines[1] == str(tmp_path / "weights.safetensors")
    assert {file.name for file in tmp_path.iterdir()} == {"checkpoint.pt", "curve.json", "weights.safetensors"}
    assert np.isfinite([float(word) for word in lines[0].split()[1::2]]).all()
