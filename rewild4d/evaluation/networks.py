"""Load the networks of learned metrics, or say which weights are missing."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from rewild4d.metrics import names
from rewild4d.metrics.samples import ImageExtractor, VideoExtractor
from rewild4d.metrics.score import Score
from rewild4d.metrics.weights import WeightsMissing, is_here

FAMILIES = ("psnr", "ssim", "lpips-alex", "lpips-vgg", "silhouette", "kid", "fvd")
"""Metrics that `score --only` chooses from."""
NETWORKS = {"lpips-alex": "lpips-alex", "lpips-vgg": "lpips-vgg", "kid": "inception-fid", "fvd": "i3d-k400"}
"""Families with a network -> its weights (`metrics.weights`)."""


class LpipsNetwork(Protocol):
    """Distance of image pairs, such as `rewild4d.metrics.features.Lpips`."""

    digest: str

    def __call__(self, prediction: Tensor, target: Tensor, /) -> Tensor:
        """Two batches [B, 3, H, W] in [0, 1] -> [B]."""


@dataclass(frozen=True)
class Networks:
    """Networks of the learned metrics; any can be a user's own extractor.

    Attributes:
        lpips: "lpips_alex", "lpips_vgg" -> distance of two batches.
        images: of KID, or None.
        videos: of FVD and KVD, or None.
        missing: why one is missing, by family ("lpips-alex", "kid", "fvd").
    """

    lpips: Mapping[str, LpipsNetwork] = field(default_factory=dict)
    images: ImageExtractor | None = None
    videos: VideoExtractor | None = None
    missing: Mapping[str, str] = field(default_factory=dict)


def load_networks(families: Sequence[str], device: torch.device) -> Networks:
    """Load the networks of some families; those without weights are listed in ``missing``.

    Raises:
        UserError: a weight file has other bytes than it should.
    """
    from rewild4d.metrics.features import I3dFeatures, InceptionFeatures, Lpips

    makers: dict[str, Callable[..., Any]] = {
        "lpips-alex": partial(Lpips, "alex"),
        "lpips-vgg": partial(Lpips, "vgg"),
        "kid": InceptionFeatures,
        "fvd": I3dFeatures,
    }
    made: dict[str, Any] = {}
    missing: dict[str, str] = {}
    for family in filter(families.__contains__, makers):
        try:
            made[family] = makers[family](device=device)
        except WeightsMissing as error:
            missing[family] = str(error)
    lpips = {family.replace("-", "_"): made[family] for family in ("lpips-alex", "lpips-vgg") if family in made}
    return Networks(lpips, made.get("kid"), made.get("fvd"), missing)


def family_of(score: str) -> str:
    """Return the family of an image score or of a score of sets, such as "lpips-alex" or "kid"."""
    if score in names.SETS:
        return "kid" if score == "kid_v" else "fvd"
    if score in names.FILM and score.startswith("lpips_"):
        return "-".join(score.split("_")[:2])
    metric, _ = names.split_name(score)
    return "silhouette" if metric in names.SILHOUETTES else metric.replace("_", "-")


def families_of(scores: Iterable[str]) -> list[str]:
    """List the families of networks that scores need."""
    return sorted(NETWORKS.keys() & map(family_of, scores))


def may_be_scored_now(scores: Mapping[str, Score]) -> bool:
    """Tell whether any of a record's scores was left out for want of a network that is here now."""
    missing = str(WeightsMissing())
    families = families_of(
        name for name, score in scores.items() if score.value is None and score.note.endswith(missing)
    )
    return any(is_here(NETWORKS[family]) for family in families)
