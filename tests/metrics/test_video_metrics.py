"""Clips of an image matrix, and distances between sets of them."""

import math

import pytest
import torch
from extractors import LinearVideoNetwork

from rewild4d.cameras.orbit import orbit_cameras
from rewild4d.metrics.distribution import VIEWS, frechet_distance, mmd2_unbiased
from rewild4d.metrics.samples import Conditions, Features
from rewild4d.metrics.video import (
    I3D_DIST,
    clip_distances,
    diagonal_clips,
    frame_clips,
    fvd_diag,
    fvd_f,
    i3d_dist,
    video_features,
)


def numbered(views: int, frames: int) -> torch.Tensor:
    """M[v, f] holds the one colour (v, f, 0), scaled to [0, 1]."""
    matrix = torch.zeros(views, frames, 3, 4, 4)
    matrix[:, :, 0] = torch.arange(views)[:, None, None, None] / 100
    matrix[:, :, 1] = torch.arange(frames)[None, :, None, None] / 100
    return matrix


def random_matrices(count: int, views: int, frames: int, seed: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(views, frames, 3, 8, 8, generator=generator) for _ in range(count)]


def places(clip: object) -> list[tuple[int, int]]:
    """Which (v, f) the images of a clip are."""
    images = [clip[i] for i in range(len(clip))]  # type: ignore[index, arg-type]
    return [tuple(round(100 * float(image[c, 0, 0])) for c in (0, 1)) for image in images]  # type: ignore[misc]


def test_frame_clips_hold_one_view_each() -> None:
    clips = frame_clips(numbered(3, 5))
    assert [places(clip) for clip in clips] == [[(v, f) for f in range(5)] for v in range(3)]


def test_diagonal_clips_advance_one_view_a_frame_and_wrap() -> None:
    clips = diagonal_clips(numbered(3, 5))
    assert places(clips[0]) == [(0, 0), (1, 1), (2, 2), (0, 3), (1, 4)]
    assert places(clips[2]) == [(2, 0), (0, 1), (1, 2), (2, 3), (0, 4)]
    covered = sorted(place for clip in clips for place in places(clip))
    assert covered == [(v, f) for v in range(3) for f in range(5)], "every image once"


def test_fvd_f_is_the_distance_of_the_pooled_clips() -> None:
    network, x, y = LinearVideoNetwork(), random_matrices(5, 3, 10, 0), random_matrices(5, 3, 10, 1)
    fvd, kvd, kvd_u, dist = fvd_f(x, y, network, paired=True, conditions=Conditions("white", "full frame", 24.0))
    values = [network(torch.cat(side)).double() for side in (x, y)]
    assert fvd.value == pytest.approx(frechet_distance(*values), rel=1e-5)
    assert kvd.value == pytest.approx(mmd2_unbiased(*values), rel=1e-4, abs=1e-6)
    assert [d.name for d in (fvd, kvd, kvd_u, dist)] == [
        f"{name} [linear-video]" for name in ("FVD-F", "KVD-F", "KVD-F-u", I3D_DIST)
    ]
    assert (fvd.n, fvd.m, fvd.frames, fvd.sequences, fvd.fps, fvd.background) == (15, 15, 10, 5, 24.0, "white")
    assert "mostly bias" in fvd.note and "fewer than 64" in kvd.note
    assert kvd_u.interval is not None and kvd_u.value is not None
    assert kvd_u.interval[0] <= kvd_u.value <= kvd_u.interval[1]


def test_lazy_matrices_give_the_same_as_tensors() -> None:
    network, x, y = LinearVideoNetwork(), random_matrices(1, 4, 9, 0), random_matrices(1, 4, 9, 1)
    reads: list[tuple[int, int]] = []

    class Row:
        def __init__(self, view: int):
            self.view = view

        def __len__(self) -> int:
            return 9

        def __getitem__(self, frame: int, /) -> torch.Tensor:
            reads.append((self.view, frame))
            return x[0][self.view, frame]

    lazy = [Row(view) for view in range(4)]
    assert fvd_diag([lazy], y, network, paired=False) == fvd_diag(x, y, network, paired=False)
    assert sorted(reads) == [(v, f) for v in range(4) for f in range(9)], "every image is read once"


def test_a_perfect_reconstruction() -> None:
    x = random_matrices(2, 3, 9, 0)
    for distances in (fvd_f, fvd_diag):
        fvd, kvd, kvd_u, dist = distances(x, x, LinearVideoNetwork(), paired=True)
        assert fvd.value == pytest.approx(0, abs=1e-9)
        assert kvd.value is not None and kvd.value < 0 == kvd_u.value == dist.value


def test_the_order_of_frames_counts() -> None:
    x = random_matrices(1, 4, 9, 0)
    backwards = [x[0].flip(1)]
    fvd = fvd_f(x, backwards, LinearVideoNetwork(), paired=False)[0]
    assert fvd.value is not None and fvd.value > 1e-3


@pytest.mark.parametrize(
    ("lengths", "reason"),
    [
        ((8, 8), "not computed: clips of 8 frames, and linear-video needs 9"),
        ((15, 16), "not computed: clips of 15, 16 frames, and only equal lengths compare"),
        ((15, 15), ""),
    ],
)
def test_short_and_unequal_clips(lengths: tuple[int, int], reason: str) -> None:
    x, y = (random_matrices(2, 1, frames, 0) for frames in lengths)
    for distance in fvd_f(x, y, LinearVideoNetwork(), paired=True):
        assert (distance.n, distance.m) == (2, 2)
        assert (distance.value is None) == bool(reason)
        assert reason in distance.note
        assert distance.frames == lengths[0]
    if reason:
        with pytest.raises(ValueError, match="not computed"):
            video_features([x[0], y[0]], LinearVideoNetwork())


def test_one_clip_a_side_has_no_distribution_but_a_paired_distance() -> None:
    network, x, y = LinearVideoNetwork(), random_matrices(1, 1, 9, 0), random_matrices(1, 1, 9, 1)
    fvd, kvd, kvd_u, dist = clip_distances(x, y, network, paired=True)
    for distance in (fvd, kvd, kvd_u):
        assert distance.value is None
        assert distance.note == "not computed: at least 2 samples a side are needed, got 1 and 1"
    f, g = (network(side[0]).double() for side in (x, y))
    expected = (f - g).square().sum() + (f.std() - g.std()) ** 2
    assert dist.value == pytest.approx(float(expected), rel=1e-9)


def test_paired_distance_by_hand_and_averaged() -> None:
    """f = (0, 2), g = (0, 0): |f - g|^2 = 4, s_f = sqrt(2), s_g = 0; an equal pair beside it halves the mean."""
    f, g = (torch.tensor(rows, dtype=torch.float64) for rows in ([[0.0, 2.0], [1, 5]], [[0.0, 0.0], [1, 5]]))
    x, y = (Features(rows, torch.arange(2), "i3d-k400", "", "", 16) for rows in (f, g))
    found = i3d_dist(x, y)
    assert found.value == pytest.approx((4 + math.sqrt(2) ** 2 + 0) / 2)
    assert found.name == "I3D-dist (paired, N=1)"
    with pytest.raises(ValueError, match="expected finite features, got a NaN"):
        i3d_dist(Features(f * math.nan, torch.arange(2), "i3d-k400", "", "", 16), y)
    narrow = [Features(rows[:, :1], torch.arange(2), "i3d-k400", "", "", 16) for rows in (f, g)]
    assert i3d_dist(*narrow).value is None
    assert i3d_dist(*narrow).note == "not computed: a spread over at least 2 features is needed, got 1"


def test_ragged_matrices_are_refused() -> None:
    with pytest.raises(ValueError, match=r"as many frames in every view, got \[4, 5\]"):
        frame_clips([torch.zeros(4, 3, 8, 8), torch.zeros(5, 3, 8, 8)])


def orbit(**changes: object) -> list:  # type: ignore[type-arg]
    settings = {
        "intrinsics": torch.tensor(((100.0, 0, 32), (0, 100, 32), (0, 0, 1))),
        "width": 64,
        "height": 64,
        "up": torch.tensor((0.0, 0.0, 1.0)),
        "ahead": torch.tensor((2.0, 0.0, 5.0)),
    } | changes
    return orbit_cameras(torch.tensor((1.0, 2.0, 3.0)), 4.0, math.pi / 6, **settings)  # type: ignore[arg-type]


def test_orbit_is_uniform_closed_and_looks_at_its_middle() -> None:
    cameras = orbit()
    assert len(cameras) == VIEWS == 16
    center = torch.tensor((1.0, 2.0, 3.0), dtype=torch.float64)
    for i, camera in enumerate(cameras):
        azimuth, level = 2 * math.pi * i / 16, 4 * math.cos(math.pi / 6)
        offset = (level * math.cos(azimuth), level * math.sin(azimuth), 4 * math.sin(math.pi / 6))
        torch.testing.assert_close(camera.center, center + torch.tensor(offset, dtype=torch.float64))
        pixel, depth = camera.project(center)
        torch.testing.assert_close(pixel, torch.tensor((32.0, 32.0), dtype=torch.float64))
        assert float(depth) == pytest.approx(4.0)
        above, _ = camera.project(center + torch.tensor((0.0, 0.0, 0.1), dtype=torch.float64))
        assert float(above[1]) < 32, "up in the world is up in the image"


def test_orbit_refuses_what_has_no_azimuth() -> None:
    with pytest.raises(ValueError, match="an azimuth 0 that is not along up"):
        orbit(ahead=torch.tensor((0.0, 0.0, 2.0)))
