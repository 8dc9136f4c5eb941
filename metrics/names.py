"""Names of all scores that a protocol may ask for, with their units.

The name of an image score is a metric and a region: "psnr", "ssim_fg", "lpips_alex_crop"; without a region it covers
the full frame; "_rigid" behind it says that a rigid motion laid the reconstruction on the true shape first. The name of
a geometry score is a quantity, an alignment, a sampling of the prediction and a number of points. What other papers
define otherwise has a name of its own (`metrics.definitions`): "psnr_black", "pck@0.1_mask_area_bones".
"""

from typing import Literal

from rewild4d.metrics.definitions import NAMES as DEFINED

REGIONS = ("full", "fg", "union", "crop")
COLOR_METRICS = {
    "psnr": ("dB", "higher"), "ssim": ("1", "higher"), "lpips_alex": ("1", "lower"), "lpips_vgg": ("1", "lower"),
}  # fmt: skip
"""Metric -> its unit, and which way is better."""
SILHOUETTES = ("iou", "dice", "boundary_f")
RIGID = "_rigid"
"""End of the name of an image score: rendered after a rigid motion that lays the shape on the truth."""
IMAGES = (*(m if r == "full" else f"{m}_{r}" for m in COLOR_METRICS for r in REGIONS), *SILHOUETTES)
HELD_OUT = (*IMAGES, *(name + RIGID for name in IMAGES))
SCALE = "camera_scale"
"""The one scale about the input camera by which a reconstruction is laid on the truth: a figure, not a rating."""

THRESHOLDS = (1, 2, 5)
"""F-scores, in percent of the rest pose's diagonal."""
Fit = Literal["sequence", "frame", "none"]
ALIGNMENTS: dict[Fit, str] = {"sequence": "", "frame": "_framewise", "none": "_unaligned"}
"""Alignment of predictions to the truth (see `metrics.geometry`) -> end of the score's name."""
SAMPLINGS = ("", "_drawn")
"""End of a name: points of the prediction are centres of Gaussians, or lie on the surface that these draw."""
DENSE = {"": None, "_30k": 30_000}
"""End of a name -> points of each cloud; None is the protocol's own number."""
QUANTITIES = ("chamfer", "chamfer_to_truth", "chamfer_to_prediction", "chamfer_relative") + tuple(
    f"fscore_{percent}" for percent in THRESHOLDS
)
GEOMETRY = tuple(
    quantity + end + sampling + dense
    for dense in DENSE for sampling in SAMPLINGS for end in ALIGNMENTS.values() for quantity in QUANTITIES
)  # fmt: skip

KINDS = {
    "kid_v": {"kid_v": "KID-V"},
    "fvd_f": {"fvd_f": "FVD-F", "kvd_f": "KVD-F"},
    "fvd_diag": {"fvd_diag": "FVD-Diag", "kvd_diag": "KVD-Diag"},
}
"""Kind of sets -> its scores, in the order of `metrics.sets.distances`, and the title of each distance."""
SETS = tuple(name for scores in KINDS.values() for name in scores)

FILM = tuple(name for name in DEFINED if name not in IMAGES)
"""Scores of a film as other papers define them (`metrics.definitions`)."""

ALL = (*HELD_OUT, SCALE, *GEOMETRY, *SETS, *FILM)


def split_name(name: str) -> tuple[str, str]:
    """Split an image score's name into metric and region.

    Examples:
        >>> split_name("lpips_alex_fg"), split_name("psnr"), split_name("psnr_rigid")
        (('lpips_alex', 'fg'), ('psnr', 'full'), ('psnr', 'full'))
    """
    name = name.removesuffix(RIGID)
    metric, _, region = name.rpartition("_")
    return (metric, region) if region in REGIONS else (name, "full")


def geometry_unit(name: str) -> tuple[str, str]:
    """Return a geometry score's unit ("world" is the clouds' own), and which way is better.

    Examples:
        >>> geometry_unit("chamfer_relative_framewise"), geometry_unit("fscore_1")
        (('1', 'lower'), ('1', 'higher'))
    """
    if name.startswith("fscore"):
        return "1", "higher"
    return ("1" if name.startswith("chamfer_relative") else "world"), "lower"
