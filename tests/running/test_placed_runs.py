"""Whole runs on films whose frames are used as they are: AiM without cameras, CoP3D with a camera for each frame."""

from pathlib import Path

import benchmark_films
import msgspec
import pytest
import torch
from films import TINY

from rewild4d.cameras.recropping import all_moments
from rewild4d.contracts import Selection
from rewild4d.datasets.aim.reader import Aim
from rewild4d.datasets.cop3d.reader import Cop3d
from rewild4d.evaluation.protocol import Protocol
from rewild4d.leaderboard.records import RunRecord
from rewild4d.priors import choose
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import QUICK
from rewild4d.registry import load_method
from rewild4d.running import runner

pytestmark = pytest.mark.usefixtures("cache")


SCORES = ("psnr", "psnr_fg", "iou")
"""Beside those of other papers."""


def run(
    reader: Aim | Cop3d, dataset: str, case: str, selection: Selection, out: Path, scores: tuple[str, ...]
) -> tuple[RunRecord, Path]:
    """Fit `prior-only` with 300 Gaussians from a prior of a step a stage; returns its record and folder."""
    protocol = Protocol(
        name=f"{dataset}-test-v1", dataset=dataset, title="", description="", background=0.0,
        scores=(*SCORES, *scores), floors=(), selection=selection,
    )  # fmt: skip
    config = msgspec.structs.replace(load_method("prior-only").Config(), gaussians=300)
    stages = tuple(msgspec.structs.replace(stage, steps=1, frames=3, size=24) for stage in QUICK.stages)
    config_of_prior = msgspec.structs.replace(QUICK, yaw_starts=4, stages=stages)
    prior = PriorChoice("template:quadruped", config_of_prior, getattr(reader, "keypoint_mapping", None), "all")
    plan = runner.Plan(
        dataset=dataset, reader=reader, root=out, cases=(case,), protocol=protocol,
        entries=(runner.Entry("prior-only", "quick", config, (0,)),), prior=prior, device=torch.device("cpu"), out=out,
    )  # fmt: skip
    (record,) = runner.execute(plan)
    folder = runner.run_folder(out, protocol.name, case, "prior-only", "quick", 0, record.run_id)
    assert record.status == "ok", record.error
    return record, folder


def test_a_film_of_aim_is_run_on_all_its_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "FOOTAGE", TINY)
    benchmark_films.aim(tmp_path / "data")
    selection = Selection(cameras="unknown", size=64, framing="full", split=(1, 0), mask_threshold=0.5)
    theirs = ("iou_pooled", "pck@0.1_mask_area_bones", "kt@0.1_mask_area", "psnr_pooled_white_brightness")
    record, folder = run(Aim(tmp_path / "data"), "aim", benchmark_films.TRACK, selection, tmp_path / "runs", theirs)
    assert {name: record.scores[name].note for name in theirs if record.scores[name].value is None} == {}
    assert len(record.items) == 8 and record.scores["psnr"].count == 8
    assert record.protocol["selection"]["mask_threshold"] == 0.5, "the threshold is recorded"
    assert (folder / "original.png").is_file(), "the animal is drawn where it was in the film"
    clip, truth = Aim(tmp_path / "data").load(benchmark_films.TRACK, selection)
    times = [frame.time for frame in all_moments(clip, truth).frames]
    assert times == pytest.approx([i / 10 for i in range(8)]), "pictures show each moment once"


def test_a_film_of_cop3d_is_scored_on_what_is_held_out(tmp_path: Path) -> None:
    root = benchmark_films.cop3d(tmp_path / "data")
    selection = Selection(cameras="known", size=48, framing="letterbox", split=(15, 5), frames=200, mask_threshold=0.7)
    record, _ = run(Cop3d(root), "cop3d", "dog/1_2_3", selection, tmp_path / "runs", ("iou@0.7", "psnrm"))
    assert record.scores["psnrm"].count == 5 and 0 < (record.scores["iou@0.7"].value or 0) < 1
    assert [item.split()[-2] for item in record.items] == [f"{i / 20:.4f}" for i in range(15, 20)]
    assert record.scores["iou"].count == 5
