"""The kernel switch: off means off for every kernel, and an edited twin is never computed by the old kernel."""

import importlib
import importlib.util
import logging
import os
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from numba.core.registry import CPUDispatcher
from torch import nn

import rewild4d.ours.fused
import rewild4d.priors.fused
from rewild4d.benchmarks.scenes import training
from rewild4d.cli import main
from rewild4d.errors import UserError
from rewild4d.kernels import switch
from rewild4d.kernels.switch import (
    KERNELS,
    Kernel,
    choose_kernels,
    kernel_mode,
    source_digest,
    twin_digest,
    without_kernels,
)
from rewild4d.ours.canonical import Posed
from rewild4d.ours.config import Deform, Pose
from rewild4d.ours.deform import DeformNetwork
from rewild4d.ours.losses import regularizers
from rewild4d.ours.pose import PoseNetwork

for room in (rewild4d.ours.fused, rewild4d.priors.fused):
    for module in pkgutil.iter_modules(room.__path__, f"{room.__name__}."):
        importlib.import_module(module.name)
importlib.import_module("rewild4d.harmonics")


@pytest.fixture(autouse=True)
def mode(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Each test starts with fused kernels and forgets what it was told."""
    monkeypatch.setenv(switch.VARIABLE, "auto")
    switch._tell_layer.cache_clear()
    yield
    switch._verdict.cache_clear()


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_every_kernel_was_written_for_the_twins_that_are_here(name: str) -> None:
    kernel = KERNELS[name]
    found = twin_digest(kernel)
    hint = "compare kernel and twins (tests/**/*fused*.py), then write this digest beside the kernel"
    assert not kernel.twins or kernel.digest == found, f"{name}: {found}: {hint}"


def test_layout_comments_docstrings_and_annotations_do_not_count(tmp_path: Path) -> None:
    sources = [
        'def f(x: int) -> int:\n    """Add one."""\n    return x + 1  # one\n',
        "def f(x):\n    return (x +\n            1)\n",
        "def f(x):\n    return x + 2\n",
    ]
    digests = []
    for index, source in enumerate(sources):
        file = tmp_path / f"source_{index}.py"
        file.write_text(source)
        spec = importlib.util.spec_from_file_location(file.stem, file)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        digests.append(source_digest((module.f.__code__,)))
    assert digests[0] == digests[1] != digests[2] and all(digests)


def test_an_unknown_mode_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="unknown mode of --kernels 'touch'. Did you mean 'torch'?"):
        choose_kernels("touch")
    monkeypatch.setenv(switch.VARIABLE, "numba")
    with pytest.raises(UserError, match="REWILD4D_KERNELS: expected auto or torch, got 'numba'"):
        kernel_mode()


def test_torch_means_torch_for_every_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """With every compiled function of the training step broken, a step runs in torch and does not run fused."""
    step, index = training(32, 60, "quick")

    def broken(*_: Any) -> None:
        raise ZeroDivisionError

    for module in pkgutil.iter_modules(rewild4d.ours.fused.__path__, "rewild4d.ours.fused."):
        loaded = importlib.import_module(module.name)
        for name, value in vars(loaded).items():
            if isinstance(value, CPUDispatcher):
                monkeypatch.setattr(loaded, name, broken)
    with pytest.raises(ZeroDivisionError):
        step.step(index)
    monkeypatch.setenv(switch.VARIABLE, "torch")
    assert step.step(index)["loss"] > 0


def network() -> tuple[DeformNetwork, tuple[Any, ...]]:
    generator = torch.Generator().manual_seed(0)
    made = DeformNetwork(4, 8, Deform(width=32, heads=4), generator)
    posed = Posed(torch.rand(6, 3), torch.nn.functional.normalize(torch.rand(6, 4), dim=-1), torch.rand(6, 3))
    return made, (torch.rand(4, 8), torch.full((6, 4), 0.25), None, posed, 1.0)


def test_a_replaced_torch_body_is_never_ignored(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made, given = network()
    made(*given)

    def attend(self: DeformNetwork, query: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        raise ZeroDivisionError

    monkeypatch.setattr(DeformNetwork, "_attend", attend)
    with caplog.at_level(logging.WARNING), pytest.raises(ZeroDivisionError):
        made(*given)
    with pytest.raises(ZeroDivisionError):
        made(*given)
    assert [record.message.count("'deformation'") for record in caplog.records] == [1]  # told once
    assert "torch for deformation (edited)" in switch.describe_kernels()


def test_a_subclass_that_overrides_a_layer_gets_its_own_code() -> None:
    class Louder(DeformNetwork):
        def _attend(self, query: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
            raise ZeroDivisionError

    made, given = network()
    made(*given)
    made.__class__ = Louder
    with pytest.raises(ZeroDivisionError):
        made(*given)


def test_a_subclass_with_another_constructor_and_a_layer_put_in_later_are_seen(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Wider(PoseNetwork):
        def __init__(self, joints: int, config: Pose, generator: torch.Generator) -> None:
            super().__init__(joints, config, generator)
            self.norm = nn.Sequential(self.norm, nn.Tanh())  # type: ignore[assignment]

    made = [kind(5, Pose(width=32, heads=2), torch.Generator().manual_seed(0)) for kind in (PoseNetwork, Wider)]
    late = PoseNetwork(5, Pose(width=32, heads=2), torch.Generator().manual_seed(0))
    late.norm = made[1].norm
    code = torch.rand(2, 2 + 2 * Pose().frequencies)
    with caplog.at_level(logging.WARNING):
        plain, subclassed, changed = (network(code).features for network in (*made, late))
    assert torch.equal(subclassed, changed) and torch.allclose(plain.tanh(), changed, atol=1e-5)
    assert any("does not know layers of type Sequential" in record.message for record in caplog.records)


def test_one_kernel_can_be_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(regularizers, "compactness", broken)
    clouds, weights = (torch.rand(40, 3),), torch.full((40, 2), 0.5)
    with pytest.raises(ZeroDivisionError):
        regularizers.compact_loss(clouds, weights, 2.0)
    with without_kernels("compactness"):
        assert regularizers.compact_loss(clouds, weights, 2.0) > 0
    with pytest.raises(ZeroDivisionError):
        regularizers.compact_loss(clouds, weights, 2.0)


def test_children_get_the_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    choose_kernels("torch")
    assert os.environ[switch.VARIABLE] == "torch" and kernel_mode() == "torch"
    assert switch.chosen_kernels() == {"kernels": "torch"}
    choose_kernels("auto")
    assert switch.chosen_kernels() == {}


def test_a_kernel_without_source_is_taken_as_it_is() -> None:
    code = compile("def f(x):\n    return x\n", "<no file>", "exec").co_consts[0]
    assert source_digest((code,)) == ""
    lone = Kernel("lone", "0" * 12)
    assert lone.is_current() and KERNELS.pop("lone") is lone


def test_the_flag_is_checked_before_anything_is_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["run", "--kernels", "numba", "--data", "/nowhere"])
    assert stop.value.code == 2
    assert "unknown mode of --kernels 'numba'" in capsys.readouterr().err
    monkeypatch.setenv(switch.VARIABLE, "numba")
    with pytest.raises(SystemExit) as stop:
        main(["run", "--data", "/nowhere"])
    assert stop.value.code == 2 and "REWILD4D_KERNELS: expected auto or torch, got 'numba'" in capsys.readouterr().err
