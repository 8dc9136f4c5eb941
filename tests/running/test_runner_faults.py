"""What goes wrong around a run: good records stay, killed processes are told, two commands do not collide."""

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import dying
import msgspec
import pytest
import torch
from one_case import OneCase
from records_for_tests import still

from rewild4d import registry
from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyConfig, PriorOnlyReconstruction
from rewild4d.cameras.rendering import render
from rewild4d.commands.shared import exit_code, require_writable
from rewild4d.errors import UserError
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.machine import code_of, code_version, package_sources
from rewild4d.metrics import weights
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.registry import load_method
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.running.provenance import FROM_TRUTH, marks
from rewild4d.running.rescoring import score_again
from rewild4d.running.workers import Threads, Workers
from rewild4d.types import Case

SETTINGS = PriorOnlyConfig(gaussians=500)


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case(frames=3)


@pytest.fixture
def plan(case: Case, tmp_path: Path) -> runner.Plan:
    save_prior(case.prior, tmp_path / "prior.npz")
    return runner.Plan(
        dataset="artemis", reader=OneCase(case), root=tmp_path, cases=(case.clip.name,),
        protocol=msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou")),
        entries=(runner.Entry("prior-only", "quick", SETTINGS, (0,)),),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD), device=torch.device("cpu"), out=tmp_path / "runs",
    )  # fmt: skip


def only_job(plan: runner.Plan) -> runner.Job:
    (job,) = runner.list_jobs(plan)
    return job


def test_a_prior_that_is_gone_fails_only_what_was_not_finished(
    plan: runner.Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = runner.execute(plan)
    more = runner.Entry("prior-only", "quick", PriorOnlyConfig(gaussians=501), (0,))

    def broken(*_: Any) -> None:
        raise FloatingPointError("the fit of the prior is not finite")

    monkeypatch.setattr(runner, "make_prior", broken)
    first, second = runner.execute(replace(plan, entries=(*plan.entries, more)))
    assert first == done[0]
    assert (second.status, second.error) == ("failed", "the fit of the prior is not finite")


def test_a_case_that_cannot_be_read_does_not_stop_the_others(
    plan: runner.Plan, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    load = plan.reader.load

    def partly(name: str, selection: Any) -> Any:
        if name == "broken":
            raise UserError("broken/masks: expected masks, got none.")
        return load(name, selection)

    monkeypatch.setattr(plan.reader, "load", partly)
    both = replace(plan, cases=("broken", *plan.cases))
    (record,) = runner.execute(both)
    assert record.status == "ok" and capsys.readouterr().err.startswith(
        "broken: left out: broken/masks: expected masks"
    )
    assert exit_code([both], [record]) == 2 and exit_code([plan], [record]) == 0
    assert capsys.readouterr().err == "1 of 2 cases cannot be read and have no rows: broken\n"
    with pytest.raises(UserError, match="broken/masks: expected masks, got none"):
        runner.execute(replace(plan, cases=("broken",)))


def test_the_record_says_how_closely_its_input_is_fitted(plan: runner.Plan, case: Case) -> None:
    (record,) = runner.execute(plan)
    made = load_method("prior-only").load(only_job(plan).folder / "reconstruction", torch.device("cpu"))
    grey = plan.protocol.background
    errors = []
    for frame in case.clip.frames:
        assert frame.camera is not None
        color, alpha = render(made.at(frame.time), frame.camera)
        errors.append(-10 * ((color + (1 - alpha) * grey - frame.over(grey)).square().mean()).log10())
    assert record.diagnostics["input_psnr_db"] == pytest.approx(float(torch.stack(errors).mean()), abs=1e-4)


def test_a_failure_never_takes_the_place_of_a_good_record(plan: runner.Plan, case: Case) -> None:
    (done,) = runner.execute(plan)
    job = only_job(plan)
    assert job.fail("work was removed") == done == job.record()


def test_what_another_process_has_finished_meanwhile_is_not_fitted_again(
    plan: runner.Plan, case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    (done,) = runner.execute(plan)
    monkeypatch.setattr(PriorOnly, "fit", lambda *_, **__: pytest.fail("fitted a finished run again"))
    assert only_job(plan).run(case, {}) == done


def test_a_killed_process_takes_only_its_own_piece_with_it() -> None:
    with Workers(2, Threads(1, 1), "numba") as workers:
        found = workers.map(dying.square, [(number, 2) for number in range(5)], lambda number, _: -number)
    assert found == [0, 1, -2, 9, 16]


def test_a_run_whose_process_was_killed_is_a_failed_record(plan: runner.Plan) -> None:
    plan = replace(plan, rasterizer="numba")
    record = runner.lost_part(plan, plan.cases[0], plan.entries[0], 0)
    assert (record.status, record.error) == ("failed", "the process ended: killed, perhaps for memory")
    assert only_job(plan).record() == record
    (again,) = runner.execute(plan)
    assert again.status == "ok"


def test_evaluate_makes_a_failed_record_whole(plan: runner.Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Marks, coverage, diagnostics and the time of the fit are those of a run that did not fail."""
    monkeypatch.setattr(PriorOnlyReconstruction, "marks", ("upper bound: it was told",), raising=False)
    monkeypatch.setattr(PriorOnlyReconstruction, "diagnostics", lambda self: {"gaussians": 500.0}, raising=False)
    (whole,) = runner.execute(plan)
    plan = replace(plan, out=plan.out.with_name("other"))

    def full(*_: Any) -> None:
        raise MemoryError("no memory left")

    with monkeypatch.context() as patch:
        patch.setattr("rewild4d.running.scoring.evaluate", full)
        (failed,) = runner.execute(plan)
    assert failed.status == "failed"
    monkeypatch.setattr("rewild4d.running.rescoring.load_dataset", lambda _: lambda _: plan.reader)
    # The command scores by the protocol of the package, which asks for more than this plan.
    monkeypatch.setattr("rewild4d.running.rescoring.find_protocol", lambda *_: plan.protocol)

    def slow(*given: Any) -> Any:
        time.sleep(0.02)  # the record counts hundredths of a second, and this case takes less
        return evaluate(*given)

    monkeypatch.setattr("rewild4d.running.scoring.evaluate", slow)
    folder = only_job(plan).folder
    renewed = score_again(folder)
    assert renewed.marks == ["upper bound: it was told"] and renewed.diagnostics["gaussians"] == 500.0
    assert still(renewed) == still(whole)
    assert renewed.timing.fit_seconds == round(runner.fit_seconds(folder), 2)
    assert renewed.timing.evaluate_seconds >= 0.02 and renewed.timing.peak_memory_mib > 0


def test_scores_that_lacked_a_network_are_made_once_it_is_there(
    plan: runner.Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scoring alone is repeated: the saved reconstruction is read back."""
    plan = replace(plan, protocol=msgspec.structs.replace(plan.protocol, scores=("psnr", "lpips_alex")))
    monkeypatch.setattr(weights, "search_folders", lambda: [tmp_path / "nets"])
    (without,) = runner.execute(plan)
    note = without.scores["lpips_alex"].note
    assert note == "not computed: weights missing, run: rewild4d-bench weights fetch"
    assert only_job(plan).finished()
    (tmp_path / "nets").mkdir()
    (tmp_path / "nets" / "lpips-vgg.safetensors").write_bytes(b"another network")
    assert only_job(plan).finished()
    (tmp_path / "nets" / "lpips-alex.safetensors").write_bytes(b"damaged")
    assert not only_job(plan).finished()
    monkeypatch.setattr(PriorOnly, "fit", lambda *_, **__: pytest.fail("fitted again"))
    assert runner.execute(plan) == [without], "what cannot be scored anew keeps its record"

    class Halves:
        digest = "d" * 64

        def __call__(self, prediction: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
            return torch.full((len(prediction),), 0.5, dtype=torch.float64)

    monkeypatch.setattr("rewild4d.metrics.features.Lpips", lambda *_, **__: Halves())
    (renewed,) = runner.execute(plan)
    assert renewed.scores["lpips_alex"].value == 0.5 and renewed.run_id == without.run_id
    assert only_job(plan).finished()


def test_two_commands_may_look_at_one_folder_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other one's look has taken the probe away already."""
    monkeypatch.setattr(Path, "touch", lambda self: None)
    require_writable(tmp_path / "runs")
    assert (tmp_path / "runs").is_dir()


def test_edited_sources_of_a_plugged_in_method_are_another_run(
    plan: runner.Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "theirs_for_a_test"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "network.py").write_text("LAYERS = 2\n")
    lines = ["from rewild4d.baselines.prior_only import PriorOnly", "class Mine(PriorOnly):", "    pass"]
    (package / "method.py").write_text("\n".join(lines) + "\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(registry.METHODS, "mine", "theirs_for_a_test.method:Mine")
    plan = replace(plan, entries=(runner.Entry("mine", "default", SETTINGS, (0,)),))
    ids = [only_job(plan).run_id, only_job(plan).run_id]
    (package / "network.py").write_text("LAYERS = 3\n")
    package_sources.cache_clear()  # a new process
    ids.append(only_job(plan).run_id)
    assert ids[0] == ids[1] != ids[2]
    assert set(code_of("mine")) == {"version", "sources", "method"}
    assert all(code_of(name) == code_version() for name in registry.METHODS if name != "mine"), "ours keep their ids"
    del sys.modules["theirs_for_a_test.method"], sys.modules["theirs_for_a_test"]


def test_a_prior_from_the_truth_is_a_mark_of_those_that_use_it() -> None:
    reconstruction: Any = object()
    assert marks("ours", "coarse:0.5", reconstruction) == marks("prior-only", "coarse", reconstruction) == [FROM_TRUTH]
    assert marks("gart-star", "coarse:0", reconstruction) == ["poses fitted once more to each input image", FROM_TRUTH]
    assert marks("empty", "coarse:0", reconstruction) == marks("ours", "template", reconstruction) == []
    assert marks("ours", "rig", reconstruction) == [FROM_TRUTH]
    assert marks("ours", "priors/coarse.npz", reconstruction) == []


def test_a_run_from_a_coarse_prior_says_so(plan: runner.Plan, case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "make_prior", lambda *_: case.prior)
    entries = (*plan.entries, runner.Entry("empty", "default", load_method("empty").Config(), (0,)))
    template, empty = runner.execute(replace(plan, entries=entries, prior=PriorChoice("coarse:0", STANDARD)))
    assert (template.marks, empty.marks) == ([FROM_TRUTH], [])
