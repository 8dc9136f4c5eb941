"""The losses of preset `paper` are the paper's formulas: both kernels and torch against a float64 transcription."""

from collections.abc import Iterator

import numpy as np
import paper_formulas as paper
import pytest
import torch
from torch import Tensor

from rewild4d.config import load_preset
from rewild4d.kernels.switch import without_kernels
from rewild4d.ours.config import Config
from rewild4d.ours.fit import Training
from rewild4d.ours.losses.images import WINDOW, colour_losses, silhouette_loss, union_window
from rewild4d.ours.losses.regularizers import _disagreement, compact_loss, tv_loss
from rewild4d.ours.model import build_model
from rewild4d.ours.pose import time_code
from rewild4d.ours.schedule import fade, for_clip_of_ours
from rewild4d.ours.skinning import SkinningField
from rewild4d.ours.symmetry import Key, Supervision, Target
from rewild4d.running.conformance import tiny_case

KERNELS = ("compactness", "normals", "silhouette loss", "colour losses", "skinning field", "pose network")
CLOSE = {"abs": 1e-6, "rel": 1e-6}


@pytest.fixture(params=["kernels", "torch"])
def mode(request: pytest.FixtureRequest) -> Iterator[str]:
    with without_kernels(*(KERNELS if request.param == "torch" else ())):
        yield request.param


def drawn(*shape: int, seed: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def test_total_variation(mode: str) -> None:
    field = (4 * drawn(5, 5, 5, 20, seed=1)).softmax(dim=-1)
    expected = paper.total_variation(field.permute(3, 0, 1, 2).double().numpy())
    assert float(tv_loss(field.view(125, 20), 5, 0.05)) == pytest.approx(expected, **CLOSE)
    own = SkinningField(field.view(125, 20).log(), torch.zeros(3), torch.ones(3), torch.arange(20), False)
    _, variation = own.sample_and_vary(own.probabilities(), drawn(7, 3, seed=2), 0.05)
    assert float(variation.detach()) == pytest.approx(expected, **CLOSE)


def test_compactness(mode: str) -> None:
    weights = (3 * drawn(300, 20, seed=1)).softmax(dim=-1)
    clouds = [drawn(300, 3, seed=2) - 0.5, 2 * drawn(300, 3, seed=3) * torch.tensor((0.2, 1.0, 1.0))]
    expected = [paper.compactness(cloud.double().numpy(), weights.double().numpy()) for cloud in clouds]
    for cloud, one in zip(clouds, expected, strict=True):
        assert float(compact_loss([cloud], weights, 2.0)) == pytest.approx(one, **CLOSE)
    assert float(compact_loss(clouds, weights, 2.0)) == pytest.approx(sum(expected) / 2, **CLOSE), "on both centres"


def test_a_large_part_counts_less() -> None:
    """Of two parts alike in shape, with 3/4 and 1/4 of the Gaussians, gamma is e^-2 and e^(-2/3)."""
    corners = torch.tensor(((1.0, 0, 0), (-1, 0, 0), (0, 2, 0), (0, -2, 0)))
    weights = torch.zeros(16, 2)
    weights[:12, 0], weights[12:, 1] = 1, 1
    expected = (np.exp(-2) + np.exp(-2 / 3)) / 2 * 0.5  # the variances are 1/2, 2 and 0
    assert float(compact_loss([corners.repeat(4, 1)], weights, 2.0)) == pytest.approx(expected)


def test_smoothness(mode: str) -> None:
    image = drawn(3, 19, 23, seed=1) - 0.5
    cover = drawn(19, 23, seed=2) * (drawn(19, 23, seed=3) > 0.3)
    unit = torch.nn.functional.normalize(image.double(), dim=0).numpy()
    expected = paper.smoothness(unit, cover.double().numpy())
    assert float(_disagreement(image, cover)) == pytest.approx(expected, **CLOSE)


def test_neighbours_in_both_directions_count_in_full() -> None:
    """Two columns at right angles disagree along x alone, fully: 1 + 0, not the mean of all pairs."""
    image = torch.zeros(3, 5, 2)
    image[0, :, 0], image[1, :, 1] = 1, 1
    assert float(_disagreement(image, torch.ones(5, 2))) == pytest.approx(1 + 0, abs=1e-5)


def image_target(height: int, width: int) -> Target:
    """A target whose losses are means over the image, as preset `paper` has them."""
    rgb, mask = drawn(3, height, width, seed=4), (drawn(1, height, width, seed=5) > 0.4).float()
    camera = tiny_case().prior.cameras[0]
    return Target(rgb * mask, mask, camera, (height * width) ** 0.5)


def test_silhouette(mode: str) -> None:
    target, alpha = image_target(14, 17), 0.02 + 0.96 * drawn(1, 14, 17, seed=6)
    found = float(silhouette_loss(alpha, target, union_window([alpha, target.mask], WINDOW - 1)))
    expected = paper.silhouette(alpha.double().numpy(), target.mask.double().numpy())
    assert found == pytest.approx(expected, **CLOSE)


def test_colour(mode: str) -> None:
    target = image_target(14, 17)
    alpha = 0.02 + 0.96 * drawn(1, 14, 17, seed=6)
    rgb, white = alpha * drawn(3, 14, 17, seed=7), torch.ones(3)
    l1, dissimilarity = colour_losses(rgb, alpha, target, white, union_window([alpha, target.mask], WINDOW - 1))
    whole = [(image + 1 - matte).double().numpy() for image, matte in ((rgb, alpha), (target.rgb, target.mask))]
    config = load_preset("ours", Config, "paper").loss
    found = config.l1 * float(l1) + config.ssim * float(dissimilarity)
    assert found == pytest.approx(paper.colour(*whole), **CLOSE)


@pytest.mark.parametrize(("m", "v"), [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_encoding(mode: str, m: int, v: int) -> None:
    code = time_code(torch.tensor([0.7]), torch.tensor([float(m)]), torch.tensor([float(v)]), 6)
    assert code[0].tolist() == pytest.approx(paper.encoding(float(torch.tensor(0.7)), m, v, 6), **CLOSE)


def test_the_blend_ends_after_seven_thousand_steps() -> None:
    for frames in (12, 200):  # a short run has 10k steps
        config = for_clip_of_ours(load_preset("ours", Config, "paper"), frames, filmed=True)
        for step in (0, 3500, 6999, 7000, 9000):
            assert fade(step / config.iterations, config.prior.blend_until) == pytest.approx(paper.blend_weight(step))


def test_weights_and_terms_of_a_step() -> None:
    """A step has the paper's terms, times its weights, and no others; none of them ends early."""
    case, preset = tiny_case(), load_preset("ours", Config, "paper")
    for film, last in ((False, False), (True, False), (True, True)):
        config = for_clip_of_ours(preset, 24, filmed=film)
        supervision = Supervision(case.clip, case.prior, config.image_size, torch.device("cpu"), config.loss.mean_over)
        generator = torch.Generator().manual_seed(0)
        own = Training(build_model(config, case.prior, generator), supervision, config, generator)
        key = Key(1, 1, 0)
        losses, _ = own.losses(key, supervision.target(key), 10_000 if last else 3_999)
        values = {name for name, value in losses.items() if float(value.detach()) != 0}
        wanted = {"pose_silhouette", "l1", "ssim", "silhouette"}
        wanted |= set() if last else {"tv", "compact", "smooth"}
        assert values == wanted | ({"prior"} if film and not last else set())
    weights = preset.loss.pose_silhouette, preset.loss.l1, preset.loss.ssim, preset.loss.silhouette
    assert weights == (0.2, 1 - 0.2, 0.2, 0.1)
    geometry = preset.geometry
    assert (geometry.tv, geometry.compact, geometry.smooth, geometry.compact_alpha) == (10, 0.1, 0.1, 2.0)
    assert (geometry.tv_every, geometry.compact_every, geometry.smooth_every) == (1, 1, 1)
