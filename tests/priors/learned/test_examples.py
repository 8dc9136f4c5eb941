"""What the network is trained on: pictures of random animals and where their points are."""

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from rewild4d.datasets.builtin.zoo import animals, varied
from rewild4d.datasets.builtin.zoo.points import body_points
from rewild4d.priors.landmarks import LANDMARKS
from rewild4d.priors.learned import examples, pictures
from rewild4d.priors.learned.drawing import draw
from rewild4d.priors.learned.points import MIRRORED, NAMES, SPINE, root_of

SQUARE = (np.array(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))), np.array(((0, 1, 2), (0, 2, 3)), np.int32))
"""The whole picture as two triangles: columns and rows, and faces."""


def test_a_square_over_a_quarter_of_the_picture_is_drawn_by_area_and_the_nearer_one_wins() -> None:
    vertices, faces = SQUARE
    near = np.concatenate((0.5 * vertices, np.full((4, 1), 2.0)), axis=1).astype(np.float32)
    far = np.concatenate((vertices, np.full((4, 1), 3.0)), axis=1).astype(np.float32)
    shades = np.array((0.8,) * 4 + (0.2,) * 4, np.float32)
    mask, bright = draw(np.concatenate((near, far)), np.concatenate((faces, faces + 4)), shades, 8)
    assert (mask == 1).all()
    assert bright[:4, :4] == pytest.approx(0.8) and bright[4:].max() == pytest.approx(0.2)
    (alone, _) = draw(near, faces, shades, 8)
    assert alone.mean() == pytest.approx(1 / 4)


def test_what_is_behind_the_camera_is_not_drawn() -> None:
    vertices, faces = SQUARE
    behind = np.concatenate((vertices, np.full((4, 1), -1.0)), axis=1).astype(np.float32)
    assert draw(behind, faces, np.ones(4, np.float32), 8).max() == 0


def test_the_outline_is_that_of_opencv() -> None:
    rng = np.random.default_rng(3)
    animal = varied.draw_animal(rng)
    flat = animal.surface.vertices[:, :2]
    low, high = flat.min(axis=0), flat.max(axis=0)
    points = 0.1 + 0.8 * (flat - low) / (high - low).max()
    depth = np.full((len(flat), 1), 1.0)
    faces = animal.surface.faces.astype(np.int32)
    mask = draw(np.concatenate((points, depth), 1).astype(np.float32), faces, np.ones(len(flat), np.float32), 64)[0]
    other = np.zeros((1024, 1024), np.uint8)
    for corners in np.round((1024 * points - 0.5)[faces] * 16).astype(np.int32):
        cv2.fillConvexPoly(other, corners, 1, shift=4)
    theirs = cv2.resize(other.astype(np.float32), (64, 64), interpolation=cv2.INTER_AREA)
    assert mask.sum() == pytest.approx(theirs.sum(), rel=0.03)  # OpenCV fills pixels on an edge too
    assert np.abs(mask - theirs).sum() < 0.12 * theirs.sum()  # four samples a pixel against 256


def test_every_named_point_lies_in_the_body_of_a_zoo_animal() -> None:
    skeleton, rest = animals._rest(3)
    names, bones, places = body_points(skeleton, animals.draw(3).proportions)
    assert set(names) == set(NAMES) <= set(LANDMARKS)
    low, high = rest.vertices.min(axis=0), rest.vertices.max(axis=0)
    assert ((places >= low) & (places <= high)).all()
    left = places[names.index("front_left_foot")]
    assert left[0] > 0 and left == pytest.approx(places[names.index("front_right_foot")] * (-1, 1, 1))
    assert places[names.index("nose"), 2] > places[names.index("hips"), 2] > places[names.index("tail_tip"), 2]
    assert skeleton.names[bones[names.index("rear_left_foot")]] == "hind.3.L"


def test_a_sequence_is_drawn_alike_for_one_seed_and_differs_for_another() -> None:
    first, again = (examples.draw_sequences(np.random.default_rng(1), 1, 3) for _ in range(2))
    other = examples.draw_sequences(np.random.default_rng(2), 1, 3)
    assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in vars(first))
    assert not torch.equal(first.pictures, other.pictures)


def test_an_animal_is_the_same_in_every_process() -> None:
    """Python's hashes differ from process to process, and with them the order of a set."""
    code = "import numpy; from rewild4d.datasets.builtin.zoo import varied as v; "
    code += "print([v._proportions(numpy.random.default_rng(k), v.FOUR_FOOTED) for k in range(20)])"
    said = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2", "3")
    }  # fmt: skip
    assert len(said) == 1


def test_points_lie_on_the_animal_where_the_camera_sees_them() -> None:
    made = examples.draw_sequences(np.random.default_rng(5), 4, 4)
    inside = made.points[..., :2] / (1 + made.points[..., 2:] * made.openings[..., None, None])
    pixels = ((0.5 * inside + 0.5) * pictures.SIZE).long().clamp(0, pictures.SIZE - 1)
    masks = torch.nn.functional.max_pool2d(made.pictures[:, :, 0], 7, 1, 3)
    rows = torch.arange(4)[:, None, None], torch.arange(4)[None, :, None]
    assert masks[(*rows, pixels[..., 1], pixels[..., 0])].mean() > 0.9
    assert root_of(made.points.numpy())[..., 2] == pytest.approx(0, abs=1e-5)


def test_an_animal_on_two_legs_has_the_points_of_the_spine_alone() -> None:
    rng = np.random.default_rng(2)
    animals_drawn = [varied.draw_animal(rng, varied.TWO_LEGGED) for _ in range(4)]
    assert {animal.stance for animal in animals_drawn} <= {"two", "wings"}
    assert all({*SPINE} <= {*animal.names} and "front_left_foot" not in animal.names for animal in animals_drawn)
    made = examples.draw_sequences(rng, 2, 3, kinds=varied.TWO_LEGGED, names=SPINE)
    assert made.points.shape == (2, 3, len(SPINE), 3)
    assert root_of(made.points.numpy())[..., 2] == pytest.approx(0, abs=1e-5)


def test_a_mirror_exchanges_left_and_right_and_twice_is_nothing() -> None:
    made = examples.draw_sequences(np.random.default_rng(5), 1, 2)
    once = made.mirrored()
    left, right = NAMES.index("front_left_foot"), NAMES.index("front_right_foot")
    flip = torch.tensor((-1.0, 1.0, 1.0))
    assert torch.equal(once.points[..., left, :], made.points[..., right, :] * flip)
    assert torch.linalg.det(once.rotations) == pytest.approx(torch.ones(1, 2), abs=1e-5)
    assert all(torch.equal(getattr(once.mirrored(), name), getattr(made, name)) for name in vars(made))
    assert MIRRORED["nose"] == "nose" and MIRRORED["rear_left_top"] == "rear_right_top"


def test_the_smallest_rotation_looks_along_the_ray() -> None:
    center = np.array((0.3, -0.2))
    turn = pictures.looking_at(center)
    ray = np.append(center, 1) / np.linalg.norm(np.append(center, 1))
    assert turn @ ray == pytest.approx((0, 0, 1)) and turn @ turn.T == pytest.approx(np.eye(3))
    assert np.trace(turn) == pytest.approx(1 + 2 * ray[2])  # 1 + 2 cos of its angle
    assert pictures.looking_at(np.zeros(2)) == pytest.approx(np.eye(3))


def test_brightness_has_no_mean_and_a_known_spread_inside_the_mask() -> None:
    mask = np.ones((4, 4), np.float32)
    bright = np.repeat(np.array((0.2, 0.8), np.float32), 8).reshape(4, 4)
    _, found = pictures.normalised(np.stack((mask, bright)))
    assert sorted(set(found.ravel().round(4))) == pytest.approx([-0.5 * 0.3 / 0.33, 0.5 * 0.3 / 0.33], abs=1e-3)
    assert np.isfinite(pictures.normalised(np.zeros((2, 4, 4), np.float32))).all()
