"""`definitions` on a saved run, as a person calls it."""

import json
from dataclasses import replace
from pathlib import Path

import moving
import msgspec
import pytest
import torch
from calling import call, output, refusal
from films import PROTOCOL, SELECTION
from prior_files import a_prior
from records_for_tests import record

from rewild4d.baselines.floors_config import PriorOnlyConfig
from rewild4d.baselines.prior_only import PriorOnly
from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.leaderboard.records import write_record
from rewild4d.metrics.definitions import KEYPOINT_SOURCES, KEYPOINTS, TRANSFER
from rewild4d.priors.bodies.tetrapod import PARENTS

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def run(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A saved run of the standing template on a film with keypoints."""
    protocol = msgspec.structs.replace(PROTOCOL, dataset="aptv2")
    monkeypatch.setattr("rewild4d.evaluation.protocol.load_protocols", lambda: {protocol.name: protocol})
    case = "easy/29wolf/v1C1@3"
    clip, _ = AptV2(moving.apt(tmp_path / "data", keypoints=[20, 30, 2] * 17)).load(case, SELECTION)
    still = replace(
        a_prior([1.5] * 10, [1.5] * 10), times=torch.tensor(clip.times).double(), parents=torch.tensor(PARENTS)
    )
    made = PriorOnly().fit(clip, still, config=PriorOnlyConfig(gaussians=300), seed=0, device=torch.device("cpu"),
                           log=lambda *_: None, workdir=None)  # fmt: skip
    folder = tmp_path / "runs" / "one"
    (folder / "reconstruction").mkdir(parents=True)
    made.save(folder / "reconstruction")
    found = record(method="prior-only", dataset="aptv2", case=case, data={"root": str(tmp_path / "data")},
                   protocol=msgspec.to_builtins(protocol))  # fmt: skip
    write_record(found, folder)
    return folder


def test_the_command_prints_both_tables_of_a_saved_run_and_leaves_its_record(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (run / "record.json").read_bytes()
    told = output(capsys, "definitions", run)
    assert "**prior-only (quick, seed 0) on aptv2 easy/29wolf/v1C1@3: keypoints**" in told and ": images**" in told
    assert "12 frames of 64x64 pixels, squares that follow the animal" in told and "10 were shown to the method" in told
    rows = json.loads(output(capsys, "definitions", run, "--keypoints", "--json", "--frames", "held-out"))
    assert {row["name"] for row in rows} == {*TRANSFER, *(f"{n}_{s}" for n in KEYPOINTS for s in KEYPOINT_SOURCES)}
    assert all(
        row["source"] and row["rule"] and (row["value"] is None) == ("not computed" in row["note"]) for row in rows
    )
    assert output(capsys, "definitions", run, "--keypoints", "--format", "csv").startswith("definition,keypoints from,")
    assert (run / "record.json").read_bytes() == before


def test_wrong_words_of_the_command_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "expected the folder of one run, got 0 of them" in refusal(capsys, "definitions")
    assert "unknown format 'mdx'. Did you mean 'md'?" in refusal(capsys, "definitions", tmp_path, "--format", "mdx")
    assert "unknown keypoint mapping 'badga'" in refusal(capsys, "definitions", tmp_path, "--mapping", "badga")
    assert str(tmp_path) in refusal(capsys, "definitions", tmp_path)
    assert call("definitions", "--frames", "some", tmp_path) == 2
