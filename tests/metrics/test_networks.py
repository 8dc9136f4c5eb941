"""The metric networks against published and recorded values, their resizes against Pillow, and mistaken input.

Tests that need weights skip without them; `rewild4d-bench weights fetch` gets them, and `.ci/run` does so.
"""

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from rewild4d.metrics import features
from rewild4d.metrics.features import I3dFeatures, InceptionFeatures, Lpips
from rewild4d.metrics.networks import i3d as i3d_network
from rewild4d.metrics.networks.inception import Inception
from rewild4d.metrics.networks.layers import check_range, exact_float32, normalise
from rewild4d.metrics.networks.resizing import resize_clip, resize_images
from rewild4d.metrics.samples import ImageExtractor, VideoExtractor
from rewild4d.metrics.weights import LoadedWeights, WeightsMissing, load_weights


def need(name: str) -> LoadedWeights:
    try:
        return load_weights(name)
    except WeightsMissing as error:
        pytest.skip(str(error))


def ramp(size: int) -> Tensor:
    """Red along x, green along y, blue their mean, [1, 3, size, size]."""
    x = torch.linspace(0, 1, size).expand(size, size)
    return torch.stack((x, x.mT, (x + x.mT) / 2))[None]


@pytest.mark.parametrize(
    ("net", "black_white", "ramp_flip"),
    [("alex", 0.8139543533325195, 0.3667665421962738), ("vgg", 0.45383715629577637, 0.5775468349456787)],
)
def test_lpips_gives_the_recorded_distances(net: str, black_white: float, ramp_flip: float) -> None:
    need(f"lpips-{net}")
    lpips = Lpips(net)  # type: ignore[arg-type]
    black, image = torch.zeros(1, 3, 64, 64), ramp(64)
    values = lpips(torch.cat((black, image, image)), torch.cat((black + 1, image.flip(3), image)))
    assert values.dtype == torch.float64
    assert values.tolist() == pytest.approx([black_white, ramp_flip, 0.0], rel=1e-6)
    assert float(lpips(image.flip(3), image)) == pytest.approx(float(values[1]), rel=1e-6)  # symmetric
    assert float(lpips(image[..., :40, :], image[..., :40, :])) == 0.0


PUBLISHED = {"I03": 0.7237, "I04": 0.2572, "I06": 0.0508, "I08": 0.0521, "I19": 0.4253}


@pytest.mark.parametrize("name", PUBLISHED)
def test_lpips_alex_equals_the_published_table(name: str) -> None:
    """IQA-PyTorch's calibration table, on its own images."""
    folder = Path(os.environ.get("REWILD4D_CALIBRATION", "nowhere"))
    if not folder.is_dir():
        pytest.skip("set REWILD4D_CALIBRATION to IQA-PyTorch's folder ResultsCalibra (the wheel pyiqa==0.1.16 has it)")
    need("lpips-alex")
    pair = [
        cv2.cvtColor(cv2.imread(str(folder / f"{side}_dir" / f"{name}.bmp")), cv2.COLOR_BGR2RGB)
        for side in ("dist", "ref")
    ]
    images = [torch.from_numpy(image).permute(2, 0, 1)[None] / 255 for image in pair]
    assert round(float(Lpips("alex")(*images)), 4) == PUBLISHED[name]


def test_lpips_refuses_other_ranges_shapes_and_sizes() -> None:
    need("lpips-alex")
    lpips, image = Lpips("alex"), torch.rand(1, 3, 32, 40)
    with pytest.raises(ValueError, match=r"expected values in \[0, 1\], got -1 to"):
        lpips(image, torch.cat((torch.full((1, 3, 32, 1), -1.0), image[..., 1:]), 3))
    with pytest.raises(ValueError, match=r"one shape \[B, 3, H, W\], got \(1, 3, 32, 40\) and \(1, 3, 32, 39\)"):
        lpips(image, image[..., :39])
    with pytest.raises(ValueError, match="at least 31x31 pixels for LPIPS-alex, got 40x30"):
        lpips(image[..., :30, :], image[..., :30, :])
    assert float(lpips(image[..., :31, :31], image[..., :31, :31])) == 0.0
    with pytest.raises(ValueError, match="expected a trunk out of alex, vgg, got squeeze"):
        Lpips("squeeze")  # type: ignore[arg-type]


CONSTANT = {
    0: (0.12192464619874954, 19.638662338256836, (0.9087916612625122, 0.0, 0.04996304214000702)),
    128: (0.09833367168903351, 13.036506652832031, (0.4926687479019165, 0.028346434235572815, 0.10596884042024612)),
    255: (0.09604606032371521, 13.051188468933105, (0.14850078523159027, 0.0, 0.058375969529151917)),
}
RAMP = (0.19550593197345734, 18.039949417114258, (0.8856359124183655, 0.03009587526321411, 0.023699043318629265))


def assert_features(found: Tensor, mean: float, length: float, first: tuple[float, ...]) -> None:
    assert found.shape == (1, 2048)
    # Ninety layers in single precision: between threads the last digit differs, between AVX2 and AVX-512 1.5e-6.
    assert [float(found.double().mean()), float(found.double().norm())] == pytest.approx([mean, length], rel=1e-5)
    assert found[0, :3].tolist() == pytest.approx(first, abs=1e-5)


@pytest.mark.parametrize("how", ["clean", "tf1", "bilinear-antialias"])
def test_inception_gives_the_recorded_features(how: str) -> None:
    need("inception-fid")
    extractor = InceptionFeatures(how)
    for pixel, recorded in CONSTANT.items():
        size = 299 if how == "clean" else 40  # a constant stays constant under every resize
        assert_features(extractor(torch.full((1, 3, size, size), pixel / 255)), *recorded)


def test_inception_gives_the_recorded_features_of_a_ramp() -> None:
    """The ramp of 64 pixels, stretched by plain bilinear interpolation, not rounded to 8 bits."""
    pixels = F.interpolate(ramp(64), (299, 299), mode="bilinear", align_corners=False) * 255
    with exact_float32():
        assert_features(Inception(need("inception-fid").tensors)((pixels - 128) / 128), *RAMP)


def test_inception_reads_a_rendering_as_its_png() -> None:
    need("inception-fid")
    extractor, image = InceptionFeatures(tap=64), torch.rand(2, 3, 50, 70, generator=torch.Generator().manual_seed(0))
    assert torch.equal(extractor(image), extractor((image * 255).round() / 255))
    assert (extractor.name, extractor.dimension, extractor.resize) == ("inception-fid-64", 64, "clean")
    assert extractor(image).shape == (2, 64)
    torch.testing.assert_close(extractor(image)[1:], extractor(image[1:]), rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="expected a tap out of 64, 192, 768, 2048, got 1000"):
        InceptionFeatures(tap=1000)
    with pytest.raises(ValueError, match="expected a resize out of clean, tf1, bilinear-antialias, got nearest"):
        InceptionFeatures("nearest")
    with pytest.raises(ValueError, match=r"shape \[B, 3, H, W\], got \(2, 1, 50, 70\)"):
        extractor(image[:, :1])


def doctest_images(seed: int) -> tuple[Tensor, Tensor]:
    """The two sets of torchmetrics' doctests, drawn after its network has been built.

    That takes a random number for every weight of the convolutions and of the classifier (1008 classes, with a bias).
    """
    tensors = need("inception-fid").tensors
    drawn = sum(value.numel() for name, value in tensors.items() if name.endswith(".weight")) + (2048 + 1) * 1008
    torch.manual_seed(seed)
    torch.rand(drawn)
    shape = (100, 3, 299, 299)
    return torch.randint(0, 200, shape, dtype=torch.uint8), torch.randint(100, 255, shape, dtype=torch.uint8)


def in_batches(extractor: Callable[[Tensor], Tensor], images: Tensor) -> Tensor:
    return torch.cat([extractor(batch / 255) for batch in images.split(20)]).double()


def test_fid_of_torchmetrics_doctest() -> None:
    """torchmetrics 1.9, FrechetInceptionDistance(feature=64), seed 42: tensor(12.6388)."""
    images = doctest_images(42)
    extractor = InceptionFeatures("bilinear-antialias", tap=64)
    x, y = (in_batches(extractor, part).numpy() for part in images)
    s1, s2 = np.cov(x, rowvar=False), np.cov(y, rowvar=False)
    root = np.sqrt(np.linalg.eigvals(s1 @ s2).real.clip(0)).sum()
    fid = np.square(x.mean(0) - y.mean(0)).sum() + np.trace(s1) + np.trace(s2) - 2 * root
    assert round(float(fid), 4) == 12.6388


@pytest.mark.skipif(
    "REWILD4D_SLOW_TESTS" not in os.environ, reason="200 images of Inception; set REWILD4D_SLOW_TESTS=1"
)
def test_kid_of_torchmetrics_doctest() -> None:
    """torchmetrics 1.9, KernelInceptionDistance(subset_size=50), seed 42: (tensor(0.0312), tensor(0.0025))."""
    images = doctest_images(42)
    state = torch.get_rng_state()
    extractor = InceptionFeatures("bilinear-antialias")
    x, y = (in_batches(extractor, part) for part in images)
    torch.set_rng_state(state)
    values = []
    for _ in range(100):
        f, g = x[torch.randperm(100)[:50]], y[torch.randperm(100)[:50]]
        ff, gg, fg = ((a @ b.T / 2048 + 1) ** 3 for a, b in ((f, f), (g, g), (f, g)))
        within = (ff.sum() - ff.trace() + gg.sum() - gg.trace()) / (50 * 49)
        values.append(float(within - 2 * fg.mean()))
    assert [round(float(np.mean(values)), 4), round(float(np.std(values)), 4)] == [0.0312, 0.0025]


def test_i3d_sets_black_and_white_apart_as_tensorflows() -> None:
    """Squared distance of the logits at T frames; at T = 30 TensorFlow's own network gives 151.39244."""
    need("i3d-k400")
    extractor = I3dFeatures("square")
    for frames, recorded in {
        10: 569.7713012695312,
        16: 152.90162658691406,
        21: 78.25062561035156,
        30: 151.3924,
    }.items():
        black = torch.zeros(1, frames, 3, 8, 8)  # a constant stays constant under every resize
        found = float((extractor(black) - extractor(black + 1)).double().square().sum())
        assert found == pytest.approx(recorded, rel=1e-5)


def test_i3d_says_which_clips_it_cannot_read() -> None:
    need("i3d-k400")
    extractor = I3dFeatures()
    assert (extractor.name, extractor.dimension, extractor.minimum_frames) == ("i3d-k400", 400, 9)
    with pytest.raises(ValueError, match="at least 9 frames a clip for I3D, got 8"):
        extractor(torch.zeros(1, 8, 3, 16, 16))
    with pytest.raises(ValueError, match=r"expected clips of shape \[B, T, 3, H, W\], got \(9, 3, 16, 16\)"):
        extractor(torch.zeros(9, 3, 16, 16))
    with pytest.raises(ValueError, match=r"expected values in \[0, 1\], got 0 to 255"):
        extractor(torch.cat((torch.zeros(1, 9, 3, 16, 16), torch.full((1, 9, 3, 16, 16), 255.0))))
    with pytest.raises(ValueError, match="expected a resize out of short-side-crop, square, got clean"):
        I3dFeatures("clean")
    assert extractor(torch.zeros(1, 9, 3, 20, 16)).shape == (1, 400)


def test_the_pool_by_axes_is_that_of_torch() -> None:
    x = torch.rand(2, 3, 5, 9, 8, generator=torch.Generator().manual_seed(0))
    for window, stride in [
        ((3, 3, 3), (1, 1, 1)),
        ((1, 3, 3), (1, 2, 2)),
        ((2, 2, 2), (2, 2, 2)),
        ((3, 2, 1), (2, 1, 3)),
    ]:
        expected = torch.nn.functional.max_pool3d(i3d_network._pad(x, window, stride), window, stride)
        assert torch.equal(i3d_network._pool(x, window, stride), expected), (window, stride)


def test_same_padding_puts_the_odd_zero_behind() -> None:
    x = torch.ones(1, 1, 4, 5, 6)
    padded = i3d_network._pad(x, (3, 3, 3), (2, 2, 1))
    assert padded.shape == (
        1,
        1,
        4 + 1,
        5 + 2,
        6 + 2,
    )  # ceil(4/2) = 2 places of 3 need 5; ceil(5/2) = 3 need 7; 6 need 8
    assert bool((padded[0, 0, 0, 1:6, 1:7] == 1).all())
    assert float(padded.sum()) == 4 * 5 * 6


def test_folded_normalisation_is_the_normalisation() -> None:
    generator = torch.Generator().manual_seed(1)
    unit = {"u.weight": torch.randn(4, 3, 1, 3, 3, generator=generator)}
    unit |= {f"u.{part}": torch.rand(4, generator=generator) + 0.5 for part in ("mean", "variance", "beta")}
    folded = i3d_network._fold_normalisation({**unit, "Logits.weight": torch.ones(1), "Logits.bias": torch.ones(1)})
    x = torch.randn(2, 3, 4, 6, 6, generator=generator)
    apart = normalise(unit, "u", F.conv3d(x, unit["u.weight"]))
    torch.testing.assert_close(F.conv3d(x, folded["u.weight"], folded["u.bias"]).relu(), apart, rtol=1e-5, atol=1e-5)


def test_tf32_is_off_inside_and_as_it_was_outside() -> None:
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    torch.backends.cudnn.allow_tf32 = True
    try:
        with exact_float32():
            assert not torch.backends.cudnn.allow_tf32 and not torch.is_grad_enabled()
        assert torch.backends.cudnn.allow_tf32 and torch.is_grad_enabled()
    finally:
        torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


def test_ranges_are_checked() -> None:
    check_range(torch.tensor([-0.0005, 1.0005]))
    for bad in (torch.tensor([0.0, 2.0]), torch.tensor([-1.0, 1.0]), torch.tensor([0.5, float("nan")])):
        with pytest.raises(ValueError, match=r"expected values in \[0, 1\], got"):
            check_range(bad)
    with pytest.raises(ValueError, match=r"at least one image, got a tensor of shape \(0, 3, 4, 4\)"):
        check_range(torch.zeros(0, 3, 4, 4))


@pytest.mark.parametrize(
    ("how", "pillow"), [("clean", Image.Resampling.BICUBIC), ("bilinear-antialias", Image.Resampling.BILINEAR)]
)
@pytest.mark.parametrize("shape", [(400, 330), (64, 100)])
def test_resizes_are_pillows_on_floats(how: str, pillow: Image.Resampling, shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).uniform(0, 255, shape).astype(np.float32)
    oracle = np.asarray(Image.fromarray(image).resize((299, 299), pillow))
    found = resize_images(torch.from_numpy(image)[None, None], 299, how)[0, 0].numpy()
    assert np.abs(found - oracle).max() < 255 * 2e-5


def test_tf1_resize_reads_positions_without_half_pixels() -> None:
    image = torch.rand(1, 1, 5, 7, generator=torch.Generator().manual_seed(0)).double()
    found = resize_images(image, 4, "tf1")[0, 0]
    for row in range(4):
        for column in range(4):
            y, x = row * 5 / 4, column * 7 / 4
            top, left = int(y), int(x)
            bottom, right = min(top + 1, 4), min(left + 1, 6)
            upper = image[0, 0, top, left] * (1 - x + left) + image[0, 0, top, right] * (x - left)
            lower = image[0, 0, bottom, left] * (1 - x + left) + image[0, 0, bottom, right] * (x - left)
            assert float(found[row, column]) == pytest.approx(
                float(upper * (1 - y + top) + lower * (y - top)), rel=1e-6
            )


def test_the_short_side_is_scaled_and_the_centre_cropped() -> None:
    frames = torch.linspace(0, 1, 400).expand(2, 3, 200, 400)
    cropped = resize_clip(frames, 100, "short-side-crop")  # half the size, then columns 50..149 of 200
    assert cropped.shape == (2, 3, 100, 100)
    assert float(cropped[0, 0, 0, 0]) == pytest.approx((100 + 101) / 2 / 399, abs=1e-6)
    torch.testing.assert_close(resize_clip(frames.mT, 100, "short-side-crop"), cropped.mT)
    assert float(resize_clip(frames, 100, "square")[0, 0, 0, 0]) == pytest.approx((1 + 2) / 2 / 399, abs=1e-6)


class Brightness:
    """An extractor of one's own: nothing is inherited, nothing registered."""

    name, digest, dimension, resize, minimum_frames = "brightness", "none", 1, "none", 1

    def __call__(self, images: Tensor) -> Tensor:
        return images.flatten(1).mean(1, keepdim=True)


def test_an_extractor_of_ones_own_fits() -> None:
    image: ImageExtractor = Brightness()
    video: VideoExtractor = Brightness()
    assert image(torch.full((2, 3, 4, 4), 0.25)).tolist() == [[0.25], [0.25]]
    assert video(torch.ones(1, 2, 3, 4, 4)).shape == (1, video.dimension)


def test_without_weights_every_network_says_how_to_get_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(name: str) -> LoadedWeights:
        raise WeightsMissing

    monkeypatch.setattr(features, "load_weights", nowhere)
    for build in (InceptionFeatures, I3dFeatures, lambda: Lpips("alex"), lambda: Lpips("vgg")):
        with pytest.raises(WeightsMissing, match="weights missing, run: rewild4d-bench weights fetch"):
            build()
