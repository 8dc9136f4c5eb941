"""Training the network of headings: it learns, goes on where it was killed, and its files are checked."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.priors.heading import examples, training
from rewild4d.priors.heading.augmentation import augmented
from rewild4d.priors.heading.network import HeadingNetwork
from rewild4d.priors.heading.training import TrainingConfig, train
from rewild4d.priors.learned.weights import read_weights


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of one animal, of which few pictures are drawn."""
    for module, name, value in (
        (training, "PART", 1), (training, "BATCH", 8), (examples, "SEQUENCES", 4), (examples, "FRAMES", 2),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)


def silent(_: str) -> None:
    return None


def test_a_killed_training_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    config = TrainingConfig(animals=3, epochs=3)

    def kill(line: str) -> None:
        if line.startswith("epoch 2"):
            raise KeyboardInterrupt

    whole = read_weights(HeadingNetwork(), train(tmp_path / "whole", config, workers=0, report=silent))
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "killed", config, workers=0, report=kill)
    (tmp_path / "killed" / "pictures" / "0-00001.npz").unlink()  # drawn again
    resumed = read_weights(HeadingNetwork(), train(tmp_path / "killed", config, workers=0, report=silent))
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    curve = json.loads((tmp_path / "killed" / "curve.json").read_text())
    assert [row["epoch"] for row in curve] == [1, 2, 3] and all(row["seconds"] > 0 for row in curve)
    with pytest.raises(UserError, match=r"checkpoint.pt: expected a training with .*'epochs': 4.*, got .*'epochs': 3"):
        train(tmp_path / "killed", TrainingConfig(animals=3, epochs=4), workers=0, report=silent)


def test_a_checkpoint_that_cannot_be_read_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"no")
    with pytest.raises(UserError, match=r"checkpoint.pt: expected a checkpoint of a training, but it cannot be read"):
        train(tmp_path, TrainingConfig(animals=1, epochs=1), workers=0, report=silent)


def test_a_training_starts_from_earlier_weights(tmp_path: Path) -> None:
    earlier = train(tmp_path / "earlier", TrainingConfig(animals=2, epochs=8), workers=0, report=silent)
    going_on = TrainingConfig(animals=2, epochs=1, start=str(earlier))
    later = read_weights(HeadingNetwork(), train(tmp_path / "later", going_on, workers=0, report=silent))
    before, new = read_weights(HeadingNetwork(), earlier).state_dict(), HeadingNetwork().state_dict()
    name = max(before, key=lambda one: before[one].numel())
    assert 0 < (later.state_dict()[name] - before[name]).norm() < 0.2 * (new[name] - before[name]).norm()
    first = [json.loads((tmp_path / which / "curve.json").read_text())[0]["loss"] for which in ("earlier", "later")]
    assert first[1] < first[0] - 0.2


def test_augmented_pictures_are_changed_in_place_and_light() -> None:
    pictures = torch.zeros(64, 2, 48, 48)
    pictures[:, 0, 12:36, 8:40] = 1
    pictures[:32, 1, 12:36, 8:24], pictures[:32, 1, 12:36, 24:40] = 0.5, -0.5
    first, again = (augmented(pictures, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, again) and first.shape == pictures.shape
    assert first[:, 0].min() >= 0 and first[:, 0].max() <= 1
    areas = first[:, 0].mean((1, 2)) / pictures[0, 0].mean()
    assert areas.log().mean().abs() < 0.15 and 0.1 < areas.log().std() < 0.5
    assert first[:, 1][first[:, 0] == 0].abs().max() < 1e-6, "no brightness outside the mask"
    assert first[32:, 1].std() > 0.1, "a flat picture is lit"
    left, right = first[:32, 1].split(24, dim=-1)
    assert (left.mean((1, 2)) > right.mean((1, 2))).float().mean() > 0.8


def test_a_training_augments_where_it_is_asked_to(tmp_path: Path) -> None:
    plain = train(tmp_path / "plain", TrainingConfig(animals=2, epochs=1), workers=0, report=silent)
    config = TrainingConfig(animals=2, epochs=1, augment=True)
    other = train(tmp_path / "other", config, workers=0, report=silent)
    drawn = [np.load(path.parent / "pictures" / "0-00000.npz")["shown"] for path in (plain, other)]
    assert drawn[0].shape == drawn[1].shape and not np.array_equal(*drawn), "stretched animals"
    with pytest.raises(UserError, match=r"checkpoint.pt: expected a training with .*'augment': False.*"):
        train(tmp_path / "other", TrainingConfig(animals=2, epochs=1), workers=0, report=silent)


def test_the_loss_falls(tmp_path: Path) -> None:
    train(tmp_path, TrainingConfig(animals=2, epochs=30), workers=0, report=silent)
    losses = [row["loss"] for row in json.loads((tmp_path / "curve.json").read_text())]
    assert losses[-1] < losses[0] - 1.0
