"""Compute distances between two sets of clips by the features of a video network: FVD, FVD-F, FVD-Diag, KVD, I3D-dist.

An image matrix `M[v][f]` holds view v at frame f of one sequence. The names are SV4D's (Xie et al. 2025, sec. 4), who
released no code for them; definitions that the paper leaves open are fixed here:
  FVD-F     one clip a view: M[v, :]
  FVD-Diag  one clip a start view: M[(v0 + i) mod V, i], the camera advancing one view a frame around a closed orbit
All clips of all sequences are pooled into one distance, which publishes n, m and T. FVD (Unterthiner et al. 2018) is
dominated by bias below a few hundred clips; the kernel distance on the same features (KVD) is unbiased in n.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from rewild4d.metrics.distribution import frechet, kid, require_finite
from rewild4d.metrics.samples import (
    Conditions,
    Distance,
    Features,
    Images,
    Progress,
    VideoExtractor,
    describe,
    not_computed,
    require_image,
)

I3D_DIST = "I3D-dist (paired, N=1)"
FEW_CLIPS = 64
"""With fewer clips a side the note warns of KVD's noise."""


class ImageMatrix(Protocol):
    """`M[v][f]`, an image [3, H, W] in [0, 1]: a tensor [V, F, 3, H, W], a list of clips, or a lazy reader."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Images: ...


@dataclass(frozen=True)
class MatrixClip:
    """A clip through an image matrix, read image by image: frame i is `matrix[views[i]][i]`."""

    matrix: ImageMatrix
    views: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int, /) -> Tensor:
        return self.matrix[self.views[index]][index]


def frame_clips(matrix: ImageMatrix) -> list[MatrixClip]:
    """Return the clips of FVD-F: every view over all frames, M[v, :].

    Examples:
        >>> [clip.views for clip in frame_clips(torch.zeros(2, 3, 3, 4, 4))]
        [(0, 0, 0), (1, 1, 1)]
    """
    views, frames = _matrix_size(matrix)
    return [MatrixClip(matrix, (view,) * frames) for view in range(views)]


def diagonal_clips(matrix: ImageMatrix) -> list[MatrixClip]:
    """Return the clips of FVD-Diag: one view further a frame, M[(v0 + i) mod V, i]; the orbit must close.

    Examples:
        >>> [clip.views for clip in diagonal_clips(torch.zeros(2, 3, 3, 4, 4))]
        [(0, 1, 0), (1, 0, 1)]
    """
    views, frames = _matrix_size(matrix)
    return [MatrixClip(matrix, tuple((start + i) % views for i in range(frames))) for start in range(views)]


def video_features(
    sequences: Sequence[Sequence[Images]], extractor: VideoExtractor, progress: Progress | None = None
) -> Features:
    """Compute the features of every clip; one clip is in memory at a time.

    Args:
        sequences: the clips of each sequence; every clip has T images [3, H, W] in [0, 1].
        extractor: [B, T, 3, H, W] in [0, 1] -> [B, D].
        progress: called after every clip.

    Raises:
        ValueError: clips of differing or too small T, or an image that `require_image` refuses.

    Examples:
        >>> from rewild4d.metrics.samples import MeanColor
        >>> found = video_features([[torch.zeros(5, 3, 4, 4)], [torch.ones(5, 3, 4, 4)]], MeanColor())
        >>> found.values[:, 0].tolist(), found.frames
        ([0.0, 1.0], 5)
    """
    if reason := incomparable(sequences, sequences, extractor):
        raise ValueError(reason)
    rows, groups = [], []
    total = sum(map(len, sequences))
    for group, clips in enumerate(sequences):
        for clip in clips:
            video = torch.stack([require_image(clip[i]) for i in range(len(clip))])
            rows.append(extractor(video[None]).double().cpu())
            groups.append(group)
            if progress is not None:
                progress(len(rows), total)
    values = torch.cat(rows) if rows else torch.zeros(0, 0, dtype=torch.float64)
    frames = next((len(clip) for clips in sequences for clip in clips), None)
    ids = torch.tensor(groups, dtype=torch.int64)
    return Features(values, ids, extractor.name, extractor.digest, extractor.resize, frames)


def incomparable(
    prediction: Sequence[Sequence[Images]], truth: Sequence[Sequence[Images]], extractor: VideoExtractor
) -> str:
    """Return why a network cannot compare two sets of clips, or "": lengths have to be equal."""
    lengths = sorted({len(clip) for side in (prediction, truth) for clips in side for clip in clips})
    if len(lengths) > 1:
        found = ", ".join(map(str, lengths))
        return f"not computed: clips of {found} frames, and only equal lengths compare"
    if lengths and lengths[0] < extractor.minimum_frames:
        return f"not computed: clips of {lengths[0]} frames, and {extractor.name} needs {extractor.minimum_frames}"
    return ""


def clip_distances(
    prediction: Sequence[Sequence[Images]],
    truth: Sequence[Sequence[Images]],
    extractor: VideoExtractor,
    *,
    paired: bool,
    suffix: str = "",
    conditions: Conditions = Conditions(),
    progress: Progress | None = None,
    seed: int = 0,
) -> list[Distance]:
    """Compute FVD and KVD of two sets of clips, and where they are paired KVD-u and I3D-dist.

    Args:
        prediction: the clips of each sequence, all of one length T.
        truth: the same; with ``paired``, clip by clip the truth of the prediction.
        extractor: [B, T, 3, H, W] in [0, 1] -> [B, D]; it runs once a clip.
        paired: whether the clips belong together (same cameras, same times).
        suffix: added to FVD and KVD ("-F", "-Diag").
        conditions: background, crop and fps that both sets share.
        progress: called after every clip.
        seed: of the bootstrap over sequences.

    Examples:
        >>> from rewild4d.metrics.samples import MeanColor
        >>> black, white = torch.zeros(9, 3, 4, 4), torch.ones(9, 3, 4, 4)
        >>> [one.value for one in clip_distances([[black, black]], [[white, white]], MeanColor(), paired=False)]
        [3.0, 7.0]
    """
    names = [f"FVD{suffix}", f"KVD{suffix}", *([f"KVD{suffix}-u", I3D_DIST] if paired else [])]
    if reason := incomparable(prediction, truth, extractor):
        x, y = (_nothing(clips, extractor) for clips in (prediction, truth))
        return [describe(name, None, x, y, estimator="", notes=[reason], conditions=conditions) for name in names]
    counts = [sum(map(len, side)) for side in (prediction, truth)]
    x = video_features(prediction, extractor, _shifted(progress, 0, sum(counts)))
    y = video_features(truth, extractor, _shifted(progress, counts[0], sum(counts)))
    return feature_distances(x, y, paired=paired, suffix=suffix, conditions=conditions, seed=seed)


def feature_distances(
    prediction: Features,
    truth: Features,
    *,
    paired: bool,
    suffix: str = "",
    conditions: Conditions = Conditions(),
    seed: int = 0,
) -> list[Distance]:
    """Compute the distances of `clip_distances` from features.

    Args:
        prediction: of the clips, [n, D].
        truth: with ``paired``, row i belongs to row i of the prediction, [m, D].
        paired, suffix, conditions, seed: see `clip_distances`.
    """
    x, y, name = prediction, truth, f"KVD{suffix}"
    found = [
        frechet(x, y, name=f"FVD{suffix}", conditions=conditions),
        kid(x, y, name=name, conditions=conditions, few=FEW_CLIPS, seed=seed),
    ]
    if paired:
        found.append(kid(x, y, paired=True, name=name, conditions=conditions, few=FEW_CLIPS, seed=seed))
        found.append(i3d_dist(x, y, conditions=conditions))
    return found


def fvd_f(
    prediction: Sequence[ImageMatrix], truth: Sequence[ImageMatrix], extractor: VideoExtractor, **settings: Any
) -> list[Distance]:
    """Compute FVD-F and its companions over every view of every image matrix, one matrix a sequence.

    Settings are the keywords of `clip_distances` except the suffix.

    Examples:
        >>> from rewild4d.metrics.samples import MeanColor
        >>> found = fvd_f([torch.zeros(2, 9, 3, 4, 4)], [torch.ones(2, 9, 3, 4, 4)], MeanColor(), paired=False)
        >>> [(one.name, one.value) for one in found]
        [('FVD-F [mean-color]', 3.0), ('KVD-F [mean-color]', 7.0)]
    """
    predicted, true = ([frame_clips(matrix) for matrix in side] for side in (prediction, truth))
    return clip_distances(predicted, true, extractor, suffix="-F", **settings)


def fvd_diag(
    prediction: Sequence[ImageMatrix], truth: Sequence[ImageMatrix], extractor: VideoExtractor, **settings: Any
) -> list[Distance]:
    """Compute FVD-Diag and its companions over every diagonal; the views must be a closed, uniform orbit.

    Settings are the keywords of `clip_distances` except the suffix.
    """
    predicted, true = ([diagonal_clips(matrix) for matrix in side] for side in (prediction, truth))
    return clip_distances(predicted, true, extractor, suffix="-Diag", **settings)


def i3d_dist(prediction: Features, truth: Features, *, conditions: Conditions = Conditions()) -> Distance:
    """Compute the "FVD" of Consistent4D's script (Jiang et al. 2024): one clip a set, clip by clip, then the mean.

    |f - g|^2 + (s_f - s_g)^2 for the features f, g of one pair of clips, s the standard deviation over the features
    themselves (N-1). It is no Fréchet distance of distributions and is not comparable with FVD.

    Args:
        prediction: features of the clips, [n, D].
        truth: row i belongs to row i of the prediction, [n, D].
        conditions: background, crop and fps that both sets share.

    Examples:
        >>> groups = torch.zeros(1, dtype=torch.int64)
        >>> x, y = (Features(torch.full((1, 2), a).double(), groups, "i3d-k400", "", "", 9) for a in (0.0, 1.0))
        >>> i3d_dist(x, y).value
        2.0
    """
    x, y, value = prediction.values, truth.values, None
    if len(x) != len(y):
        raise ValueError(f"expected pairs of clips, got {len(x)} and {len(y)}")
    reason = not_computed(prediction, truth, least=1)
    require_finite(x, y)
    if not reason and x.shape[1] < 2:
        reason = f"not computed: a spread over at least 2 features is needed, got {x.shape[1]}"
    if not reason:
        spread = x.std(1) - y.std(1)
        value = float(((x - y).square().sum(1) + spread.square()).mean())
    return describe(
        I3D_DIST, value, prediction, truth, conditions=conditions, notes=[reason] if reason else [],
        estimator="squared distance of each pair, averaged",
    )  # fmt: skip


def _nothing(sequences: Sequence[Sequence[Images]], extractor: VideoExtractor) -> Features:
    """Return as many empty rows as there are clips, for a result without a value."""
    groups = torch.tensor([group for group, clips in enumerate(sequences) for _ in clips], dtype=torch.int64)
    lengths = {len(clip) for clips in sequences for clip in clips}
    frames = lengths.pop() if len(lengths) == 1 else None
    values = torch.zeros(len(groups), 0, dtype=torch.float64)
    return Features(values, groups, extractor.name, extractor.digest, extractor.resize, frames)


def _shifted(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Return the progress of a part as progress of the whole."""
    return None if progress is None else lambda done, _: progress(before + done, total)


def _matrix_size(matrix: ImageMatrix) -> tuple[int, int]:
    """Count views and frames; ValueError without views, or with views of differing numbers of frames."""
    frames = {len(matrix[view]) for view in range(len(matrix))}
    if len(frames) != 1:
        raise ValueError(f"expected an image matrix with as many frames in every view, got {sorted(frames)}")
    return len(matrix), frames.pop()
