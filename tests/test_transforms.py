"""Group axioms of rotations and similarities, and the mirror identities that the method rests on."""

import math

import pytest
import torch
from torch import Tensor

from rewild4d import transforms as tf
from rewild4d.harmonics import seen_colors
from rewild4d.priors.bodies.tetrapod import MIRROR
from rewild4d.types import Camera, Splats


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def random_quats(count: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 4, dtype=torch.float64, generator=generator), dim=-1)


def random_camera(generator: torch.Generator) -> Camera:
    eye = torch.randn(3, dtype=torch.float64, generator=generator) + torch.tensor((0.0, 2.0, 9.0))
    intrinsics = torch.tensor(((120.0, 0, 70.0), (0, 130.0, 41.0), (0, 0, 1)), dtype=torch.float64)
    up = torch.tensor((0.1, 1.0, 0.0), dtype=torch.float64)
    return Camera(tf.look_at(eye, torch.zeros(3, dtype=torch.float64), up), intrinsics, 160, 90)


def test_quaternions_form_a_group(generator: torch.Generator) -> None:
    a, b, c = (random_quats(64, generator) for _ in range(3))
    one = torch.tensor((1.0, 0, 0, 0), dtype=torch.float64).expand(64, 4)
    inverse = a * torch.tensor((1.0, -1, -1, -1))
    torch.testing.assert_close(tf.quat_multiply(tf.quat_multiply(a, b), c), tf.quat_multiply(a, tf.quat_multiply(b, c)))
    torch.testing.assert_close(tf.quat_multiply(a, one), a)
    torch.testing.assert_close(tf.quat_multiply(a, inverse), one)
    torch.testing.assert_close(tf.quat_multiply(a, b).norm(dim=-1), torch.ones(64, dtype=torch.float64))


def test_the_nearest_rotation_is_one_and_the_closest(generator: torch.Generator) -> None:
    turns = tf.quat_to_matrix(random_quats(64, generator))
    stretch = torch.tensor((3.0, 2.0, 1.0), dtype=torch.float64).diag()
    torch.testing.assert_close(tf.nearest_rotation(turns @ stretch), turns)  # the polar factor
    mirrored = turns @ torch.diag(torch.tensor((3.0, 2.0, -1.0), dtype=torch.float64))
    torch.testing.assert_close(tf.nearest_rotation(mirrored), turns)  # of a reflection the weakest axis turns over


def test_matrices_are_a_homomorphism(generator: torch.Generator) -> None:
    a, b = random_quats(64, generator), random_quats(64, generator)
    product = tf.quat_to_matrix(tf.quat_multiply(a, b))
    torch.testing.assert_close(product, tf.quat_to_matrix(a) @ tf.quat_to_matrix(b))
    torch.testing.assert_close(torch.linalg.det(product), torch.ones(64, dtype=torch.float64))


def test_matrix_to_quat_inverts_also_near_half_turns(generator: torch.Generator) -> None:
    axes = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64, generator=generator), dim=-1)
    for angle in (0.0, 1e-9, 1.0, math.pi - 1e-9, math.pi):
        matrix = tf.axis_angle_to_matrix(axes * angle)
        torch.testing.assert_close(tf.quat_to_matrix(tf.matrix_to_quat(matrix)), matrix, atol=1e-9, rtol=0)


def test_axis_angle_turns_by_the_angle() -> None:
    quarter = tf.axis_angle_to_matrix(torch.tensor((0.0, 0.0, math.pi / 2)))
    torch.testing.assert_close(quarter @ torch.tensor((1.0, 0, 0)), torch.tensor((0.0, 1, 0)), atol=1e-6, rtol=0)


def test_similarities_split_into_what_they_were_made_of(generator: torch.Generator) -> None:
    turn = tf.quat_to_matrix(random_quats(8, generator))
    scale = torch.linspace(0.01, 20, 8, dtype=torch.float64)
    move = torch.randn(8, 3, dtype=torch.float64, generator=generator)
    for got, wanted in zip(tf.split_similarity(tf.similarity(scale, turn, move)), (scale, turn, move), strict=True):
        torch.testing.assert_close(got, wanted)


def test_look_at_sees_its_target_in_the_middle(generator: torch.Generator) -> None:
    camera = random_camera(generator)
    pixel, depth = camera.project(torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(pixel[0], camera.intrinsics[:2, 2])
    torch.testing.assert_close(depth[0], camera.center.norm())
    above, _ = camera.project(torch.tensor(((0.1, 1.0, 0.0),), dtype=torch.float64))
    assert above[0, 1] < pixel[0, 1], "up in the world is up in the image"


def test_mirrored_camera_gives_the_flipped_image(generator: torch.Generator) -> None:
    camera = random_camera(generator)
    mirrored = tf.mirror_camera(camera)
    points = torch.randn(40, 3, dtype=torch.float64, generator=generator)
    pixels, depth = camera.project(points)
    flipped, flipped_depth = mirrored.project(tf.mirror_points(points))
    torch.testing.assert_close(flipped[:, 0], camera.width - pixels[:, 0])
    torch.testing.assert_close(flipped[:, 1], pixels[:, 1])
    torch.testing.assert_close(flipped_depth, depth)
    torch.testing.assert_close(torch.linalg.det(mirrored.world_to_camera), torch.tensor(1.0, dtype=torch.float64))
    again = tf.mirror_camera(mirrored)
    torch.testing.assert_close(again.world_to_camera, camera.world_to_camera)
    torch.testing.assert_close(again.intrinsics, camera.intrinsics)


def test_mirrored_orientation_is_the_conjugate_by_the_reflection(generator: torch.Generator) -> None:
    quats = random_quats(32, generator)
    reflect = torch.diag(torch.tensor((-1.0, 1, 1), dtype=torch.float64))
    torch.testing.assert_close(tf.quat_to_matrix(tf.mirror_quats(quats)), reflect @ tf.quat_to_matrix(quats) @ reflect)


def test_mirrored_pose_is_an_involution_and_moves_the_mirrored_animal(generator: torch.Generator) -> None:
    mirror = torch.tensor(MIRROR)
    assert torch.equal(mirror[mirror], torch.arange(20))
    pose = tf.rigid(tf.quat_to_matrix(random_quats(20, generator)), torch.randn(20, 3, dtype=torch.float64))
    flipped = tf.mirror_transforms(pose, mirror)
    torch.testing.assert_close(tf.mirror_transforms(flipped, mirror), pose)
    points = torch.randn(30, 3, dtype=torch.float64, generator=generator)
    weights = torch.rand(30, 20, dtype=torch.float64, generator=generator)
    weights = weights / weights.sum(1, keepdim=True)
    posed = tf.skin_points(points, weights, pose)
    torch.testing.assert_close(
        tf.skin_points(tf.mirror_points(points), weights[:, mirror], flipped), tf.mirror_points(posed)
    )


def test_skinning_with_identity_moves_nothing(generator: torch.Generator) -> None:
    points, weights = torch.randn(9, 3, generator=generator), torch.full((9, 4), 0.25)
    torch.testing.assert_close(tf.skin_points(points, weights, torch.eye(4).expand(4, 4, 4)), points)
    quats = random_quats(9, generator).float()
    still = torch.tensor((1.0, 0, 0, 0)).expand(4, 4)
    torch.testing.assert_close(tf.skin_quats(quats, weights, still), quats)


def test_skinned_orientation_ignores_the_sign_of_a_quaternion(generator: torch.Generator) -> None:
    quats, joints = random_quats(5, generator), random_quats(3, generator)
    weights = torch.tensor(((0.5, 0.3, 0.2),), dtype=torch.float64).expand(5, 3)
    signs = torch.tensor((1.0, -1.0, 1.0), dtype=torch.float64)[:, None]
    torch.testing.assert_close(tf.skin_quats(quats, weights, joints), tf.skin_quats(quats, weights, joints * signs))


def test_camera_in_object_keeps_pixels_and_stays_rigid(generator: torch.Generator) -> None:
    camera = random_camera(generator)
    world = tf.similarity(
        0.4, tf.quat_to_matrix(random_quats(1, generator)[0]), torch.tensor((0.3, 1.0, -2.0)).double()
    )
    inside = tf.camera_in_object(camera, world)
    points = torch.randn(20, 3, dtype=torch.float64, generator=generator)
    pixels, depth = inside.project(points)
    outside, outside_depth = camera.project(points @ world[:3, :3].T + world[:3, 3])
    torch.testing.assert_close(pixels, outside)
    torch.testing.assert_close(depth * 0.4, outside_depth)
    rotation = inside.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))


def test_moved_gaussians_have_the_moved_covariance(generator: torch.Generator) -> None:
    quats = random_quats(6, generator)
    splats = Splats(
        torch.randn(6, 3, generator=generator).double(), quats, torch.rand(6, 3, generator=generator).double(),
        torch.ones(6), torch.zeros(6, 1, 3),
    )  # fmt: skip
    matrix = tf.similarity(2.5, tf.quat_to_matrix(random_quats(1, generator)[0]), torch.zeros(3, dtype=torch.float64))

    def covariance(s: Splats) -> Tensor:
        root = tf.quat_to_matrix(s.quats) * s.scales[:, None]
        return root @ root.mT

    moved = tf.transform_splats(splats, matrix)
    torch.testing.assert_close(covariance(moved), matrix[:3, :3] @ covariance(splats) @ matrix[:3, :3].T)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_colours_that_depend_on_the_view_turn_with_their_gaussians(
    generator: torch.Generator, dtype: torch.dtype
) -> None:
    """A camera that is moved with the Gaussians sees what it saw."""
    splats = Splats(
        torch.randn(30, 3, generator=generator, dtype=dtype), random_quats(30, generator).to(dtype),
        torch.ones(30, 3, dtype=dtype), torch.ones(30, dtype=dtype),
        torch.randn(30, 16, 3, generator=generator, dtype=dtype),
    )  # fmt: skip
    turn = tf.quat_to_matrix(random_quats(1, generator)[0])
    matrix = tf.similarity(2.5, turn, torch.tensor((1.0, -2.0, 3.0), dtype=torch.float64))
    eye = torch.tensor((4.0, 1.0, -3.0), dtype=torch.float64)
    seen = seen_colors(tf.transform_splats(splats, matrix), matrix[:3, :3] @ eye + matrix[:3, 3])
    torch.testing.assert_close(seen, seen_colors(splats, eye), atol=1e-5, rtol=0)
    assert (seen - seen_colors(splats, matrix[:3, :3] @ eye + matrix[:3, 3])).abs().max() > 0.1
