"""Image scores as single papers compute them: arithmetic, scikit-image, and LPIPS with what its network is fed."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rewild4d.metrics.as_published import (
    brightened,
    brightness_errors,
    brightness_factors,
    for_unscaled_network,
    overlap,
    pooled_psnr,
    psnr_of_rmse,
    smoothed_iou,
    ssim_reflected,
)
from rewild4d.metrics.image import psnr, ssim
from rewild4d.metrics.silhouette import mask_iou

pytestmark = pytest.mark.usefixtures("one_thread")


def images(count: int = 3, side: int = 12, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Predictions and truths on white: the right half is drawn."""
    made = torch.rand(2, count, 3, side, side, generator=torch.Generator().manual_seed(seed)) * 0.9
    made[..., : side // 2] = 1.0
    return made[0], made[1]


def test_the_iou_of_a_sequence_is_not_the_mean_of_its_frames() -> None:
    prediction, target = torch.zeros(2, 1, 4, 4, dtype=torch.bool), torch.zeros(2, 1, 4, 4, dtype=torch.bool)
    target[0], prediction[0, 0, :2] = True, True  # 8 of 16
    target[1, 0, 0, 0] = prediction[1, 0, 0, 0] = True  # 1 of 1
    found = overlap(prediction, target)
    assert found.pooled() == (8 + 1) / (16 + 1) and found.mean_of_frames() == (8 / 16 + 1) / 2
    assert found.per_frame() == mask_iou(prediction.float(), target.float()).tolist()


def test_two_empty_masks_count_nothing_pooled_and_are_one_smoothed() -> None:
    nothing = torch.zeros(1, 1, 4, 4, dtype=torch.bool)
    found = overlap(nothing, nothing)
    assert found.pooled() is None and smoothed_iou(found).tolist() == [1.0]
    assert smoothed_iou(overlap(nothing, ~nothing))[0] == pytest.approx(1e-6 / 16, rel=1e-4)


def test_psnr_of_a_root_mean_square_is_the_usual_one_but_for_its_bound() -> None:
    prediction, target = images()
    assert torch.allclose(psnr_of_rmse(prediction, target), psnr(prediction, target), atol=1e-3)
    assert float(psnr_of_rmse(target[:1], target[:1])) == pytest.approx(20 * math.log10(1 / 1e-6))


def test_psnrm_reads_the_pixels_of_the_mask_alone() -> None:
    target, mask = torch.zeros(1, 3, 10, 10), torch.zeros(1, 1, 10, 10, dtype=torch.bool)
    mask[..., :2, :5] = True  # 10 of 100 pixels
    prediction = target + 0.1 * mask
    assert float(psnr_of_rmse(prediction, target, mask)) == pytest.approx(20, abs=1e-3)
    assert float(psnr_of_rmse(prediction, target)) == pytest.approx(20 - 10 * math.log10(10 / 100), abs=1e-3)
    assert torch.isnan(psnr_of_rmse(prediction, target, torch.zeros_like(mask))).all()


def test_the_background_alone_moves_psnr() -> None:
    alpha = torch.full((1, 1, 4, 4), 0.5)
    color, rgb = alpha * 0.2, torch.full((1, 3, 4, 4), 0.2)  # half transparent where the truth is solid
    black, white = ((color + (1 - alpha) * grey).expand(1, 3, 4, 4) for grey in (0.0, 1.0))
    assert float(psnr_of_rmse(black, rgb)) == pytest.approx(20 * math.log10(1 / 0.1), abs=1e-3)
    assert float(psnr_of_rmse(white, rgb)) == pytest.approx(20 * math.log10(1 / 0.4), abs=1e-3)


def test_the_psnr_of_a_sequence_equals_scikit_image_on_its_frames_together() -> None:
    prediction, target = images()
    squares = float((prediction - target).double().square().sum())
    wanted = peak_signal_noise_ratio(target.double().numpy(), prediction.double().numpy(), data_range=1)
    assert pooled_psnr(squares, target.numel()) == pytest.approx(wanted, abs=1e-6)
    assert pooled_psnr(squares, target.numel()) <= float(psnr(prediction, target).mean())


def test_ssim_with_reflected_borders_equals_scikit_image_on_continued_images() -> None:
    prediction, target = images(side=20)
    for a, b in zip(prediction, target, strict=True):
        padded = (np.pad(x.double().numpy(), ((0, 0), (5, 5), (5, 5)), mode="reflect") for x in (a, b))
        wanted = structural_similarity(
            *padded, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=0
        )
        assert float(ssim_reflected(a[None], b[None])) == pytest.approx(wanted, abs=1e-9)
        assert abs(float(ssim(a[None], b[None])) - wanted) > 0.001  # another number than that of the windows inside


def test_brightness_is_a_factor_that_leaves_white_and_stops_at_one() -> None:
    image = torch.tensor([0.25, 0.75, 1.0]).reshape(1, 1, 1, 3).repeat(1, 3, 1, 1)
    assert brightened(image, 2.0)[0, 0, 0].tolist() == [0.5, 1.0, 1.0]
    red = torch.tensor([1.0, 0.0, 0.0]).reshape(1, 3, 1, 1)  # one channel is one, but the pixel is not white
    assert brightened(red, 0.5).flatten().tolist() == [0.5, 0.0, 0.0]


def test_the_search_finds_the_factor_that_trying_each_image_finds() -> None:
    prediction, target = images()
    found = brightness_errors(prediction, target)
    each = [float((brightened(prediction, float(f)) - target).double().square().sum()) for f in brightness_factors()]
    assert found.tolist() == pytest.approx(each, rel=1e-5)
    parts = brightness_errors(prediction[:1], target[:1]) + brightness_errors(prediction[1:], target[1:])
    assert parts.tolist() == pytest.approx(each, rel=1e-5)


def test_a_prediction_that_is_a_third_too_dark_is_brightened_to_the_truth() -> None:
    _, target = images()
    dark = torch.where(target == 1, target, target * 2 / 3)
    errors = brightness_errors(dark, target)
    assert float(brightness_factors()[int(errors.argmin())]) == pytest.approx(1.5, abs=0.011)
    assert float(errors.min()) < 0.01 * float((dark - target).square().sum())


def test_a_network_that_scales_reads_unscaled_images_as_they_were() -> None:
    seen = []

    def scaling(images: torch.Tensor) -> None:
        """What `lpips` does first."""
        seen.append(images * 2 - 1)

    prediction, _ = images()
    scaling(for_unscaled_network(prediction))
    torch.testing.assert_close(seen[0], prediction)


def test_batches_of_other_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"one shape \[B, 3, H, W\], got \(1, 3, 4, 4\) and \(1, 3, 4, 5\)"):
        psnr_of_rmse(torch.zeros(1, 3, 4, 4), torch.zeros(1, 3, 4, 5))
    with pytest.raises(ValueError, match=r"one shape \[B, 1, H, W\]"):
        overlap(torch.zeros(1, 3, 4, 4, dtype=torch.bool), torch.zeros(1, 3, 4, 4, dtype=torch.bool))
    assert np.isfinite(brightness_factors().numpy()).all()
