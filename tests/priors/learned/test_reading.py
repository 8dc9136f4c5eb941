"""From a clip to points in its cameras, and how far a guess is from them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rewild4d.datasets.builtin.zoo import varied
from rewild4d.errors import UserError
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.hypotheses import Hypotheses
from rewild4d.priors.learned import pictures, reading
from rewild4d.priors.learned.drawing import draw
from rewild4d.priors.learned.evidence import PointEvidence, indices
from rewild4d.priors.learned.network import PointNetwork
from rewild4d.priors.learned.points import NAMES
from rewild4d.priors.search import facings
from rewild4d.transforms import rigid, similarity
from rewild4d.types import Camera, Frame

UP = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)


def looking(yaw: float, off: float = 0.0) -> Camera:
    """A camera four units from the origin, level, whose axis misses it by ``off`` radians."""
    turn = torch.tensor(((np.cos(yaw), 0, -np.sin(yaw)), (0, -1.0, 0), (-np.sin(yaw), 0, -np.cos(yaw))))
    aside = torch.tensor(((np.cos(off), 0, np.sin(off)), (0, 1.0, 0), (-np.sin(off), 0, np.cos(off))))
    intrinsics = torch.tensor(((300.0, 0, 160), (0, 300, 120), (0, 0, 1)))
    matrix = rigid((aside @ turn).double(), (aside @ torch.tensor((0.0, 0, 4), dtype=aside.dtype)).double())
    return Camera(matrix, intrinsics, 320, 240)


def photographed(animal: varied.VariedAnimal, camera: Camera) -> Frame:
    """Draw an animal, two units long and centred, into a whole frame, by the square of 320 pixels."""
    vertices = animal.surface.vertices - animal.surface.vertices.mean(axis=0)
    vertices /= 0.5 * np.ptp(vertices, axis=0).max()
    pixels, depth = camera.project(torch.from_numpy(vertices))
    flat = np.concatenate((pixels.numpy() / 320, depth.numpy()[:, None]), axis=1).astype(np.float32)
    shades = np.linspace(0, 1, len(flat), dtype=np.float32)
    mask, bright = torch.from_numpy(draw(flat, animal.surface.faces.astype(np.int32), shades, 320)[:, :240])
    return Frame(time=0.0, rgb=bright.expand(3, -1, -1), mask=mask[None], camera=camera)


def test_the_picture_is_that_of_a_camera_along_the_middle_of_the_crop() -> None:
    animal = varied.draw_animal(np.random.default_rng(4))
    frame = photographed(animal, looking(0.7, off=0.3))
    picture, rotation, center, opening = reading.view_of(frame, "case")
    vertices = animal.surface.vertices - animal.surface.vertices.mean(axis=0)
    vertices /= 0.5 * np.ptp(vertices, axis=0).max()
    seen = (vertices - center) @ rotation.T
    flat = np.concatenate((0.5 + 0.5 * seen[:, :2] / seen[:, 2:] / opening, seen[:, 2:]), axis=1)
    shades = np.linspace(0, 1, len(flat), dtype=np.float32)
    direct = draw(flat.astype(np.float32), animal.surface.faces.astype(np.int32), shades, pictures.SIZE)
    assert np.abs(picture[0] - direct[0]).mean() < 0.01
    assert np.abs(picture[1] - pictures.normalised(direct)[1]).mean() < 0.02
    rows, columns = np.nonzero(picture[0] > 0.5)
    middle = (np.ptp(rows) + 2 * rows.min()) / 2, (np.ptp(columns) + 2 * columns.min()) / 2
    assert middle == pytest.approx((pictures.SIZE / 2 - 0.5,) * 2, abs=3.0)


def test_a_long_clip_is_read_in_windows_and_empty_frames_are_left_out() -> None:
    torch.manual_seed(0)
    animal, network = varied.draw_animal(np.random.default_rng(4)), PointNetwork().eval()
    frames = [photographed(animal, looking(0.1 * k)) for k in range(20)]
    frames[3] = replace(frames[3], mask=torch.zeros_like(frames[3].mask))
    found = reading.read(frames, range(20), UP, "case", network)
    assert found.timesteps.tolist() == [k for k in range(20) if k != 3]
    assert found.points.shape == (19, len(NAMES), 3) and found.spreads.shape == (19, len(NAMES), 2)
    mirrored = [replace(f, rgb=f.rgb.flip(-1), mask=f.mask.flip(-1)) for f in frames[:2]]
    back = [replace(f, camera=looking(0.0)) for f in mirrored]
    plain = [replace(f, camera=looking(0.0)) for f in frames[:2]]
    one, other = (reading.read(some, range(2), UP, "case", network) for some in (plain, back))
    left, right = NAMES.index("front_left_foot"), NAMES.index("front_right_foot")
    flip = torch.tensor((-1.0, 1.0, 1.0))
    assert one.points[:, left] == pytest.approx(other.points[:, right] * flip, abs=2e-3)
    with pytest.raises(
        UserError, match=r"^case: expected at least one mask that shows the animal, but all 1 are empty"
    ):
        reading.read(frames[3:4], range(1), UP, "case", network)


def test_a_guess_is_no_distance_from_its_own_points_whatever_its_distance_from_one_camera() -> None:
    guess = Hypotheses.start(QUADRUPED, facings(4)[1:2], torch.zeros(3, 3))
    points = guess.points(*indices())
    working = similarity(torch.tensor(2.0).double(), torch.eye(3).double(), torch.tensor((0.3, 0, 0)).double())
    camera = looking(0.0)
    rotation = camera.world_to_camera[:3, :3].float()
    center = camera.center.float()
    opening = 0.3
    seen = (2.0 * points[0] + torch.tensor((0.3, 0.0, 0.0)) - center) @ rotation.T
    root = seen[:, [NAMES.index("withers"), NAMES.index("hips")], 2].mean(-1)[:, None]
    said = torch.cat((seen[..., :2], (seen[..., 2] - root)[..., None]), -1) / (opening * root[..., None])
    made = reading.Reading(
        torch.arange(3), rotation.expand(3, 3, 3), center.expand(3, 3), torch.full((3,), opening), said,
        torch.full((3, len(NAMES), 2), 0.1),
    )  # fmt: skip
    evidence = PointEvidence.of(made, working)
    assert evidence.distance(points) == pytest.approx(0, abs=1e-6)
    eye = evidence.centers[0]
    assert evidence.distance(eye + 1.7 * (points - eye)) == pytest.approx(0, abs=1e-5)
    moved = replace(made, points=said + torch.tensor((0.0, 0.0, 0.1)))
    assert PointEvidence.of(moved, working).distance(points) == pytest.approx(2**0.5 - 1, abs=1e-5)
    turned = Hypotheses.start(QUADRUPED, facings(4)[3:4], torch.zeros(3, 3)).points(*indices())
    assert evidence.distance(turned) > 1
