"""Recorded steps: on the CPU a recorder stands in that repeats the calls on the same tensors; on a GPU the real one."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import msgspec
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from rewild4d.config import load_preset
from rewild4d.kernels.switch import VARIABLE
from rewild4d.ours import fit
from rewild4d.ours.config import Config, Density
from rewild4d.ours.fit import Training
from rewild4d.ours.graphs import CudaRecorder, StepGraphs
from rewild4d.ours.inputs import StepInput
from rewild4d.ours.losses import regularizers
from rewild4d.ours.losses.config import Geometry
from rewild4d.ours.model import build_model
from rewild4d.ours.slots import Kind, Slots
from rewild4d.ours.symmetry import Supervision
from rewild4d.rasterizer import RasterInfo, set_default
from rewild4d.running.conformance import tiny_case

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
STEPS = 40
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")


class Repeats:
    """In the place of `CudaRecorder`: what it records is the call itself."""

    def __init__(self) -> None:
        self.recorded = 0

    def stream(self) -> Any:
        return nullcontext()

    def record(self, *calls: Callable[[], None]) -> tuple[Callable[[], None], ...]:
        self.recorded += 1
        return calls


def short(preset: str, **changes: Any) -> Config:
    """A preset with few and small steps in which all of its losses act, with a change of density in the middle."""
    config = load_preset("ours", Config, preset)
    geometry = msgspec.structs.replace(config.geometry, smooth_size=32)
    density = Density(start=0.2, end=0.6, every=0.3, gradient=0.0, cap=400)
    canonical = msgspec.structs.replace(config.canonical, samples=300, sh_every=0.3)
    made = msgspec.structs.replace(
        config, image_size=48, iterations=STEPS, canonical=canonical, geometry=geometry, density=density,
        skinning=msgspec.structs.replace(config.skinning, resolution=8),
        deform=msgspec.structs.replace(config.deform, sampled=0, half=False),
    )  # fmt: skip
    return msgspec.structs.replace(made, **changes)


def training(config: Config, device: torch.device = CPU) -> Training:
    case, generator = tiny_case(), torch.Generator().manual_seed(0)
    supervision = Supervision(case.clip, case.prior, config.image_size, device, config.loss.mean_over)
    model = build_model(config, case.prior, generator, supervision.frame_times()).to(device)
    return Training(model, supervision, config, generator)


def film(config: Config) -> Config:
    """With blended poses and the pull, as films have them."""
    prior = msgspec.structs.replace(config.prior, blend=True, blend_until=0.5, pull=1.0, pull_until=0.7)
    return msgspec.structs.replace(config, prior=prior, geometry=Geometry(smooth_size=32))


def turning(config: Config) -> Config:
    """With turns of each frame's joints, and poses that mirror images share."""
    return msgspec.structs.replace(
        config, pose=msgspec.structs.replace(config.pose, turns=True, turns_from=0.2, tied=True)
    )


CONFIGS = {
    "paper": short("paper"),
    "standard": short("standard"),
    "film": film(short("paper")),
    "turns": turning(short("standard")),
}


@pytest.fixture
def torch_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU runs the twins."""
    monkeypatch.setenv(VARIABLE, "torch")


@pytest.mark.parametrize("name", CONFIGS)
def test_recorded_steps_are_the_plain_ones(name: str, torch_alone: None) -> None:
    plain, recorded = training(CONFIGS[name]), training(CONFIGS[name])
    recorder = Repeats()
    recorded.graphs = StepGraphs(recorded, recorder)
    for index in range(STEPS):
        wanted, found = plain.step(index), recorded.step(index)
        assert wanted.keys() == found.keys()
        # Gradients are clipped in another order: rounding that 40 steps of Adam carry on, 1e-4 on some CPUs.
        assert all(found[key] == pytest.approx(value, rel=1e-3, abs=1e-6) for key, value in wanted.items()), index
    assert recorder.recorded >= 2 and len(plain.gaussians) > 300, "no graph, or no change of density"
    for (key, wanted), found in zip(plain.model.named_parameters(), recorded.model.parameters(), strict=True):
        assert (wanted - found).detach().norm() <= 1e-2 * wanted.detach().norm() + 1e-6, key


def test_a_kind_is_run_once_before_it_is_recorded_and_again_after_a_change_of_density(torch_alone: None) -> None:
    made, recorder = training(CONFIGS["paper"]), Repeats()
    made.graphs = StepGraphs(made, recorder)
    counts = []
    for index in range(STEPS):
        made.step(index)
        counts.append(recorder.recorded)
    assert counts[:3] == [0, 1, 1]
    rounds = [index for index in range(1, STEPS) if made.density.config.start * STEPS <= index and index % 12 == 0]
    assert counts[rounds[0]] == counts[rounds[0] - 1] < counts[rounds[0] + 1], "recorded without a run"


@pytest.mark.parametrize("flaw", ["short", "not finite"])
def test_a_graph_that_fails_is_followed_by_a_plain_step(
    flaw: str, torch_alone: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, recorder = training(CONFIGS["paper"]), Repeats()
    made.graphs = StepGraphs(made, recorder)
    for index in range(3):
        made.step(index)
    (step,) = made.graphs.steps.values()
    compute, follow = step.replays

    def spoilt() -> None:
        compute()
        step.status[-1 if flaw == "short" else -2] = flaw == "short"

    step.replays = spoilt, follow
    before = made.optimizer.state[made.gaussians.means]["step"].clone()
    made.step(3)
    assert made.optimizer.state[made.gaussians.means]["step"] == before + 1, "followed twice or never"
    assert not made.graphs.steps[next(iter(made.graphs.steps))].replays


def test_what_cannot_be_recorded_is_run_and_told_once(torch_alone: None, caplog: pytest.LogCaptureFixture) -> None:
    class Refuses(Repeats):
        def record(self, *calls: Callable[[], None]) -> tuple[Callable[[], None], ...]:
            raise RuntimeError("operation not permitted when stream is capturing")

    plain, made = training(CONFIGS["paper"]), training(CONFIGS["paper"])
    made.graphs = StepGraphs(made, Refuses())
    for index in range(4):
        assert plain.step(index)["loss"] == pytest.approx(made.step(index)["loss"], rel=1e-4)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "not recorded as CUDA graphs and take longer: operation not permitted" in caplog.text


class NoLook(TorchDispatchMode):
    """Refuse what copies numbers between the CPU and a device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        tensors = [each for each in args if isinstance(each, Tensor)]
        if name in ("_local_scalar_dense", "nonzero", "lift_fresh"):
            raise AssertionError(f"{name} waits for the device")
        if name in ("_to_copy", "copy_") and len({each.device for each in tensors} | kinds(kwargs)) > 1:
            raise AssertionError(f"{name} between devices")
        return func(*args, **(kwargs or {}))


def kinds(kwargs: dict[str, Any] | None) -> set[torch.device]:
    device = (kwargs or {}).get("device")
    return set() if device is None else {torch.device(device)}


def stub(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, *rest: Any) -> Any:
    """Any image that depends on all, without values."""
    width, height = rest[2:4]
    total = sum(part.sum() for part in (means, quats, scales, opacities, *rest[:2]))
    image = (features.sum(0) + total)[None, :, None, None].expand(1, -1, height, width)
    alpha = total.expand(1, 1, height, width)
    return image, alpha, RasterInfo(scales.detach().sum(1)[None], means[None, :, :2] * 1.0)


@pytest.mark.parametrize("name", CONFIGS)
def test_losses_and_gradients_look_at_no_number(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the device without values, where a look is an error; a second time, when constants are there."""
    for module in (fit, regularizers):
        monkeypatch.setattr(module, "rasterize", stub)
    made = training(CONFIGS[name])
    made.prepare()
    given = made.drawn_input(4)
    meta = torch.device("meta")
    made.near = None if made.near is None else made.near.to(meta)
    own = made.model.to(meta)
    parts = {"skinning": own.field, "pose": own.network, "deform": own.deform}
    made.groups = {group: list(part.parameters()) for group, part in parts.items()}
    slots = Slots(given, 4, meta)
    size = given.target.camera.width, given.target.camera.height
    slots.images[size] = given.target.rgb.to(meta), given.target.mask.to(meta)
    for mode in (nullcontext(), NoLook()):
        with mode:
            losses, _ = made.losses_of(slots.input(Kind.of(given, True)))
            made.backward(torch.stack(list(losses.values())))
            made.limited()
    assert {"tv", "smooth", "compact"} <= losses.keys()


def test_slots_hold_an_input_and_the_next() -> None:
    made = training(CONFIGS["film"])
    inputs = [made.drawn_input(index) for index in (0, 1, 30)]
    slots = Slots(inputs[0], 2, CPU)
    for given, rates in zip(inputs, ([0.5, 0.25], [0.125, 2.0], [3.0, 4.0]), strict=True):
        slots.fill(given, rates)
        found = slots.input(Kind.of(given, True))
        assert [float(rate) for rate in slots.rates()] == rates
        for name in ("eye", "codes", "flipped", "row", "gaps", "background", "blend", "pull", "ramp", "direction"):
            wanted = getattr(given, name)
            if wanted is None:
                assert getattr(found, name) is None
            else:
                torch.testing.assert_close(getattr(found, name), torch.as_tensor(wanted), check_dtype=False)
        for one, other in zip(given.prior_pose, found.prior_pose, strict=True):
            assert torch.equal(one, other)
        assert torch.equal(given.target.rgb, found.target.rgb) and torch.equal(given.target.mask, found.target.mask)
        torch.testing.assert_close(found.target.camera.intrinsics, given.target.camera.intrinsics, check_dtype=False)
        assert float(found.target.side) == pytest.approx(given.target.side)
    assert all(place.data_ptr() % 16 == slots.there.data_ptr() % 16 for place in slots.placed)


@needs_gpu
@pytest.mark.parametrize("name", CONFIGS)
def test_graphs_on_a_gpu_are_the_plain_steps(name: str) -> None:
    """Sums there are not always taken in one order, so that fits part slowly."""
    plain, recorded = training(CONFIGS[name], CUDA), training(CONFIGS[name], CUDA)
    plain.graphs = None
    recorded.graphs = StepGraphs(recorded, CudaRecorder(CUDA))
    apart = []
    for index in range(STEPS):
        wanted, found = plain.step(index), recorded.step(index)
        assert wanted.keys() == found.keys()
        apart.append(abs(found["loss"] / wanted["loss"] - 1))
    assert max(apart[:6]) < 1e-3 and max(apart) < 0.1, apart
    assert recorded.graphs.records and any(step.replays for step in recorded.graphs.steps.values())


def doubled(given: StepInput) -> StepInput:
    target, (quats, shifts) = given.target, given.prior_pose
    return replace(
        given,
        target=replace(target, rgb=target.rgb.double(), mask=target.mask.double()),
        codes=given.codes.double(),
        prior_pose=(quats.double(), shifts.double()),
    )


def gradients(made: Training, given: StepInput) -> dict[str, Tensor]:
    losses, _ = made.losses_of(given)
    made.backward(torch.stack(list(losses.values())))
    return {key: part.grad.cpu().double() for key, part in made.model.named_parameters() if part.grad is not None}


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_gpu)])
@pytest.mark.parametrize("name", CONFIGS)
def test_gradients_of_a_step_are_those_of_plain_torch_in_double_precision(name: str, device: str) -> None:
    """Kernels of the device against their twins; both render with the rasterizer's reference."""
    made, exact = training(CONFIGS[name], torch.device(device)), training(CONFIGS[name])
    set_default("reference")
    try:
        for each in (made, exact):  # they start at zero, where gradients vanish
            generator = torch.Generator().manual_seed(1)
            for layer in (each.model.network.head, each.model.deform.out):
                layer.weight.data.copy_(0.01 * torch.randn(layer.weight.shape, generator=generator))
            each.prepare()
        exact.model.double()
        given, plain = made.drawn_input(12), exact.drawn_input(12)
        found, wanted = gradients(made, given.to(torch.device(device))), gradients(exact, doubled(plain))
    finally:
        set_default("auto")
    assert found.keys() == wanted.keys()
    least = 1e-6 * max(float(part.norm()) for part in wanted.values())  # some are zero but for rounding
    errors = {key: float((found[key] - part).norm() / part.norm().clamp_min(least)) for key, part in wanted.items()}
    assert max(errors.values()) < 1e-4, errors
