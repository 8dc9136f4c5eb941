"""Where shapes lie: the Gaussian against scipy's, how a fit follows it, and how it is learned."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch import Tensor
from walking import shortened, silent, walking_clip

from rewild4d.errors import UserError
from rewild4d.priors.bodies.biped import BIPED
from rewild4d.priors.bodies.body import Proportions
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.fit import fit_animal
from rewild4d.priors.shapes import examples, training
from rewild4d.priors.shapes.density import ShapeDensity
from rewild4d.priors.shapes.examples import MOMENTS, VIEWS, Seen, drawn, fitted
from rewild4d.priors.shapes.training import TrainingConfig, density_of, train
from rewild4d.priors.shapes.weights import package_density, read_density, save_density
from rewild4d.priors.trained import UNTRAINED, Trained
from rewild4d.types import Frame

pytestmark = pytest.mark.usefixtures("one_thread")
MEASURES, SECTIONS = QUADRUPED.measures, QUADRUPED.sections
SIZE = MEASURES + 4 * SECTIONS


def test_the_penalty_is_the_exponent_of_a_gaussian() -> None:
    torch.manual_seed(0)
    samples = torch.randn(400, 6) @ (torch.eye(6) + 0.3 * torch.randn(6, 6)) + torch.arange(6.0)
    density = density_of(samples)
    covariance = torch.linalg.inv(density.whitening.T @ density.whitening).double().numpy()
    assert np.allclose(covariance, np.cov(samples.double().numpy().T, bias=True), rtol=0.05, atol=0.2)
    oracle = multivariate_normal(density.mean.double().numpy(), covariance)
    shape, relief = samples[:5, :2], samples[:5, 2:].reshape(5, 1, 4)
    expected = -2 * (oracle.logpdf(samples[:5].double().numpy()) - oracle.logpdf(density.mean.double().numpy())) / 6
    assert np.allclose(density.penalty(shape, relief).numpy(), expected, rtol=1e-3)
    every = density.penalty(samples[:, :2], samples[:, 2:].reshape(400, 1, 4))
    assert float(every.mean()) == pytest.approx(1, abs=0.1)


def narrow(mean: Tensor) -> ShapeDensity:
    return ShapeDensity(mean, 30 * torch.eye(SIZE))


def test_a_fit_stays_with_the_shapes_that_it_is_told_and_other_bodies_are_told_none() -> None:
    clip, config = walking_clip(3, "fixed"), shortened(4)
    mean = torch.zeros(SIZE)
    mean[0], mean[MEASURES + 9 * 4 + 2] = -1.5, 2.0
    told = Trained(shapes=narrow(mean))
    animal = fit_animal(clip.frames, range(3), 3, "case", config, 0, silent, told)
    assert animal.seen == "masks near the shapes of random animals"
    assert float(animal.shape.deviations[0]) == pytest.approx(-1.5, abs=0.2)
    assert animal.shape.relief is not None and float(animal.shape.relief[9, 2]) == pytest.approx(2.0, abs=0.3)
    assert told.shapes_of(QUADRUPED) is told.shapes and told.shapes_of(BIPED) is None
    free = msgspec.structs.replace(config, density_weight=0.0)
    longer = fit_animal(clip.frames, range(3), 3, "case", free, 0, silent, told)
    assert longer.shape.deviations[0] > animal.shape.deviations[0], "the animal of the clip has a body of 2.0"
    ring = walking_clip(3, "sweep")
    plain, asked = (fit_animal(ring.frames, range(3), 3, "case", config, 0, silent, each) for each in (UNTRAINED, told))
    assert torch.equal(plain.shape.deviations, asked.shape.deviations), (
        "where several sides are seen they are not asked"
    )


def test_an_animal_of_known_shape_is_found_from_all_around(monkeypatch: pytest.MonkeyPatch) -> None:
    deviations = torch.zeros(MEASURES)
    deviations[0], deviations[9] = -1.2, -0.8  # a short body and short forelegs
    template = QUADRUPED.build(Proportions(deviations))
    vertices, faces = template.vertices.double().numpy(), template.faces.numpy().astype(np.int32)
    frames, rng = [], np.random.default_rng(0)
    for moment in range(2):
        for view in range(4):
            camera = examples._camera(vertices.mean(axis=0), 2.5, 0.4 + 1.57 * view + 0.8 * moment, rng.uniform(0, 0.6))
            mask = examples._mask(vertices, faces, camera)
            frames.append(Frame(moment / 12, camera, mask.expand(3, -1, -1), mask))
    stages = tuple(msgspec.structs.replace(stage, steps=45) for stage in examples.SETTINGS.stages[:3])
    monkeypatch.setattr(examples, "SETTINGS", msgspec.structs.replace(examples.SETTINGS, stages=stages))
    shape, cost = fitted(Seen(frames, [0] * 4 + [1] * 4, torch.tensor((0.0, 0.0, 1.0)).double()))
    assert cost < 0.06
    assert -1.7 < shape[0] < -0.4 and -1.3 < shape[9] < -0.3, "after few steps from 0"


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits of a step a stage."""
    stages = tuple(msgspec.structs.replace(stage, steps=1) for stage in examples.SETTINGS.stages)
    monkeypatch.setattr(examples, "SETTINGS", msgspec.structs.replace(examples.SETTINGS, stages=stages))
    monkeypatch.setattr(training, "FAILED", 10.0)


@pytest.mark.usefixtures("short")
def test_random_animals_are_shown_from_all_around() -> None:
    rng = np.random.default_rng(5)
    shown = examples.seen(examples.draw_animal(rng), rng)
    assert len(shown.frames) == len(shown.moments) == VIEWS * len(MOMENTS) and set(shown.moments) == {0, 1, 2}
    for frame in shown.frames:
        edge = torch.cat((frame.mask[0, 0], frame.mask[0, -1], frame.mask[0, :, 0], frame.mask[0, :, -1]))
        assert frame.mask.sum() > 200 and not edge.any(), "whole, inside the picture"
    shape, cost = drawn(np.random.default_rng(5))
    assert shape.shape == (SIZE,) and np.isfinite(cost)


@pytest.mark.usefixtures("short")
def test_a_training_that_was_stopped_goes_on_to_the_same_density(tmp_path: Path) -> None:
    config, told = TrainingConfig(animals=3), list[str]()
    first = train(tmp_path / "a", config, workers=0, report=told.append)
    assert first == tmp_path / "a" / "density.safetensors" and told[-1].startswith("3 of 3 fits are good; median cost ")
    (tmp_path / "a" / "samples" / "0-00001.npz").unlink()
    kept = read_density(first)
    again = read_density(train(tmp_path / "a", config, workers=0, report=told.append))
    assert torch.equal(kept.mean, again.mean) and torch.equal(kept.whitening, again.whitening)
    with pytest.raises(UserError, match="samples: expected 2 good fits or more, got 1: ask for more animals"):
        train(tmp_path / "a", TrainingConfig(animals=1), workers=0, report=told.append)


def test_a_file_that_is_no_density_is_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "density.safetensors"
    for content in (None, b"no", b"\x02\0\0\0\0\0\0\0{}"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError, match=r"density\.safetensors: expected a density of shapes"):
            read_density(path)
    density = ShapeDensity(torch.arange(3.0), torch.eye(3))
    save_density(density, path)
    assert torch.equal(read_density(path).mean, density.mean)


def test_the_density_of_the_package_fits_the_quadruped() -> None:
    density = package_density()
    assert density.mean.shape == (SIZE,) and density.whitening.shape == (SIZE, SIZE)
    shape, relief = density.start(MEASURES)
    assert shape.shape == (MEASURES,) and relief.shape == (SECTIONS, 4)
    length = float(QUADRUPED.table["body_length"].at(shape[0]))
    assert 1.2 < length < 1.6, "shorter than the template's 1.75"
    average, far = torch.zeros(1, MEASURES), torch.full((1, MEASURES), 3.0)
    assert density.penalty(average, relief[None]) < density.penalty(far, relief[None])
