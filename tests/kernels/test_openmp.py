"""torch's idle threads make room for the kernels, and come back when torch needs them."""

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest
import torch

from rewild4d.kernels import openmp
from rewild4d.kernels.threads import run

LARGE = torch.ones(1_000_000)
"""Long enough for torch to use all its threads."""


@pytest.fixture(autouse=True)
def two_threads_that_spin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def threads() -> Callable[[], int]:
    if not os.path.isdir("/proc/self/task") or openmp._pause() is None:
        pytest.skip("no list of this process's threads, or an OpenMP runtime that cannot let them go")
    return lambda: len(os.listdir("/proc/self/task"))


def settles(count: Callable[[], int], wanted: int) -> bool:
    """Whether the count becomes that within some seconds: threads end on their own."""
    for _ in range(300):
        if count() == wanted:
            return True
        time.sleep(0.01)
    return False


def test_threads_end_and_come_back(threads: Callable[[], int]) -> None:
    openmp.let_idle_threads_go()
    time.sleep(0.2)
    before = threads()
    LARGE + 1
    assert threads() == before + 1
    openmp.let_idle_threads_go()
    assert settles(threads, before)
    assert (LARGE * 2).sum() == 2 * len(LARGE)
    assert threads() == before + 1


def test_a_kernel_on_two_threads_lets_them_go_and_one_on_one_thread_does_not(threads: Callable[[], int]) -> None:
    run(lambda: None, [()] * 2)  # the kernels' own thread is there from now on
    time.sleep(0.2)
    before = threads()
    LARGE + 1
    run(lambda: None, [()])
    assert threads() == before + 1
    run(lambda: None, [()] * 2)
    assert settles(threads, before)


def test_threads_that_do_not_spin_stay(threads: Callable[[], int], monkeypatch: pytest.MonkeyPatch) -> None:
    LARGE + 1
    before = threads()
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    openmp.let_idle_threads_go()
    time.sleep(0.2)
    assert threads() == before


@pytest.mark.parametrize(("first", "policy"), [("rewild4d", "PASSIVE"), ("torch", "None")])
def test_the_policy_is_set_where_the_runtime_hears_it(first: str, policy: str) -> None:
    code = f"import {first}, rewild4d, os; print(os.environ.get('OMP_WAIT_POLICY'))"
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    made = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert made.stdout.strip() == policy


def _in_child(queue: "multiprocessing.Queue[bool]") -> None:
    run(lambda: None, [()] * 2)
    queue.put(openmp._forked and openmp._was_forked() == os.path.exists("/proc/self/stat"))


def test_a_forked_child_does_not_wait_for_threads_that_it_has_not() -> None:
    assert not openmp._was_forked()
    LARGE + 1
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_in_child, args=(queue,))
    child.start()
    try:
        assert queue.get(timeout=30)
    finally:
        child.kill()
        child.join()
