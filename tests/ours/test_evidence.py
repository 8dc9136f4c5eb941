"""What images say of a Gaussian: the share of it that is drawn, and sums over views, against cases in the head."""

import math

import pytest
import torch
from torch.nn.functional import normalize
from toys import TINY

from rewild4d.ours.canonical import Gaussians, Posed, attributes
from rewild4d.ours.config import Canonical
from rewild4d.ours.evidence import information, pull_shares, turn, visible_share
from rewild4d.ours.model import build_model, sightings
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.types import Camera, Clip, Prior

UPRIGHT = torch.tensor((1.0, 0.0, 0.0, 0.0))
"""Orientation whose third axis is +z."""
AHEAD = Camera(
    torch.eye(4, dtype=torch.float64),
    torch.tensor(((100.0, 0.0, 32.0), (0.0, 100.0, 32.0), (0.0, 0.0, 1.0)), dtype=torch.float64),
    64,
    64,
)
"""Looks along +z."""


def shares(points: torch.Tensor, radius: float, opacity: float) -> torch.Tensor:
    """Return `visible_share` of discs that face the camera."""
    count = len(points)
    quats = UPRIGHT.expand(count, 4)
    scales = torch.tensor((radius, radius, radius / 10)).log().expand(count, 3)
    gaussians = Gaussians(attributes(points, quats, scales, 0.5, Canonical(opacity=opacity)), 0.0)
    return visible_share(Posed(points, quats, scales), gaussians, AHEAD)


def test_what_stands_behind_another_is_hardly_drawn() -> None:
    # 4 pixels wide, one behind the other, and one beside them.
    drawn = shares(torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 5.2], [1.0, 0.0, 5.0]]), 0.2, 0.9)
    assert drawn[0] == drawn[2] == 1.0
    # Where the first covers, a tenth shows at its middle and all of it far outside.
    assert 0.05 < drawn[1] < 1.0
    covered = shares(torch.tensor([[0.0, 0.0, z] for z in (5.0, 5.05, 5.1, 5.15, 5.2)]), 0.2, 0.9)
    assert covered[4] < covered[3] < covered[1] and covered[4] < 0.5


def test_share_is_what_is_drawn_over_the_disc() -> None:
    # One alone adds 2 pi s^2 times its opacity, over a disc of pi s^2; the rasterizer widens s^2 by 0.3 pixels.
    side = 100 * 0.2 / 5.0
    drawn = shares(torch.tensor([[0.0, 0.0, 5.0]]), 0.2, 0.25)
    assert float(drawn[0]) == pytest.approx(2 * 0.25 * (side**2 + 0.3) / side**2, rel=0.03)


def test_behind_the_camera_is_not_seen() -> None:
    assert float(shares(torch.tensor([[0.0, 0.0, -5.0]]), 0.2, 0.9)[0]) == 0.0


def test_information_is_a_mean_over_the_views(toy: tuple[Clip, Prior]) -> None:
    supervision = Supervision(*toy, TINY.image_size, torch.device("cpu"))
    model = build_model(TINY, toy[1], torch.Generator().manual_seed(0))
    for mirrored in (0.0, 0.25):
        views = list(sightings(model, supervision, mirrored))
        assert math.isclose(sum(each.share for each in views), 1.0)
        assert {each.key for each in views} == {Key(v, v, t) for v in ((1, -1) if mirrored else (1,)) for t in range(5)}
        found = information(model.gaussians, sightings(model, supervision, mirrored), supervision)
        # The trace of I - d d^T is 2: half of the trace is the mean share that is drawn.
        mean = sum(
            each.share * visible_share(each.posed, model.gaussians, supervision.target(each.key).camera)
            for each in views
        )
        traces = torch.einsum("naa->n", found)
        torch.testing.assert_close(traces, 2 * torch.as_tensor(mean), atol=1e-5, rtol=1e-4)
        assert 0.2 < float(traces.mean()) / 2 < 0.8, "an animal shows about half of its skin"
        assert float(torch.linalg.eigvalsh(found).min()) > -1e-6


def test_one_line_of_sight_tells_nothing_along_it(toy: tuple[Clip, Prior]) -> None:
    supervision = Supervision(*toy, TINY.image_size, torch.device("cpu"))
    supervision.usable = ([2], [2])
    model = build_model(TINY, toy[1], torch.Generator().manual_seed(0))
    own = model.gaussians
    found = information(own, sightings(model, supervision), supervision)
    (view,) = sightings(model, supervision)
    sight = normalize(view.posed.means - supervision.target(view.key).camera.center.float(), dim=-1)
    rest = torch.einsum("na,nab->nb", sight, own.rotations_to(normalize(view.posed.quats, dim=-1))).detach()
    along = torch.einsum("na,nab,nb->n", rest, found, rest)
    torch.testing.assert_close(along, torch.zeros(len(own)), atol=1e-5, rtol=0)
    assert float(found.detach().diagonal(dim1=1, dim2=2).sum(-1).max()) == pytest.approx(2.0, abs=1e-4)


def around(degrees: float, count: int) -> torch.Tensor:
    """Camera centres that turn about the origin by so many degrees a frame."""
    angles = torch.deg2rad(degrees * torch.arange(count, dtype=torch.float64))
    return 7 * torch.stack((angles.cos(), angles.sin(), torch.zeros(count)), dim=-1)


def test_frames_beside_one_tell_its_depth_as_far_as_the_camera_turns() -> None:
    rows = torch.arange(5, dtype=torch.float64)
    # sin^2 of 30 and 60 degrees: on both sides in the middle, on one side at an end.
    told = turn(around(30, 5), rows)
    assert told.tolist() == pytest.approx([(1 / 4 + 3 / 4) / 2, (2 / 4 + 3 / 4) / 3, 1 / 2, (2 / 4 + 3 / 4) / 3, 1 / 2])
    assert turn(around(0, 5), rows).tolist() == [0] * 5
    assert turn(around(180, 5), rows).tolist() == pytest.approx([0] * 5), "from behind the same depth is hidden"
    # A frame that is missing: only that at the same distance counts, and none further away.
    assert turn(around(30, 2), torch.tensor([0.0, 2.0], dtype=torch.float64)).tolist() == pytest.approx([1 / 4] * 2)
    assert turn(around(30, 2), torch.tensor([0.0, 3.0], dtype=torch.float64)).tolist() == [0, 0]


def test_the_pull_falls_as_far_as_other_frames_tell(toy: tuple[Clip, Prior]) -> None:
    supervision = Supervision(*toy, TINY.image_size, torch.device("cpu"))
    cameras = [supervision.target(Key(1, 1, frame)).camera.center.double() for frame in range(supervision.frames)]
    told = turn(torch.stack(cameras), supervision.positions)
    assert pull_shares(supervision, 0.0) == [1.0] * supervision.frames
    limit = float(told.mean()) / 2
    assert pull_shares(supervision, limit) == pytest.approx([min(1.0, limit / float(each)) for each in told])
