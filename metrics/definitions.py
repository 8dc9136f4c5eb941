"""Definitions behind one name: how papers on animals in videos compute PCK, IoU, PSNR and LPIPS.

The name of each score says the definition, so that two papers' "PCK@0.1" never share a column. Scores of keypoints have
an end that says where the keypoints come from (`KEYPOINT_SOURCES`): "pck@0.1_mask_area_bones".
"""

from typing import NamedTuple

AIM = "Animal-in-Motion, scripts/run_benchmark.py at 904a443"
EQUINE_MOTION = "4DEquine, eval_pose.py at 7f272d8"
EQUINE_LOOKS = "4DEquine, amr/utils/evaluate_metric.py at 7f272d8"
AVATARS = "Animal Avatars, scene_optim/evaluators and losses/loss_utils.py at 4623ecd"
FOUR_D_ANIMAL = "4D-Animal, scene_optim/callbacks/callback_eval.py at febe711"
OURS = "docs/protocols-and-metrics.md"


class Definition(NamedTuple):
    """One way to compute a score.

    Attributes:
        quantity: what papers call it, a column of the table of definitions.
        unit: of its value; "1" for a share.
        better: "higher" or "lower".
        rule: what is computed, as a part of a sentence.
        source: where the definition is from.
    """

    quantity: str
    unit: str
    better: str
    rule: str
    source: str


def _pck(threshold: float, length: str, source: str) -> Definition:
    return Definition(f"PCK@{threshold:g}", "1", "higher", f"PCK@t: distance < t × {length}", source)


_AREA = "sqrt(mask area), mean over all annotated joints of all frames"
_CROP = "side of the square crop, annotated joints, mean over the frames' shares, 0 for a frame without joints"
_BOX = "longer side of the true mask's box, mean over all annotated joints of all frames"

KEYPOINTS = {
    "pck@0.05_mask_area": _pck(0.05, _AREA, AIM),
    "pck@0.1_mask_area": _pck(0.1, _AREA, AIM),
    "pck@0.05_crop": _pck(0.05, _CROP, EQUINE_MOTION),
    "pck@0.1_crop": _pck(0.1, _CROP, EQUINE_MOTION),
    "pck@0.15_crop": _pck(0.15, _CROP, EQUINE_MOTION),
    "pck@0.05_box": _pck(0.05, _BOX, "Yang & Ramanan 2013"),
    "pck@0.1_box": _pck(0.1, _BOX, "Yang & Ramanan 2013"),
    "pck@0.15_box": _pck(0.15, _BOX, "Yang & Ramanan 2013"),
    "mpjve": Definition("MPJVE", "half sides/step", "lower", "MPJVE: |velocity - true one| in [-1, 1]", AIM),
    "accel": Definition(
        "Accel", "sides/s²", "lower", "Accel: |second difference - true one| × fps², fps of the annotated frames",
        EQUINE_MOTION,
    ),
    "accel_at_30fps": Definition(
        "Accel", "sides/s²", "lower", "Accel: |second difference - true one| × 30², whatever the frame rate is",
        EQUINE_MOTION,
    ),
}  # fmt: skip
"""Scores of keypoints; the name is completed by a source."""

KEYPOINT_SOURCES = {
    "bones": "joints of the reconstruction's skeleton",
    "map_other_half": "a convex map of its points; each half of the annotated frames has the map fitted to the other",
    "map_test_frames": "a convex map of its points, fitted to the very frames that are scored",
}

_KT = "KT@t: the first annotated frame's joints to the last by the nearest visible point, then PCK@t by the mask"
TRANSFER = {
    f"kt@{threshold:g}_mask_area": Definition(f"KT@{threshold:g}", "1", "higher", _KT, AIM) for threshold in (0.05, 0.1)
}

_ADJUSTED = "of 100 brightness factors in [0, 2] on the rendered pixels the one of the best pooled PSNR"
_REFLECTED = "on white, border pixels too, with reflected surroundings"
_UNSCALED = "LPIPS on AlexNet fed [0, 1], where it expects [-1, 1]"

PICTURES = {
    "iou": Definition("IoU", "1", "higher", "IoU: mattes ≥ 0.5, mean over frames", OURS),
    "iou_pooled": Definition("IoU", "1", "higher", "IoU: mattes ≥ 0.5, all frames' intersection over all unions", AIM),
    "iou@0.7": Definition("IoU", "1", "higher", "IoU: mattes > 0.7 at 256 pixels, mean over frames", AVATARS),
    "iou@0.7_worst5": Definition(
        "IoU w5", "1", "higher", "IoU w5: mean of the worst 5 % of the frames' IoU@0.7", FOUR_D_ANIMAL
    ),
    "psnr_white": Definition("PSNR", "dB", "higher", "PSNR: whole image on white, mean over frames", OURS),
    "psnr_black": Definition(
        "PSNR", "dB", "higher", "PSNR: whole image at 256 pixels on black, truth cut at 0.7, mean over frames", AVATARS
    ),
    "psnr_black_worst5": Definition(
        "PSNR w5", "dB", "higher", "PSNR w5: mean of the worst 5 % of the frames' PSNR on black", FOUR_D_ANIMAL
    ),
    "psnrm": Definition(
        "PSNRM", "dB", "higher", "PSNRM: pixels of the true mask at 256 pixels, on black, mean over frames", AVATARS
    ),
    "psnr_pooled_white": Definition(
        "PSNR",
        "dB",
        "higher",
        "PSNR: of all frames' mean squared error, on white, truth cut at 0.5",
        EQUINE_LOOKS,
    ),
    "psnr_pooled_white_brightness": Definition(
        "PSNR", "dB", "higher", f"PSNR: of all frames' mean squared error, on white, {_ADJUSTED}", EQUINE_LOOKS
    ),
    "ssim": Definition("SSIM", "1", "higher", "SSIM: whole image on white, mean over frames", OURS),
    "ssim_reflected": Definition("SSIM", "1", "higher", f"SSIM: {_REFLECTED}", EQUINE_LOOKS),
    "ssim_reflected_brightness": Definition("SSIM", "1", "higher", f"SSIM: {_REFLECTED}, {_ADJUSTED}", EQUINE_LOOKS),
    "lpips_alex": Definition("LPIPS", "1", "lower", "LPIPS: AlexNet, whole image on white, mean over frames", OURS),
    "lpips_vgg_black": Definition(
        "LPIPS", "1", "lower", "LPIPS: VGG, whole image at 256 pixels on black, mean over frames", AVATARS
    ),
    "lpips_alex_unscaled": Definition("LPIPS", "1", "lower", f"{_UNSCALED}, on white", EQUINE_LOOKS),
    "lpips_alex_unscaled_brightness": Definition(
        "LPIPS", "1", "lower", f"{_UNSCALED}, on white, {_ADJUSTED}", EQUINE_LOOKS
    ),
}
"""Scores of images."""

NAMES = (*TRANSFER, *PICTURES, *(f"{name}_{source}" for source in KEYPOINT_SOURCES for name in KEYPOINTS))
"""Every full name."""


def definition(name: str) -> Definition:
    """Return the definition behind a score's name.

    Raises:
        KeyError: no such score.

    Examples:
        >>> definition("pck@0.1_mask_area_bones").quantity, definition("psnrm").unit
        ('PCK@0.1', 'dB')
    """
    for end in KEYPOINT_SOURCES:
        if name.endswith(f"_{end}"):
            return KEYPOINTS[name.removesuffix(f"_{end}")]
    return (TRANSFER | PICTURES)[name]
