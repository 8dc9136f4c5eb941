"""Runs on the workers of a Dask cluster: none is lost, none is made twice, and failures are told apart."""

import multiprocessing
import os
import signal
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import sleeping
from sleeping import Crowd, Nap, crowd_plan, told

from rewild4d.errors import UserError
from rewild4d.kernels.switch import kernel_mode
from rewild4d.leaderboard.records import FILE, RunRecord
from rewild4d.registry import plugged_in
from rewild4d.running import parts, remote
from rewild4d.running.cluster import Site
from rewild4d.running.parts import Terms, Unfit, list_parts, make_part, scratch_folder
from rewild4d.running.remote import execute_remotely
from rewild4d.running.runner import Plan
from rewild4d.running.status import read_boards

distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
pytestmark = pytest.mark.skipif(not hasattr(os, "killpg"), reason="Windows cannot kill with SIGKILL")
RETRIES = 1


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A data set of six cases, and the packages of the stub on the path of all processes."""
    site = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        data = sleeping.install(site, cases=6)
        plugged_in.cache_clear()
        yield data
    plugged_in.cache_clear()


@pytest.fixture(scope="module")
def scheduler(crowd: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler with two workers, each a process with one thread."""
    import dask

    settings = {
        "distributed.scheduler.allowed-failures": RETRIES,
        "distributed.worker.multiprocessing-method": "forkserver",  # a new worker has imported all that takes seconds
    }
    multiprocessing.get_context("forkserver").set_forkserver_preload(["distributed", "rewild4d.running.parts"])
    scratch = str(tmp_path_factory.mktemp("scratch"))
    with (
        mock.patch("distributed.utils._forkserver_preload_set", True),
        dask.config.set(settings),
        distributed.LocalCluster(
            2, threads_per_worker=1, memory_limit=0, dashboard_address=None, local_directory=scratch,
            silence_logs=60,
        ) as cluster,
    ):  # fmt: skip
        yield cluster.scheduler_address


def run(plan: Plan, scheduler: str, records: parts.Records = "shared") -> list[RunRecord]:
    return execute_remotely([plan], Site(records, scheduler), "crowd")


def kill_one(out: Path, begun: int) -> list[str]:
    """Kill the worker of the fit that began as the given one, once it has a checkpoint; return what it had told."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        begins = [line for line in told(out) if line[0] == "begin"]
        if len(begins) >= begun and list(out.glob(f"*/{begins[begun - 1][1].replace('/', '__')}/*/work/checkpoint.pt")):
            os.kill(int(begins[begun - 1][4]), signal.SIGKILL)
            return begins[begun - 1]
        time.sleep(0.01)
    pytest.fail("no fit had begun")


def test_killed_workers_lose_no_run_and_double_none(crowd: Path, scheduler: str, tmp_path: Path) -> None:
    plan = crowd_plan(crowd, tmp_path / "runs", Nap(steps=20))
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(run, plan, scheduler)
        killed = kill_one(plan.out, begun=1)
        records = made.result(timeout=120)
    assert [(record.case, record.status) for record in records] == [(f"crowd/{n:03d}", "ok") for n in range(6)]
    lines = told(plan.out)
    ended = Counter(case for what, case, *_ in lines if what == "end")
    assert ended == dict.fromkeys(plan.cases, 1), "each fit came to its end once"
    begun = [(case, int(step)) for what, case, _, step, _ in lines if what == "begin"]
    assert len(begun) == 6 + 1, "only the killed one began again"
    assert [step > 0 for case, step in begun if case == killed[1]] == [False, True], "from its checkpoint"
    assert not list(plan.out.rglob("work"))


def test_a_run_that_kills_its_workers_is_given_up_and_one_that_fails_by_itself_is_not_repeated(
    crowd: Path, scheduler: str, tmp_path: Path
) -> None:
    config = Nap(broken=("crowd/001",), deadly=("crowd/002",))
    plan = replace(crowd_plan(crowd, tmp_path / "runs", config), cases=("crowd/001", "crowd/002", "crowd/003"))
    broken, deadly, good = run(plan, scheduler)
    begun = Counter(case for what, case, *_ in told(plan.out) if what == "begin")
    assert begun == {"crowd/001": 1, "crowd/002": 1 + RETRIES, "crowd/003": 1}
    assert (broken.status, broken.error) == ("failed", "crowd/001: expected a quiet night, got none.")
    assert (deadly.status, good.status) == ("failed", "ok")
    assert deadly.error.startswith(f"its worker was lost {1 + RETRIES} times: killed, perhaps for memory")
    (board,) = read_boards(plan.out)
    assert [run.state for run in board.runs] == ["failed", "failed", "done"]
    assert board.live is not None and board.live.ended == "finished"


def test_two_clients_at_once_and_one_afterwards_make_nothing_twice(crowd: Path, scheduler: str, tmp_path: Path) -> None:
    plan = crowd_plan(crowd, tmp_path / "runs", seeds=(0, 1))
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: run(plan, scheduler), range(2))
    assert first == second == run(plan, scheduler)
    assert Counter(what for what, *_ in told(plan.out)) == {"begin": 12, "end": 12}


def test_runs_are_brought_back_where_no_folder_is_shared(crowd: Path, scheduler: str, tmp_path: Path) -> None:
    plan = crowd_plan(crowd, tmp_path / "runs", Nap(broken=("crowd/001",)))
    plan = replace(plan, cases=("crowd/000", "crowd/001"))
    good, broken = run(plan, scheduler, "returned")
    assert (good.status, broken.status) == ("ok", "failed")
    here = {path.relative_to(plan.out).parts[3:] for path in plan.out.glob("crowd-32-v1/**/*") if path.is_file()}
    assert here == {(FILE,), ("log.jsonl",), ("fit.json",), ("comparison.txt",), ("reconstruction", "asleep.txt")}
    assert not told(plan.out), "workers write into folders of their own"
    assert run(plan, scheduler, "returned")[0] == good


def test_a_prior_that_a_worker_has_made_is_brought_back(crowd: Path, scheduler: str, tmp_path: Path) -> None:
    plan = replace(crowd_plan(crowd, tmp_path / "runs"), cases=("crowd/000",))
    (part,) = list_parts(plan)
    part.prior.unlink()
    with distributed.Client(scheduler, set_as_default=False) as client:
        folders = client.run(lambda dask_worker: dask_worker.local_directory).values()
    made = scratch_folder(Path(next(iter(folders))), plan.out) / "priors" / part.prior.name
    made.parent.mkdir(parents=True)
    made.write_bytes((crowd / "prior.npz").read_bytes())
    assert run(plan, scheduler, "returned")[0].status == "ok"
    assert part.prior.read_bytes() == made.read_bytes()


def test_a_worker_with_other_code_is_told_before_anything_is_made(
    crowd: Path, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = crowd_plan(crowd, tmp_path / "runs")
    monkeypatch.setattr(parts, "code_of", lambda _: {"version": "0", "sources": "other"})
    with pytest.raises(UserError, match="^worker on .*: expected the code of the command that plans .version 0, sour"):
        run(plan, scheduler)
    assert not list(plan.out.rglob(FILE)) and not told(plan.out)


def test_a_worker_without_the_folder_or_the_data_is_told(crowd: Path, tmp_path: Path) -> None:
    (part, *_), absent = list_parts(crowd_plan(crowd, tmp_path / "runs")), tmp_path / "absent.plan.json"
    with pytest.raises(Unfit, match="absent.plan.json: the folder of runs is not shared with it; try --records return"):
        make_part(part, Terms("shared", absent, kernel_mode(), tmp_path))
    absent.touch()
    gone = Crowd(crowd)
    gone.root = tmp_path / "elsewhere"
    with pytest.raises(Unfit, match="worker on .*: .*elsewhere: expected a crowd, but it is gone"):
        make_part(replace(part, plan=replace(part.plan, reader=gone)), Terms("shared", absent, "auto", tmp_path))
    with pytest.raises(Unfit, match="seed 0 to be run 0000, got [0-9a-f]{16}: its data, or a file that the"):
        make_part(replace(part, run_id="0000"), Terms("shared", absent, "auto", tmp_path))


def test_what_is_done_needs_no_cluster(crowd: Path, scheduler: str, tmp_path: Path,
                                       monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    plan = replace(crowd_plan(crowd, tmp_path / "runs"), cases=("crowd/000",))
    made = run(plan, scheduler)
    monkeypatch.setattr(remote, "connected", lambda *_: pytest.fail("started a cluster for nothing"))
    assert run(plan, scheduler) == made


def test_a_scheduler_that_does_not_answer_is_a_sentence(crowd: Path, tmp_path: Path,
                                                        monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.setattr("rewild4d.running.cluster.PATIENCE", "100ms")
    with pytest.raises(UserError, match="^--scheduler tcp://127.0.0.1:9: expected a Dask scheduler, but none answers"):
        run(crowd_plan(crowd, tmp_path / "runs"), "tcp://127.0.0.1:9")
    with pytest.raises(UserError, match="^--scheduler nowhere://: expected a Dask scheduler, but none answers: "):
        run(crowd_plan(crowd, tmp_path / "runs"), "nowhere://")
    assert not (tmp_path / "runs" / "plans").exists()
