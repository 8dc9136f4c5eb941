"""How scores are called and printed in tables."""

from collections.abc import Iterable, Mapping

from rewild4d.leaderboard.records import RunRecord
from rewild4d.metrics.names import SCALE
from rewild4d.metrics.score import Score

TITLES = {
    "psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS-alex", "lpips_vgg": "LPIPS-vgg",
    "psnr_fg": "PSNR foreground", "psnr_union": "PSNR union", "psnr_crop": "PSNR crop", "iou": "mask IoU",
    "camera_scale": "scale", "psnr_rigid": "PSNR after rigid motion", "ssim_rigid": "SSIM after rigid motion",
    "lpips_alex_rigid": "LPIPS-alex after rigid motion", "lpips_vgg_rigid": "LPIPS-vgg after rigid motion",
    "iou_rigid": "mask IoU after rigid motion",
    "chamfer_relative": "CD / diagonal", "chamfer_relative_framewise": "CD / diagonal, per frame",
    "chamfer_relative_30k": "CD / diagonal, 30k points", "fscore_1_30k": "F@1 %, 30k points",
    "chamfer_relative_drawn": "CD / diagonal, drawn surface",
    "fscore_1_drawn": "F@1 %, drawn surface", "fscore_2_drawn": "F@2 %, drawn surface",
    "fscore_5_drawn": "F@5 %, drawn surface",
    "fscore_1": "F@1 %", "fscore_2": "F@2 %", "fscore_5": "F@5 %",
    "kid_v": "KID-16V", "fvd_f": "FVD-F", "fvd_diag": "FVD-Diag", "kvd_f": "KVD-F", "kvd_diag": "KVD-Diag",
}  # fmt: skip
DIGITS = {
    "dB": 2,
    "chamfer_relative": 4,
    "chamfer_relative_framewise": 4,
    "chamfer_relative_30k": 4,
    "chamfer_relative_drawn": 4,
    "kid_v": 4,
    "fvd_f": 1,
    "fvd_diag": 1,
    "half sides/step": 4,
    "sides/s²": 1,
}
"""Printed after the point, by the score's name or unit; three for all others."""
LESS_IS_BETTER = ("lpips", "chamfer", "kid", "fvd", "kvd", "mpjve", "accel")
"""Beginnings of such scores' names; asked only where no record says it."""


def known_scores(records: Iterable[RunRecord]) -> dict[str, Score]:
    """Return a score of each name, one with a value where there is any: what unit and direction are asked of."""
    found = [pair for record in records for pair in record.scores.items()]
    return {name: score for name, score in found if score.value is None} | {
        name: score for name, score in found if score.value is not None
    }


def better_of(name: str, known: Mapping[str, Score]) -> str:
    """Tell whether "higher" or "lower" is better: what a known score of that name says, else what the name says.

    Neither ("") for a figure that rates nothing.
    """
    if name == SCALE:
        return ""
    return known[name].better if name in known else "lower" if name.startswith(LESS_IS_BETTER) else "higher"


def digits_of(name: str, unit: str) -> int:
    """Tell how many digits are printed after the point: what the score's name says, else its unit, else three."""
    return DIGITS.get(name, DIGITS.get(unit, 3))
