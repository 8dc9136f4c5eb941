"""The runner: records, resume, failures that are records, and methods that never see what is held out."""

import multiprocessing
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from one_case import OneCase
from records_for_tests import still

from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyConfig
from rewild4d.errors import UserError
from rewild4d.evaluation.coverage import coverage, visible
from rewild4d.evaluation.protocol import NovelViews, find_protocol
from rewild4d.leaderboard.records import FILE
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.rasterizer.backends import resolve
from rewild4d.registry import load_method
from rewild4d.running import runner
from rewild4d.running.conformance import check_method, tiny_case
from rewild4d.running.rescoring import score_again
from rewild4d.running.workers import Threads, share_cores, start_worker
from rewild4d.types import Camera, Case, Truth

SETTINGS = PriorOnlyConfig(gaussians=2000)


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


@pytest.fixture
def plan(case: Case, tmp_path: Path) -> runner.Plan:
    save_prior(case.prior, tmp_path / "prior.npz")
    return runner.Plan(
        dataset="artemis",
        reader=OneCase(case),
        root=tmp_path,
        cases=(case.clip.name,),
        protocol=find_protocol("artemis", None),
        entries=(runner.Entry("empty", "default", load_method("empty").Config(), (0,)),
                 runner.Entry("prior-only", "quick", SETTINGS, (0, 1))),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD),
        device=torch.device("cpu"),
        out=tmp_path / "runs",
    )  # fmt: skip


def test_a_run_scores_the_exact_prior_well(plan: runner.Plan) -> None:
    empty, first, second = runner.execute(plan)
    assert [r.status for r in (empty, first, second)] == ["ok"] * 3
    assert empty.scores["iou"].value == 0.0
    psnr, floor = first.scores["psnr"].value, empty.scores["psnr"].value
    assert psnr is not None and floor is not None and psnr > floor + 10
    assert (first.scores["iou"].value or 0) > 0.9
    assert len(first.items) == first.scores["psnr"].count == len(first.scores["psnr"].per_item) == 4
    assert first.run_id != second.run_id
    for name in first.pictures:
        folder = next(plan.out.rglob(f"prior-only-quick-seed0-{first.run_id[:8]}"))
        assert (folder / name).stat().st_size > 500


def test_two_runs_with_one_seed_give_equal_records(plan: runner.Plan, tmp_path: Path) -> None:
    once = runner.execute(plan)
    again = runner.execute(replace(plan, out=tmp_path / "other"))
    assert [still(r) for r in once] == [still(r) for r in again]


def test_finished_runs_are_skipped(plan: runner.Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    once = runner.execute(plan)
    monkeypatch.setattr(PriorOnly, "fit", lambda *_, **__: pytest.fail("fitted a finished run again"))
    assert runner.execute(plan) == once


def test_where_sets_are_scored_floors_run_beside_the_one_fit(
    plan: runner.Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scoring sets of novel views takes minutes of every row; without them one fit needs no second process."""

    def start(jobs: int, *_: object) -> None:
        raise RuntimeError(f"{jobs} processes")

    monkeypatch.setattr(runner, "Workers", start)
    plain = msgspec.structs.replace(plan.protocol, floors=("empty",))
    entries = (plan.entries[0], replace(plan.entries[1], seeds=(0,)))
    assert len(runner.execute(replace(plan, protocol=plain, entries=entries, jobs=4))) == 2
    sets = msgspec.structs.replace(plain, novel=NovelViews(frames=2, clip=2, stride=1))
    with pytest.raises(RuntimeError, match="2 processes"):
        runner.execute(replace(plan, protocol=sets, entries=entries, jobs=4))


def test_a_run_killed_while_scoring_is_not_fitted_again(plan: runner.Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    once = runner.execute(plan)
    for record in plan.out.rglob(FILE):
        record.unlink()
    monkeypatch.setattr(PriorOnly, "fit", lambda *_, **__: pytest.fail("fitted again"))
    assert [still(r) for r in runner.execute(plan)] == [still(r) for r in once]


def test_a_failure_is_a_record_and_is_tried_again(plan: runner.Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise FloatingPointError("iteration 7: the loss is not finite")

    with monkeypatch.context() as patch:
        patch.setattr(PriorOnly, "fit", broken)
        failed = runner.execute(plan)
    assert [r.status for r in failed] == ["ok", "failed", "failed"]
    assert failed[1].error == "FloatingPointError: iteration 7: the loss is not finite"
    assert failed[1].scores == {}
    assert [r.status for r in runner.execute(plan)] == ["ok"] * 3


def test_other_settings_are_another_run(plan: runner.Plan) -> None:
    first = runner.execute(plan)[1]
    entry = runner.Entry("prior-only", "quick", PriorOnlyConfig(gaussians=2001), (0,))
    assert runner.execute(replace(plan, entries=(entry,)))[0].run_id != first.run_id


def test_the_rasterizer_is_named_and_another_one_is_another_run(plan: runner.Plan) -> None:
    plan = replace(plan, entries=plan.entries[:1])
    made = [runner.execute(replace(plan, rasterizer=name))[0] for name in ("auto", "numba", "reference", "auto")]
    assert [record.machine["rasterizer"] for record in made] == ["numba", "numba", "reference", "numba"]
    assert made[0] == made[1] == made[3] and made[0].run_id != made[2].run_id
    assert made[2].status == "ok"


@pytest.mark.parametrize(
    ("cores", "threads", "fits", "device", "kernels"),
    [(2, 1, 1, "cpu", 2), (2, 1, 2, "cpu", 1), (8, 1, 3, "cpu", 8 // 3), (64, 1, 1, "cpu", 4), (2, 1, 0, "cpu", 2),
     (2, 3, 2, "cpu", 3), (8, 1, 1, "cuda", 1)],
)  # fmt: skip
def test_kernels_take_the_cores_that_no_fit_needs(
    cores: int, threads: int, fits: int, device: str, kernels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert share_cores(threads, fits, torch.device(device)) == Threads(threads, kernels)


def test_worker_processes_render_with_the_rasterizer_of_the_plan() -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, start_worker, (Threads(1, 1), "reference")) as pool:
        assert pool.submit(resolve, "auto", torch.device("cpu"), torch.float32).result() == "reference"


def test_methods_get_the_clip_and_nothing_that_is_held_out(plan: runner.Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    fit = PriorOnly.fit

    def spy(self: PriorOnly, *given: Any, **named: Any) -> Any:
        seen.extend([*given, *named.values()])
        return fit(self, *given, **named)

    monkeypatch.setattr(PriorOnly, "fit", spy)
    runner.execute(plan)
    assert seen and not any(isinstance(value, Truth | Case) for value in seen)


def test_evaluate_gives_the_same_scores(plan: runner.Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    record = runner.execute(plan)[1]
    folder = next(plan.out.rglob(f"prior-only-quick-seed0-{record.run_id[:8]}"))
    monkeypatch.setattr("rewild4d.running.rescoring.load_dataset", lambda _: lambda _: plan.reader)
    assert still(score_again(folder)) == still(record)
    state = folder / "reconstruction" / "surface.pt"
    for data in (state.read_bytes()[: state.stat().st_size // 2], b"text"):
        state.write_bytes(data)
        with pytest.raises(UserError, match="surface.pt: expected a saved reconstruction, but it is cut off or"):
            score_again(folder)
    shutil.rmtree(folder / "reconstruction")
    with pytest.raises(UserError, match="reconstruction: expected a saved reconstruction, but there is no such folder"):
        score_again(folder)


def test_unknown_case_has_a_suggestion() -> None:
    assert runner.choose_cases(["wolf/Run", "wolf/Walk", "cat/run"], ["wolf/*"]) == ("wolf/Run", "wolf/Walk")
    with pytest.raises(UserError, match="unknown case 'wolf/run'. Did you mean 'wolf/Run'"):
        runner.choose_cases(["wolf/Run", "wolf/Walk"], ["wolf/run"])


@pytest.mark.parametrize("name", ["empty", "prior-only"])
def test_floors_keep_the_contract(name: str) -> None:
    assert [finding.message for finding in check_method(name, "quick")] == ["kept"] * 5


def test_coverage_of_a_two_sided_wall() -> None:
    """Points on two parallel squares: a camera in front sees the front one only, half of a side view's evidence."""
    grid = torch.linspace(-1, 1, 40, dtype=torch.float64)
    x, y = (a.flatten() for a in torch.meshgrid(grid, grid, indexing="ij"))
    wall = torch.cat([torch.stack((x, y, torch.full_like(x, depth)), dim=-1) for depth in (5.0, 6.0)])
    intrinsics = torch.tensor(((50.0, 0, 32), (0, 50, 32), (0, 0, 1)), dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), intrinsics, 64, 64)
    shown = visible(wall, camera)
    assert shown[:1600].all()
    assert not shown[1600:].any()


def test_coverage_without_geometry_has_only_the_foreground(case: Case) -> None:
    found = coverage(case.clip, case.truth)
    assert set(found) == {"foreground"}
    assert 0 < found["foreground"] < 0.5
