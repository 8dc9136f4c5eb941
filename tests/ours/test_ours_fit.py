"""The whole fit of `ours` on a toy: the procedural quadruped swings its legs while a camera walks around it."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from dying import Killed, kill_late
from toys import FRAMES, HEIGHT, TINY, WIDTH

from rewild4d.errors import UserError
from rewild4d.harmonics import seen_colors
from rewild4d.kernels.threads import set_kernel_threads
from rewild4d.ours.config import Canonical, Config, PriorUse, WarmUp
from rewild4d.ours.fit import Training, train
from rewild4d.ours.method import Ours
from rewild4d.ours.model import build_model
from rewild4d.ours.motion import Root
from rewild4d.ours.reconstruction import OursReconstruction
from rewild4d.ours.schedule import for_clip
from rewild4d.ours.symmetry import SIGNS, Key, Supervision
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import axis_angle_to_matrix, similarity
from rewild4d.types import OBJECT_DIAGONAL, Clip, Prior

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def kernel_threads() -> Iterator[None]:
    """A test that sets them sets them for itself."""
    yield
    set_kernel_threads(None)


def quiet(step: int, total: int, values: object) -> None:
    """Log nothing."""


def start(toy: tuple[Clip, Prior], config: Config) -> Training:
    """The main stage at its first step, with networks that are not at zero."""
    generator = torch.Generator().manual_seed(0)
    supervision = Supervision(*toy, config.image_size, CPU)
    model = build_model(config, toy[1], generator)
    for layer in (model.network.head, model.deform.out):
        torch.nn.init.normal_(layer.weight, std=0.01, generator=generator)
    return Training(model, supervision, config, generator)


def test_the_mirrored_groups(toy: tuple[Clip, Prior]) -> None:
    clip, prior = toy
    supervision = Supervision(clip, prior, 64, CPU)
    for group, view in SIGNS:
        target = supervision.target(Key(group, view, 2))
        image = clip.frames[2].rgb if view > 0 else clip.frames[2].rgb.flip(-1)
        assert torch.equal(target.rgb, image)
        # Flip cameras of a fitted prior are exact mirrors, so image and camera always agree.
        expected = prior.cameras[2] if view > 0 else prior.cameras_flip[2]
        torch.testing.assert_close(target.camera.world_to_camera, expected.world_to_camera)
        torch.testing.assert_close(target.camera.intrinsics, expected.intrinsics)
        assert float(torch.linalg.det(target.camera.world_to_camera)) == pytest.approx(1)
    quats, shifts = supervision.prior_pose([Key(1, 1, 1), Key(-1, 1, 1), Key(1, -1, 1)])
    assert torch.equal(quats[0], quats[1]) and shifts.abs().max() < 1e-5
    generator = torch.Generator().manual_seed(0)
    drawn = {supervision.draw(generator)[:2] for _ in range(60)}
    assert drawn == set(SIGNS)
    views = [supervision.draw(generator, mirrored=1 / 4).view for _ in range(400)]
    assert views.count(-1) / 400 == pytest.approx(1 / 4, abs=0.07)
    assert {supervision.draw(generator, mirrored=0.0).view for _ in range(60)} == {1}
    assert {supervision.draw(generator, cameras="own")[:2] for _ in range(60)} == {(1, 1), (-1, -1)}


def test_zero_networks_give_the_skinned_canonical(toy: tuple[Clip, Prior]) -> None:
    generator = torch.Generator().manual_seed(0)
    model = build_model(TINY, toy[1], generator)
    weights = model.field.sample(model.field.probabilities(), model.gaussians.means)
    posed, deformed = model.moved(model.pose(torch.tensor([0.4]), [Key(1, 1, 1)]), weights, 1.0)
    torch.testing.assert_close(posed.means, model.gaussians.means)
    torch.testing.assert_close(deformed.means, posed.means)
    torch.testing.assert_close(deformed.log_scales, posed.log_scales)


def test_gradients_stay_in_their_branch(toy: tuple[Clip, Prior]) -> None:
    training = start(toy, TINY)
    model, key = training.model, Key(1, 1, 1)
    losses, _ = training.losses(key, training.supervision.target(key), index=TINY.iterations - 1)
    head, own = model.network.head, model.gaussians

    def grads(loss: torch.Tensor, *leaves: torch.Tensor) -> list[torch.Tensor | None]:
        return list(torch.autograd.grad(loss, leaves, retain_graph=True, allow_unused=True))

    appearance = losses["l1"] + losses["ssim"] + losses["silhouette"]
    assert all(grad is None or grad.abs().max() == 0 for grad in grads(appearance, head.weight, head.bias))
    assert grads(losses["pose_silhouette"], head.weight)[0].abs().max() > 0
    apart = (own.colors, own.log_scales, own.logit_opacities, model.deform.out.weight, model.deform.key.weight)
    assert grads(losses["pose_silhouette"], *apart) == [None] * len(apart)
    assert all(grad.abs().max() > 0 for grad in grads(appearance, *apart[:4], own.means, model.field.logits))
    # The anchors are the declared shared space.
    assert grads(appearance, model.network.anchors)[0].abs().max() > 0


def test_a_change_of_scale_by_the_deformation_costs_its_square(toy: tuple[Clip, Prior]) -> None:
    training = start(toy, TINY)
    deform, key = training.model.deform, Key(1, 1, 1)
    target, last = training.supervision.target(key), TINY.iterations - 1
    with torch.no_grad():
        deform.out.weight.zero_()
        deform.out.bias.zero_()
    assert training.losses(key, target, last)[0]["steady"] == 0
    with torch.no_grad():
        deform.out.bias[-3:] = 0.5
    # The ramp is at its end, so the offset is the same on each of three axes.
    offset = TINY.deform.max_log_scale * math.tanh(0.5)
    assert training.losses(key, target, last)[0]["steady"].item() == pytest.approx(0.1 * offset**2, rel=1e-4)
    off = msgspec.structs.replace(TINY, geometry=msgspec.structs.replace(TINY.geometry, steady=0.0))
    assert "steady" not in start(toy, off).losses(key, target, last)[0]


def test_only_displacements_beyond_the_body_cost_something(toy: tuple[Clip, Prior]) -> None:
    held = msgspec.structs.replace(TINY.geometry, stray=2.0, stray_from=0.02)
    training = start(toy, msgspec.structs.replace(TINY, geometry=held))
    deform, key = training.model.deform, Key(1, 1, 1)
    target, last = training.supervision.target(key), TINY.iterations - 1
    with torch.no_grad():
        deform.out.weight.zero_()
        deform.out.bias.zero_()
    for diagonals, cost in ((0.02, 0.0), (0.5, 2 * (0.5**2 - 0.02**2))):
        with torch.no_grad():
            deform.out.bias[0] = diagonals * OBJECT_DIAGONAL / TINY.deform.reach
        lost = training.losses(key, target, last)[0]["stray"]
        assert lost.item() == pytest.approx(cost, rel=1e-4, abs=1e-6)
    lost.backward()
    assert deform.out.bias.grad is not None and deform.out.bias.grad[0] > 0, "it draws the part back"
    assert "stray" not in start(toy, TINY).losses(key, target, last)[0]


def test_a_killed_fit_resumes_to_the_same_bits_on_more_threads(toy: tuple[Clip, Prior], tmp_path: Path) -> None:
    whole = train(*toy, TINY, 0, CPU, quiet, None)
    # The last log comes after the last checkpoint but one: everything since then is lost and done again.
    with pytest.raises(Killed):
        train(*toy, TINY, 0, CPU, kill_late, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    set_kernel_threads(3)
    resumed = train(*toy, TINY, 0, CPU, quiet, tmp_path)
    other = train(*toy, TINY, 1, CPU, quiet, tmp_path)
    assert len(whole.gaussians) > TINY.canonical.samples
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert not torch.equal(whole.network.head.weight, other.network.head.weight)


def test_save_and_load_give_the_same_gaussians(toy: tuple[Clip, Prior], tmp_path: Path) -> None:
    method = Ours()
    made = method.fit(*toy, config=TINY, seed=0, device=CPU, log=quiet, workdir=None)
    made.save(tmp_path)
    read = method.load(tmp_path, CPU)
    for time in (0.0, 0.13, 0.4):
        for name in ("means", "quats", "scales", "opacities", "colors"):
            assert torch.equal(getattr(made.at(time), name), getattr(read.at(time), name))
        assert read.camera(time).world_to_camera.equal(made.camera(time).world_to_camera)
    assert made.weights.sum(-1).allclose(torch.ones(len(made.canonical())))
    figures = made.diagnostics()
    assert len(figures["joint_angle_std"]) == 20 and figures["gaussians"] == len(made.canonical())
    with pytest.raises(UserError, match=r"expected a reconstruction by 'ours', but it has no ours\.pt"):
        method.load(tmp_path / "elsewhere", CPU)


def test_harmonics_mean_the_same_in_training_and_in_the_world(toy: tuple[Clip, Prior]) -> None:
    clip, prior = toy
    turn = axis_angle_to_matrix(torch.tensor((0.3, -0.8, 0.4), dtype=torch.float64))
    root = similarity(1.7, turn, torch.tensor((0.5, -1.0, 2.0), dtype=torch.float64))
    training = start(toy, msgspec.structs.replace(TINY, canonical=Canonical(samples=50, sh_degree=2)))
    own = training.model.gaussians
    torch.nn.init.normal_(own.colors, mean=0.5, generator=torch.Generator().manual_seed(0))
    motion = Root(torch.tensor(clip.times).double(), root.repeat(FRAMES, 1, 1), (None,) * FRAMES)
    made = OursReconstruction(training.model, training.config, motion)
    eye = torch.tensor((3.0, 2.0, -6.0), dtype=torch.float64)
    pose = training.model.pose(torch.tensor([2 / FRAMES]), [Key(1, 1, 1)])
    _, posed = training.model.moved(pose, made.weights, 1.0)
    expected = own.seen_rgb(posed.means, posed.quats, eye, 2)
    actual = seen_colors(made.at(clip.times[1]), root[:3, :3] @ eye + root[:3, 3])
    torch.testing.assert_close(actual, expected, atol=1e-4, rtol=0)


def test_what_was_trained_on_reduced_images_is_as_wide_in_finer_ones(toy: tuple[Clip, Prior]) -> None:
    half = msgspec.structs.replace(TINY, image_size=max(toy[0].frames[0].mask.shape) // 2)
    whole, made = (
        Ours().fit(*toy, config=config, seed=0, device=CPU, log=quiet, workdir=None) for config in (TINY, half)
    )
    assert float(whole.model.gaussians.blur) == 0
    # Every camera is sqrt(12^2 + 3^2) from the origin; 0.3 square pixels of twice the side, less 0.3 of the clip's own.
    pixel = math.hypot(12, 3) / (2.2 * HEIGHT)
    missing = math.sqrt(0.3 * (2 * pixel) ** 2 - 0.3 * pixel**2)
    assert float(made.model.gaussians.blur) == pytest.approx(missing, rel=1e-5)
    with torch.no_grad():
        made.model.gaussians.log_scales.fill_(-9.0)
    for splats in (made.canonical(), made.at(0.15)):
        assert splats.scales.min() >= missing * 0.999


def test_a_short_fit_improves_the_silhouette(toy: tuple[Clip, Prior]) -> None:
    none, long = (
        WarmUp(iterations=0, regress=0),
        WarmUp(iterations=120, regress=0, samples=300, size=64, pull=0.0, rate=2e-3),
    )
    before, after = (silhouette_error(toy, warmup) for warmup in (none, long))
    assert after < 0.85 * before


def silhouette_error(toy: tuple[Clip, Prior], warmup: WarmUp) -> float:
    """Mean absolute difference of mattes over the input views after a warm-up and one step of the main stage."""
    config = msgspec.structs.replace(TINY, warmup=warmup, iterations=1, prior=PriorUse(pull=0.0))
    made = Ours().fit(*toy, config=config, seed=0, device=CPU, log=quiet, workdir=None)
    errors = []
    for frame in toy[0].frames:
        moved = made.at(frame.time)
        _, alpha, _ = rasterize(
            moved.means, moved.quats, moved.scales, moved.opacities, moved.colors[:, 0],
            frame.camera.world_to_camera[None], frame.camera.intrinsics[None], WIDTH, HEIGHT,
        )  # fmt: skip
        errors.append(float((alpha[0] - frame.mask).abs().mean()))
    return sum(errors) / len(errors)


def test_unusable_input_is_named(toy: tuple[Clip, Prior]) -> None:
    clip, prior = toy
    method = Ours()

    def fit(clip: Clip, prior: Prior) -> None:
        method.fit(clip, prior, config=TINY, seed=0, device=CPU, log=quiet, workdir=None)

    empty = replace(clip.frames[3], mask=torch.zeros_like(clip.frames[3].mask))
    with pytest.raises(
        UserError, match="toy/swing: expected an animal in every frame, but the mask of frame 3 is empty"
    ):
        fit(replace(clip, frames=(*clip.frames[:3], empty, clip.frames[4])), prior)
    with pytest.raises(UserError, match="expected a clip of at least 2 frames, got 1"):
        fit(replace(clip, frames=clip.frames[:1]), prior)
    with pytest.raises(UserError, match=r"knows frame 4 at 0\.400 s, but prior 'toy' covers 0\.000 to 0\.300 s"):
        fit(clip, replace(prior, times=prior.times[:4]))
    small = replace(clip.frames[0], rgb=torch.zeros(3, 20, 20), mask=torch.ones(1, 20, 20))
    with pytest.raises(UserError, match="cameras are for images of 64x48 pixels, but the clip's are 20x20"):
        fit(replace(clip, frames=(small, *clip.frames[1:])), prior)


def test_a_loss_that_is_not_finite_stops_the_fit_with_its_name(toy: tuple[Clip, Prior]) -> None:
    training = start(toy, TINY)
    with torch.no_grad():
        training.model.field.logits[:, 0] = float("nan")
    with pytest.raises((FloatingPointError, ValueError), match="not finite|expected finite values"):
        training.step(0)


def test_a_long_clip_gets_more_steps(toy: tuple[Clip, Prior]) -> None:
    config = msgspec.structs.replace(TINY, iterations=2, steps_per_frame=1)
    totals: set[int] = set()
    made = Ours().fit(
        *toy, config=config, seed=0, device=CPU, log=lambda step, total, values: totals.add(total), workdir=None
    )
    assert totals == {config.warmup.regress + config.warmup.iterations + 1 * FRAMES}
    assert made.config.iterations == FRAMES
    assert for_clip(msgspec.structs.replace(config, iterations=50), FRAMES).iterations == 50


def test_a_film_is_a_clip_whose_cameras_are_guessed(toy: tuple[Clip, Prior]) -> None:
    clip, prior = toy
    config = msgspec.structs.replace(TINY, iterations=2)

    def fitted(clip: Clip) -> Config:
        made = Ours().fit(clip, prior, config=config, seed=0, device=CPU, log=lambda *_: None, workdir=None)
        return made.config

    known, guessed = fitted(clip), fitted(replace(clip, guessed_cameras=True))
    assert (known.geometry, known.cameras) == (config.geometry, "both")
    assert (guessed.geometry.temporal, guessed.cameras) == (config.footage.temporal, "own")
