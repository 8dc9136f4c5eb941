"""Turns of each frame's joints beside the pose network."""

import math
from pathlib import Path

import msgspec
import pytest
import torch
from dying import Killed, kill_late
from torch import Tensor
from toys import FRAMES, TINY

from rewild4d.errors import UserError
from rewild4d.ours.fit import Training, train
from rewild4d.ours.method import Ours
from rewild4d.ours.model import build_model
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.ours.turns import Turns
from rewild4d.transforms import axis_angle_to_matrix, mirror_quats, quat_to_matrix
from rewild4d.types import Clip, Prior

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = torch.device("cpu")
TURNING = msgspec.structs.replace(TINY, pose=msgspec.structs.replace(TINY.pose, turns=True, turns_from=0.5))
MIRROR = torch.tensor((0, 2, 1))


def quiet(step: int, total: int, values: object) -> None:
    """Log nothing."""


def made(tied: bool = False) -> Turns:
    """Turns of three joints in frames at a fifth, two fifths and all of the clip, known by their size."""
    turns = Turns(torch.tensor((0.2, 0.4, 1.0)), 3, tied)
    with torch.no_grad():
        turns.vectors.copy_(0.1 * torch.randn(2, 3, 3, 3, generator=torch.Generator().manual_seed(0)))
    return turns


def quats(vectors: Tensor) -> Tensor:
    """Turn by 2 atan(|v| / 2) about v."""
    return torch.nn.functional.normalize(torch.cat((torch.ones_like(vectors[..., :1]), vectors / 2), dim=-1), dim=-1)


@pytest.mark.parametrize(
    ("time", "shares"),
    [
        (0.2, (1, 0, 0)),
        (0.4, (0, 1, 0)),
        (1.0, (0, 0, 1)),
        (0.25, (3 / 4, 1 / 4, 0)),
        (0.7, (0, 1 / 2, 1 / 2)),
        (0.1, (1, 0, 0)),
        (1.01, (0, 0, 1)),
    ],
)
@pytest.mark.parametrize("flipped", [False, True])
def test_turns_are_linear_between_frames_of_their_own_side(
    time: float, shares: tuple[float, ...], flipped: bool
) -> None:
    turns = made()
    found = turns(torch.tensor([time]), torch.tensor([flipped]), MIRROR)
    vectors = turns.vectors.detach()[int(flipped)]
    expected = quats(sum(share * one for share, one in zip(shares, vectors, strict=True)))
    torch.testing.assert_close(found[0].detach(), expected)


def test_a_small_turn_is_by_its_vector() -> None:
    turns = Turns(torch.tensor((0.5, 1.0)), 1)
    vector = torch.tensor((0.03, -0.02, 0.01))
    with torch.no_grad():
        turns.vectors[0, 0, 0] = vector
    found = quat_to_matrix(turns(torch.tensor([0.5]), torch.tensor([False]), torch.tensor((0,))))[0, 0]
    torch.testing.assert_close(found.detach(), axis_angle_to_matrix(vector), atol=1e-5, rtol=0)


def test_tied_turns_of_a_mirror_image_are_those_of_the_image_mirrored() -> None:
    turns = made(tied=True)
    times = torch.tensor((0.2, 0.2))
    image, mirrored = turns(times, torch.tensor((False, True)), MIRROR)
    torch.testing.assert_close(mirrored, mirror_quats(image[MIRROR]))
    with torch.no_grad():
        turns.vectors[1] = 0
    torch.testing.assert_close(turns(times, torch.tensor((False, True)), MIRROR)[1], mirrored)


def training(toy: tuple[Clip, Prior]) -> Training:
    """The main stage at its first step."""
    generator = torch.Generator().manual_seed(0)
    supervision = Supervision(*toy, TURNING.image_size, CPU)
    model = build_model(TURNING, toy[1], generator, supervision.frame_times())
    return Training(model, supervision, TURNING, generator)


def test_a_turn_follows_the_networks_rotation_in_its_frame_alone(toy: tuple[Clip, Prior]) -> None:
    made = training(toy)
    model, keys = made.model, [Key(1, 1, 1), Key(1, 1, 2), Key(1, -1, 1)]
    torch.nn.init.normal_(model.network.head.weight, std=0.01, generator=torch.Generator().manual_seed(0))
    times = made.supervision.code_times(keys)
    before = model.pose(times, keys)
    assert model.turns is not None
    with torch.no_grad():
        model.turns.vectors[0, 1, 4, 2] = 2 * math.tan(0.25)  # about z
    after = model.pose(times, keys)
    turn = axis_angle_to_matrix(torch.tensor((0.0, 0.0, 0.5)))
    expected = turn @ quat_to_matrix(before.quats[0, 4])
    torch.testing.assert_close(quat_to_matrix(after.quats[0, 4]), expected)
    changed = (after.quats - before.quats).abs().amax(-1) > 1e-6
    assert changed.nonzero().tolist() == [[0, 4]], "another frame, joint or side turned"
    assert torch.equal(after.shifts, before.shifts) and torch.equal(after.features, before.features)


def test_turns_learn_late_and_the_skeletons_terms_do_not_see_them(toy: tuple[Clip, Prior]) -> None:
    made = training(toy)
    assert made.model.turns is not None
    vectors, key, last = made.model.turns.vectors, Key(1, 1, 2), TURNING.iterations - 1
    for index in range(TURNING.iterations // 2):
        made.step(index)
    assert vectors.abs().max() == 0
    losses, _ = made.losses(key, made.supervision.target(key), last)
    assert losses["pose_silhouette"].requires_grad
    for name in ("skeleton", "prior"):
        assert losses[name].requires_grad, name
        (grad,) = torch.autograd.grad(losses[name], vectors, retain_graph=True, allow_unused=True)
        assert grad is None, name
    (grad,) = torch.autograd.grad(losses["pose_silhouette"], vectors)
    rows = grad.abs().amax((-1, -2)).nonzero().tolist()
    assert [0, 2] in rows and all(side == 0 for side, _ in rows)
    made.step(TURNING.iterations // 2)
    assert 0 < vectors.abs().max() <= 1.01 * TURNING.rates.turns, "Adam's first step is as long as its rate"


def test_a_killed_fit_resumes_and_a_saved_one_turns_alike(toy: tuple[Clip, Prior], tmp_path: Path) -> None:
    whole = train(*toy, TURNING, 0, CPU, quiet, None)
    with pytest.raises(Killed):
        train(*toy, TURNING, 0, CPU, kill_late, tmp_path)
    resumed = train(*toy, TURNING, 0, CPU, quiet, tmp_path)
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert whole.turns is not None and whole.turns.vectors.shape == (2, FRAMES, 20, 3)
    assert whole.turns.vectors.abs().max() > 0
    (tmp_path / "saved").mkdir()
    fitted = Ours().fit(*toy, config=TURNING, seed=0, device=CPU, log=quiet, workdir=None)
    fitted.save(tmp_path / "saved")
    read = Ours().load(tmp_path / "saved", CPU)
    for time in (0.0, 0.13, 0.4):
        assert torch.equal(fitted.at(time).means, read.at(time).means)


def test_a_state_without_its_turns_is_refused(toy: tuple[Clip, Prior], tmp_path: Path) -> None:
    fitted = Ours().fit(*toy, config=TURNING, seed=0, device=CPU, log=quiet, workdir=None)
    fitted.save(tmp_path)
    state = torch.load(tmp_path / "ours.pt", weights_only=True)
    state["model"]["turns.vectors"] = state["model"]["turns.vectors"][:, 1:]
    torch.save(state, tmp_path / "ours.pt")
    with pytest.raises(UserError, match=r"expected 'turns.vectors' of shape \[2, T=5, J=20, 3\], got \[2, 4, 20, 3\]"):
        Ours().load(tmp_path, CPU)
    del state["model"]["turns.vectors"]
    torch.save(state, tmp_path / "ours.pt")
    with pytest.raises(UserError, match="expected a tensor 'turns.vectors', got NoneType"):
        Ours().load(tmp_path, CPU)
