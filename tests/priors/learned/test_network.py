"""The network, its loss, its training and its weights."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from rewild4d.errors import UserError
from rewild4d.priors.learned import examples, training
from rewild4d.priors.learned.network import ALONE, MAP, Found, PointNetwork, _read_maps, loss
from rewild4d.priors.learned.points import NAMES
from rewild4d.priors.learned.training import TrainingConfig, train
from rewild4d.priors.learned.weights import load_weights, save_weights


def test_the_loss_is_the_negative_logarithm_of_a_laplace_density() -> None:
    points = torch.zeros(1, 1, 2, 3)
    said = torch.tensor(((0.1, 0.3, 0.4), (0.0, 0.0, 0.0))).view(1, 1, 2, 3)
    spreads = torch.tensor(((0.2, 0.8), (1.0, 1.0))).view(1, 1, 2, 2)
    # across: mean of .1 and .3 over .2; along: .4 over .8; the second point is exact and has spreads of one
    wanted = (0.2 / 0.2 + math.log(0.2) + 0.4 / 0.8 + math.log(0.8)) / 4
    assert float(loss(Found(said, spreads, points), points)) == pytest.approx(wanted)
    # each picture alone is .06 off in every number
    assert float(loss(Found(said, spreads, points + 0.06), points)) == pytest.approx(wanted + ALONE * 0.06)


def test_a_peak_of_a_heat_map_is_where_its_point_is() -> None:
    heat = torch.full((1, 1, MAP, MAP), -30.0)
    heat[0, 0, 6, 18] = 30.0  # row 6, column 18
    points, width = _read_maps(heat.flatten(2), torch.tensor([[0.5]]), torch.tensor([0.2]))
    column, row = 2 * 18.5 / MAP - 1, 2 * 6.5 / MAP - 1
    nearer = 1 + 0.5 * 0.2  # the picture shows x over 1 + z times the opening
    assert points[0, 0].tolist() == pytest.approx([column * nearer, row * nearer, 0.5], abs=1e-5)
    assert float(width) == pytest.approx(1e-3, abs=1e-3)


def test_frames_are_told_apart_by_the_others_and_by_their_cameras() -> None:
    torch.manual_seed(0)
    network, drawn = PointNetwork().eval(), examples.draw_sequences(np.random.default_rng(0), 1, 4)
    drawn.known[:] = True
    whole = network(drawn.pictures, drawn.rotations, drawn.openings, drawn.known)
    assert whole.points.shape == (1, 4, len(NAMES), 3) and whole.spreads.shape == (1, 4, len(NAMES), 2)
    assert (whole.spreads > 0).all()
    turned = drawn.rotations.clone()
    turned[:, 1] = drawn.rotations[:, 1] @ torch.diag(torch.tensor((-1.0, 1.0, -1.0)))
    other = network(drawn.pictures, turned, drawn.openings, drawn.known)
    assert not torch.allclose(whole.points[:, 0], other.points[:, 0])  # where another frame's camera stands
    fewer = network(drawn.pictures[:, :2], drawn.rotations[:, :2], drawn.openings[:, :2], drawn.known)
    assert not torch.allclose(whole.points[:, 0], fewer.points[:, 0])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds of one animal with two sequences of four frames."""
    monkeypatch.setattr(training, "ANIMALS", 1)
    monkeypatch.setattr(training, "CHECKED", 2)
    monkeypatch.setattr(training, "BATCH", 2)
    monkeypatch.setattr(training, "EVERY", 1)
    monkeypatch.setattr(training, "draw_sequences", lambda rng: examples.draw_sequences(rng, 2, 4))


class Killed(Exception):
    pass


@pytest.mark.usefixtures("small")
def test_a_killed_training_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    config = TrainingConfig(rounds=2)
    said: list[str] = []
    whole = load_weights(train(tmp_path / "whole", config, workers=0, report=said.append))

    def kill(line: str) -> None:
        raise Killed

    with pytest.raises(Killed):
        train(tmp_path / "killed", config, workers=0, report=kill)
    resumed = load_weights(train(tmp_path / "killed", config, workers=0, report=said.append))
    assert [line.split("  ")[0] for line in said] == ["round 1", "round 2", "round 2"]
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    with pytest.raises(UserError, match=r"checkpoint\.pt: expected a training with \{'rounds': 3"):
        train(tmp_path / "killed", TrainingConfig(rounds=3), workers=0, report=said.append)


def test_a_checkpoint_that_cannot_be_read_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"cut")
    with pytest.raises(UserError, match=r"checkpoint\.pt: expected a checkpoint of a training, but it cannot be read"):
        train(tmp_path, TrainingConfig(rounds=1), workers=0, report=print)


@pytest.mark.usefixtures("small")
def test_training_on_one_sequence_finds_its_points() -> None:
    drawn = examples.draw_sequences(np.random.default_rng(0), 1, 4)
    torch.manual_seed(0)
    network = PointNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3)
    away = []
    for _ in range(80):
        found = network(drawn.pictures, drawn.rotations, drawn.openings, drawn.known)
        away.append(float((found.points - drawn.points).abs().mean().detach()))
        optimizer.zero_grad()
        loss(found, drawn.points).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert away[-1] < 0.2 * away[0]


def test_weights_come_back_in_half_precision_and_others_are_told(tmp_path: Path) -> None:
    network = PointNetwork()
    save_weights(network, tmp_path / "w.safetensors")
    back = load_weights(tmp_path / "w.safetensors")
    for name, value in network.state_dict().items():
        assert torch.equal(value.half().float(), back.state_dict()[name])
    assert (tmp_path / "w.safetensors").stat().st_size < 20 * 2**20
    with pytest.raises(UserError, match=r"none: expected weights of the learned prior .*, got no such file\."):
        load_weights(tmp_path / "none")
    (tmp_path / "cut").write_bytes((tmp_path / "w.safetensors").read_bytes()[:1000])
    with pytest.raises(UserError, match=r"cut: expected weights of the learned prior, but: "):
        load_weights(tmp_path / "cut")
    save_file({"a": torch.zeros(1)}, tmp_path / "other")
    with pytest.raises(UserError, match=r"other: expected weights of the learned prior, but: "):
        load_weights(tmp_path / "other")
