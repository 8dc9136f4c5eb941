"""Score anybody's results: two folders of images or of clips."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from rewild4d.datasets.video.footage import open_footage
from rewild4d.datasets.video.video_file import video_facts
from rewild4d.evaluation.image_scores import (
    measure,
    needs,
    summarize,
    without_value,
)
from rewild4d.evaluation.networks import FAMILIES, Networks, family_of
from rewild4d.evaluation.pairing import Inputs, Match, iterate_pairs, match_inputs, on_background
from rewild4d.evaluation.reports import SCHEMA, Report
from rewild4d.machine import code_version, machine
from rewild4d.metrics.caching import CachedNetwork
from rewild4d.metrics.distribution import kid
from rewild4d.metrics.names import IMAGES
from rewild4d.metrics.samples import Conditions, Distance, Images, Progress, image_features
from rewild4d.metrics.score import Score
from rewild4d.metrics.video import clip_distances

NO_MATTE = ("no true masks: name them with --masks", "no predicted masks: name them with --pred-masks")
PAIRED = "takes the sets for independent, but they are paired: near a perfect prediction it is negative, KID-u is zero"
ONE_SIDED = {
    (True, False): "the predictions have alpha, the truths have none: see that they lie on the same background",
    (False, True): "the truths have alpha, the predictions have none: see that they lie on the same background",
}

Stage = Callable[[str], Progress]
"""Start a stage by its title, and return its progress function."""


@torch.no_grad()
def score_pictures(
    inputs: Inputs,
    *,
    networks: Networks,
    families: Sequence[str] = FAMILIES,
    background: float = 1.0,
    fps: float | None = None,
    paired: bool = True,
    device: torch.device,
    stage: Stage,
) -> Report:
    """Score images or clips against true ones.

    Args:
        inputs: the paths.
        networks: of the learned metrics; see `networks.load_networks`.
        families: which of `FAMILIES`.
        background: grey level in [0, 1] behind every image that has alpha.
        fps: of clips whose files do not say it.
        paired: whether each prediction belongs to one truth; if not, only distances between the sets are computed.
        device: that the networks compute on, for the record.
        stage: shows progress.

    Raises:
        UserError: a path, an image or a mask that cannot be used.
    """
    started = time.monotonic()
    prediction, truth = (open_footage(path) for path in (inputs.prediction, inputs.truth))
    scores: dict[str, Score] = {}
    items: list[str] = []
    notes: list[str] = []
    sides = [prediction.reels, truth.reels]
    if paired:
        matches, notes = match_inputs(inputs, prediction, truth)
        scores, items, seen = image_scores(matches, families, networks, background, stage("images"))
        notes += seen
        sides[0] = tuple(match.prediction for match in matches)
    rates = {reel.fps for side in sides for reel in side if reel.fps} or ({fps} if fps else set())
    reels = (reel for side in sides for reel in side if not reel.files)
    notes += [f"{reel.path}: {told}" for reel in reels for told in video_facts(reel.path).changes]
    if len(rates) > 1:
        notes.append(f"frame rates differ: {', '.join(f'{rate:g}' for rate in sorted(rates))}")
    conditions = Conditions(f"{background:g} behind alpha", fps=min(rates) if len(rates) == 1 else None)
    shown = [[on_background(reel, background) for reel in side] for side in sides]
    distances = image_distances(shown, paired, families, networks, conditions, stage)
    if truth.clips and prediction.clips:
        distances += video_distances(shown, paired, families, networks, conditions, stage)
    return Report(
        schema=SCHEMA,
        kind="clips" if truth.clips else "images",
        inputs={name: str(path) for name, path in vars(inputs).items() if isinstance(path, Path)},
        settings={"background": conditions.background} | ({"fps": f"{conditions.fps:g}"} if conditions.fps else {}),
        scores=scores,
        distances=distances,
        networks={name: network.digest for name, network in networks.lpips.items()}
        | {distance.extractor: distance.digest for distance in distances if distance.value is not None},
        items=items,
        notes=notes,
        code=code_version(),
        machine=machine(device, "none"),
        seconds=round(time.monotonic() - started, 3),
    )


def image_scores(
    matches: Sequence[Match], families: Sequence[str], networks: Networks, background: float, progress: Progress
) -> tuple[dict[str, Score], list[str], list[str]]:
    """Compute scores by name, the label of each image, and warnings."""
    names = [name for name in IMAGES if family_of(name) in families]
    reasons = {name: networks.missing.get(family_of(name), "") for name in names}
    values: dict[str, list[float | None]] = {name: [] for name in names if not reasons[name]}
    # Two pairs: the union of two images with alpha is the full frame.
    lpips = {name: CachedNetwork(network, 2) for name, network in networks.lpips.items()}
    total, labels = sum(len(match.truth) for match in matches), list[str]()
    alphas, mattes = set[tuple[bool, bool]](), set[int]()
    for label, shown, alpha in iterate_pairs(matches, background):
        alphas.add(alpha)
        mattes |= {side for side, matte in enumerate((shown.truth_matte, shown.prediction_matte)) if matte is not None}
        for name in values:
            values[name] += measure(name, shown, lpips)
        labels.append(label)
        progress(len(labels), total)
    scores = {}
    for name in names:
        absent = [NO_MATTE[side] for side, needed in enumerate(needs(name)) if needed and side not in mattes]
        reason = next(filter(None, [*absent, reasons[name]]), "")
        scores[name] = without_value(name, reason) if reason else summarize(name, values[name])
    return scores, labels, [ONE_SIDED[alpha] for alpha in ONE_SIDED if alpha in alphas]


def image_distances(
    shown: Sequence[Sequence[Images]], paired: bool, families: Sequence[str], networks: Networks,
    conditions: Conditions, stage: Stage,
) -> list[Distance]:  # fmt: skip
    """Compute KID of all images of the two sides, and KID-u where they are paired; a clip is a sequence."""
    if "kid" not in families:
        return []
    if networks.images is None:
        counts = [sum(map(len, side)) for side in shown]
        return [_absent(name, counts, networks.missing["kid"], conditions) for name in ("KID", "KID-u")[: 1 + paired]]
    x, y = (
        image_features(side, networks.images, stage(f"KID, {title}"))
        for side, title in zip(_numbered(shown, paired), ("predictions", "truths"), strict=True)
    )
    found = kid(x, y, conditions=conditions)
    if not paired:
        return [found]
    beware = "; ".join(filter(None, (found.note, PAIRED)))
    return [replace(found, note=beware), kid(x, y, paired=True, conditions=conditions)]


def _numbered(shown: Sequence[Sequence[Images]], paired: bool) -> Sequence[Sequence[Images]]:
    """Number unpaired truths after the predictions, for they are other sequences."""
    prediction, truth = shown
    return shown if paired else (prediction, [*([] for _ in prediction), *truth])


def video_distances(
    shown: Sequence[Sequence[Images]], paired: bool, families: Sequence[str], networks: Networks,
    conditions: Conditions, stage: Stage,
) -> list[Distance]:  # fmt: skip
    """Compute FVD, KVD and their companions, each clip a sequence of its own."""
    if "fvd" not in families:
        return []
    if networks.videos is None:
        counts = [len(side) for side in shown]
        return [_absent(name, counts, networks.missing["fvd"], conditions) for name in ("FVD", "KVD")]
    prediction, truth = ([[clip] if len(clip) else [] for clip in side] for side in _numbered(shown, paired))
    return clip_distances(
        prediction, truth, networks.videos, paired=paired, conditions=conditions, progress=stage("FVD")
    )


def _absent(name: str, counts: Sequence[int], reason: str, conditions: Conditions) -> Distance:
    """Return a distance without a value, for want of a network."""
    return Distance(
        name=name, value=None, n=counts[0], m=counts[1], sequences=0, estimator="", interval=None,
        note=f"not computed: {reason}", extractor="", digest="", resize="", frames=None, **vars(conditions),
    )  # fmt: skip
