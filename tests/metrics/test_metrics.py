"""Known images, arithmetic a reader can check in the head, and an independent implementation."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from rewild4d.metrics.image import PSNR_CAP, Box, crop_to_box, fill_outside, mask_box, psnr, ssim
from rewild4d.metrics.silhouette import boundary_f, mask_dice, mask_iou


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


def noisy_pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    a = rng.random((height, width, 3))
    return a, np.clip(a + 0.2 * rng.standard_normal(a.shape), 0, 1)


def as_batch(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None]


def test_masked_ssim_is_the_mean_of_scikit_images_map() -> None:
    a, b = noisy_pair(40, 52)
    b[:, 30:] = a[:, 30:]  # the shortcut for equal regions must not move the mean
    _, whole = structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1, full=True
    )
    mask = np.zeros((40, 52), dtype=bool)
    mask[2:30, 20:45] = True
    inside = np.zeros_like(mask)
    inside[5:-5, 5:-5] = mask[5:-5, 5:-5]  # a window must fit into the image
    ours = ssim(as_batch(a), as_batch(b), torch.from_numpy(mask)[None, None])
    assert float(ours) == pytest.approx(whole[inside].mean(), abs=1e-9)
    everywhere = torch.ones(1, 1, 40, 52, dtype=torch.bool)
    assert float(ssim(as_batch(a), as_batch(b), everywhere)) == float(ssim(as_batch(a), as_batch(b)))


def test_masked_ssim_without_a_window_is_no_number() -> None:
    a, b = (as_batch(image) for image in noisy_pair(20, 20))
    border = torch.zeros(1, 1, 20, 20, dtype=torch.bool)
    border[..., :5, :] = True
    assert torch.isnan(ssim(a, b, border)).all()
    assert torch.isnan(ssim(a, a, border)).all()
    border[..., 10, 10] = True
    assert float(ssim(a, a, border)) == 1.0


def test_union_mask_punishes_an_animal_that_is_too_large() -> None:
    target, truth = torch.zeros(1, 3, 20, 20), torch.zeros(1, 1, 20, 20, dtype=torch.bool)
    truth[..., :10, :10] = True  # 100 pixels, all right
    grown = torch.zeros_like(truth)
    grown[..., :10, :20] = True  # 100 more that should be background, each wrong by one
    prediction = target + (grown & ~truth)
    assert float(psnr(prediction, target, truth)) == PSNR_CAP
    assert float(psnr(prediction, target, truth | grown)) == pytest.approx(-10 * math.log10(100 / 200))


@pytest.mark.parametrize(
    ("rows", "columns", "box"),
    [
        ((40, 60), (50, 90), (40 - 4, 60 + 4, 50 - 4, 90 + 4)),  # a tenth of the longer side, 40
        ((0, 50), (90, 120), (0, 50 + 5, 90 - 5, 120)),  # cut at the border
        ((50, 52), (60, 61), (51 - 8, 51 + 8, 60 - 7, 61 + 8)),  # grown to 16 around the middle
        ((0, 2), (119, 120), (0, 16, 104, 120)),  # grown, and moved inwards
    ],
)
def test_truth_box(rows: tuple[int, int], columns: tuple[int, int], box: tuple[int, int, int, int]) -> None:
    mask = torch.zeros(1, 100, 120, dtype=torch.bool)
    mask[0, slice(*rows), slice(*columns)] = True
    assert mask_box(mask, margin=0.1, least=16) == Box(*box)


def test_truth_box_of_small_images_and_empty_masks() -> None:
    assert mask_box(torch.zeros(1, 9, 9, dtype=torch.bool)) is None
    assert mask_box(torch.ones(1, 9, 9, dtype=torch.bool)) == Box(0, 9, 0, 9)
    with pytest.raises(ValueError, match=r"expected a mask of shape \[1, H, W\], got \(9, 9\)"):
        mask_box(torch.ones(9, 9, dtype=torch.bool))


def test_crop_serves_every_metric_and_fill_leaves_the_inside() -> None:
    image = torch.arange(2 * 3 * 6 * 7, dtype=torch.float32).view(2, 3, 6, 7) / 252
    assert torch.equal(crop_to_box(image, Box(1, 4, 2, 7)), image[:, :, 1:4, 2:7])
    with pytest.raises(ValueError, match="expected a box inside 7x6 pixels"):
        crop_to_box(image, Box(0, 7, 0, 7))
    mask = torch.zeros(2, 1, 6, 7, dtype=torch.bool)
    mask[..., 1:4, 2:7] = True
    filled = fill_outside(image, mask, 0.25)
    assert torch.equal(crop_to_box(filled, Box(1, 4, 2, 7)), crop_to_box(image, Box(1, 4, 2, 7)))
    assert bool((filled[:, :, 0] == 0.25).all())
    assert float(psnr(filled, fill_outside(image.flip(1), mask, 0.25))[0]) > 0


def test_dice_counts_pixels() -> None:
    a, b = torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4)
    a[..., :2, :] = 1.0  # 8 pixels
    b[..., 1:2, :] = 0.5  # 4 pixels, all shared
    assert float(mask_dice(a, b)) == 2 * 4 / (8 + 4)
    assert float(mask_dice(a, torch.zeros_like(a))) == 0.0
    assert torch.isnan(mask_dice(torch.zeros_like(a), torch.zeros_like(a))).all()


def brute_force_boundary_f(prediction: np.ndarray, target: np.ndarray, radius: int) -> float:
    """Every contour pixel against every other, one pixel at a time."""

    def contour(mask: np.ndarray) -> list[tuple[int, int]]:
        height, width = mask.shape
        found = []
        for i in range(height):
            for j in range(width):
                beside = [(i, j + 1), (i + 1, j), (i + 1, j + 1)]
                inside = [(min(r, height - 1), min(c, width - 1)) for r, c in beside]
                if any(mask[i, j] != mask[place] for place in inside):
                    found.append((i, j))
        return found

    a, b = contour(prediction), contour(target)
    near = [[(i - k) ** 2 + (j - m) ** 2 <= radius**2 for k, m in b] for i, j in a]
    precision = sum(any(row) for row in near) / len(a)
    recall = sum(any(column) for column in zip(*near, strict=True)) / len(b)
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def test_boundary_f_equals_brute_force() -> None:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:40, :50]
    for _ in range(6):
        blobs = [np.hypot(y - rng.uniform(0, 40), x - rng.uniform(0, 50)) < rng.uniform(5, 20) for _ in range(3)]
        a, b = blobs[0] | blobs[1], blobs[0] | blobs[2]
        ours = boundary_f(*(torch.from_numpy(mask)[None, None].float() for mask in (a, b)), tolerance=0.03)
        radius = math.ceil(0.03 * math.hypot(40, 50))
        assert float(ours) == pytest.approx(brute_force_boundary_f(a, b, radius), abs=1e-12)


@pytest.mark.parametrize(("shift", "matches"), [(0, True), (3, True), (4, False)])
def test_boundary_tolerance_at_256_is_three_pixels(shift: int, matches: bool) -> None:
    a, b = torch.zeros(1, 1, 256, 256), torch.zeros(1, 1, 256, 256)
    a[..., :100], b[..., : 100 + shift] = 1.0, 1.0  # two straight contours, `shift` pixels apart
    assert float(boundary_f(a, b)) == (1.0 if matches else 0.0)


def test_boundary_f_without_a_contour() -> None:
    empty, half, full = torch.zeros(1, 1, 8, 8), torch.zeros(1, 1, 8, 8), torch.ones(1, 1, 8, 8)
    half[..., :4] = 1.0
    assert float(boundary_f(half, empty)) == float(boundary_f(empty, half)) == 0.0
    assert torch.isnan(boundary_f(empty, empty)).all()
    assert torch.isnan(boundary_f(full, full)).all()
