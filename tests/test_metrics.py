"""Known images, arithmetic a reader can check in the head, and an independent implementation."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from rewild4d.metrics.image import PSNR_CAP, psnr, ssim
from rewild4d.metrics.silhouette import mask_iou


@pytest.mark.parametrize("error", [0.5, 0.1, 0.01])
def test_psnr_of_a_constant_error(error: float) -> None:
    target = torch.full((2, 3, 8, 9), 0.3, dtype=torch.float64)
    torch.testing.assert_close(psnr(target + error, target), torch.full((2,), -20 * math.log10(error)).double())


def test_psnr_is_one_value_per_image_not_of_the_mean_error() -> None:
    target = torch.zeros(2, 3, 4, 4)
    prediction = torch.stack((torch.full((3, 4, 4), 0.1), torch.full((3, 4, 4), 0.01)))
    torch.testing.assert_close(psnr(prediction, target), torch.tensor((20.0, 40.0)).double(), atol=1e-5, rtol=0)


def test_identical_images_are_capped() -> None:
    image = torch.rand(1, 3, 5, 5)
    assert float(psnr(image, image)) == PSNR_CAP == 100.0


def test_masked_psnr_does_not_move_when_the_background_grows() -> None:
    target = torch.rand(1, 3, 10, 10, generator=torch.Generator().manual_seed(1))
    prediction, mask = (target + 0.2).clamp(0, 1), torch.zeros(1, 1, 10, 10, dtype=torch.bool)
    mask[..., 3:6, 3:6] = True
    pad = (20, 20, 20, 20)
    grown = psnr(*(torch.nn.functional.pad(x, pad) for x in (prediction, target)), torch.nn.functional.pad(mask, pad))
    torch.testing.assert_close(grown, psnr(prediction, target, mask))


def test_full_frame_is_foreground_minus_coverage() -> None:
    target, mask = torch.zeros(1, 3, 10, 10), torch.zeros(1, 1, 10, 10, dtype=torch.bool)
    mask[..., :2, :5] = True  # 10 of 100 pixels
    prediction = target + 0.1 * mask
    assert float(psnr(prediction, target, mask)) == pytest.approx(20.0, abs=1e-5)
    assert float(psnr(prediction, target)) == pytest.approx(20.0 - 10 * math.log10(10 / 100), abs=1e-5)


def test_psnr_without_a_counted_pixel_is_no_number() -> None:
    image = torch.rand(1, 3, 4, 4)
    assert torch.isnan(psnr(image, image, torch.zeros(1, 1, 4, 4, dtype=torch.bool))).all()


def test_shapes_are_named_in_errors() -> None:
    with pytest.raises(ValueError, match=r"one shape \[B, C, H, W\], got \(1, 3, 4, 4\) and \(1, 3, 4, 5\)"):
        psnr(torch.zeros(1, 3, 4, 4), torch.zeros(1, 3, 4, 5))
    with pytest.raises(ValueError, match=r"expected a mask of shape \(1, 1, 4, 4\), got \(1, 3, 4, 4\)"):
        psnr(torch.zeros(1, 3, 4, 4), torch.zeros(1, 3, 4, 4), torch.zeros(1, 3, 4, 4))
    with pytest.raises(ValueError, match="at least 11x11 pixels for SSIM, got 20x10"):
        ssim(torch.zeros(1, 3, 10, 20), torch.zeros(1, 3, 10, 20))


def test_ssim_equals_scikit_image() -> None:
    rng = np.random.default_rng(0)
    for height, width in ((11, 11), (32, 47), (64, 40)):
        a = rng.random((height, width, 3))
        b = np.clip(a + 0.2 * rng.standard_normal(a.shape), 0, 1)
        if min(height, width) > 11:
            a[: height // 2] = b[: height // 2] = 1.0
        oracle = structural_similarity(
            a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
        )
        ours = ssim(*(torch.from_numpy(x).permute(2, 0, 1)[None] for x in (a, b)))
        assert float(ours) == pytest.approx(oracle, abs=1e-9)


def test_iou_counts_pixels() -> None:
    a, b = torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4)
    a[..., :2, :] = 1.0  # 8 pixels
    b[..., 1:3, :] = 0.5  # 8 pixels, 4 shared
    assert float(mask_iou(a, b)) == 4 / 12
    assert float(mask_iou(a, torch.zeros_like(a))) == 0.0
    assert torch.isnan(mask_iou(torch.zeros_like(a), torch.zeros_like(a))).all()
