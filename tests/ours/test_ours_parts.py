"""The pieces of `ours`: codes, symmetry, skinning, deformation, losses, schedules."""

import math

import pytest
import torch
from torch import Tensor

from rewild4d.ours.canonical import NAMES, Gaussians, Posed
from rewild4d.ours.config import Config, Deform, Density, Pose, Skinning
from rewild4d.ours.deform import DeformNetwork
from rewild4d.ours.density import replace_gaussians
from rewild4d.ours.losses.images import colour_losses, silhouette_loss, ssim_map, union_window
from rewild4d.ours.losses.regularizers import (
    attach_loss,
    compact_loss,
    limit_loss,
    neighbours,
    relative_angles,
    tv_loss,
)
from rewild4d.ours.motion import frame_position, interpolate_similarity
from rewild4d.ours.pose import Pose as Poses
from rewild4d.ours.pose import PoseNetwork, blend_poses, joint_transforms, time_code
from rewild4d.ours.schedule import exponential, fade, ramp
from rewild4d.ours.skinning import build_field
from rewild4d.ours.symmetry import Target
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS
from rewild4d.transforms import mirror_points, mirror_quats, mirror_transforms, similarity, skin_points, skin_quats
from rewild4d.types import Camera

CAMERA = Camera(torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64), 1, 1)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_poses(batch: int, joints: int = 20) -> tuple[Tensor, Tensor]:
    quats = torch.nn.functional.normalize(torch.randn(batch, joints, 4, generator=generator(1)), dim=-1)
    return quats, torch.randn(batch, joints, 3, generator=generator(2))


@pytest.mark.parametrize("frames", [2, 24, 301])
def test_the_four_codes_differ_at_every_frame(frames: int) -> None:
    times = (torch.arange(frames) + 1) / frames
    signs = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    codes = [time_code(times, torch.full((frames,), m), torch.full((frames,), v), 4) for m, v in signs]
    for a in range(4):
        for b in range(a):
            assert (codes[a] - codes[b]).abs().amax(-1).min() > 1e-3
    assert codes[0].shape == (frames, 2 + 2 * 4)
    # sin and tau change sign with the group, cos does not.
    torch.testing.assert_close(codes[0][:, :5], -codes[2][:, :5])
    torch.testing.assert_close(codes[0][:, 5:9], codes[2][:, 5:9])


def test_mirrored_pose_is_the_mirrored_transform() -> None:
    template = QUADRUPED.build()
    mirror, pivots = torch.tensor(MIRROR), template.bones[:, 0]
    assert torch.equal(mirror[mirror], torch.arange(20))
    quats, shifts = random_poses(2)
    pose = Poses(quats, shifts, torch.zeros(2, 20, 1))
    mirrored = pose.mirrored(mirror)
    expected = mirror_transforms(joint_transforms(quats, shifts, pivots), mirror)
    torch.testing.assert_close(
        joint_transforms(mirrored.quats, mirrored.shifts, pivots), expected, atol=1e-5, rtol=1e-5
    )
    twice = mirrored.mirrored(mirror)
    torch.testing.assert_close(twice.quats, quats)
    torch.testing.assert_close(twice.shifts, shifts)


def test_identity_pose_leaves_points_and_orientations() -> None:
    points, rest = torch.randn(7, 3, generator=generator()), random_poses(1, 7)[0][0]
    weights = torch.rand(7, 20, generator=generator()).softmax(-1)
    quats = torch.tensor((1.0, 0, 0, 0)).expand(20, 4)
    transforms = joint_transforms(quats, torch.zeros(20, 3), torch.randn(20, 3, generator=generator(3)))
    torch.testing.assert_close(skin_points(points, weights, transforms), points)
    torch.testing.assert_close(skin_quats(rest, weights, quats), rest)


def test_pose_network_starts_at_rest_and_its_anchors_are_wide() -> None:
    network = PoseNetwork(20, Pose(), generator())
    code = time_code(torch.tensor([0.5, 1.0]), torch.ones(2), torch.ones(2), 4)
    pose = network(code)
    torch.testing.assert_close(pose.quats, torch.tensor((1.0, 0, 0, 0)).expand(2, 20, 4))
    assert pose.shifts.abs().max() == 0
    assert network.anchors.shape == (20, 8)
    assert 0.8 < float(network.anchors.detach().std()) < 1.2
    again = PoseNetwork(20, Pose(), generator())
    assert all(torch.equal(a, b) for a, b in zip(network.parameters(), again.parameters(), strict=True))


def test_deformation_starts_as_skinning_and_its_query_takes_no_gradient() -> None:
    network = DeformNetwork(8, 128, Deform(width=32), generator())
    means = torch.randn(5, 3, generator=generator(), requires_grad=True)
    features, weights, anchors = (torch.randn(*shape, generator=generator()) for shape in ((20, 128), (5, 20), (20, 8)))
    posed = Posed(means, random_poses(1, 5)[0][0], torch.zeros(5, 3))
    out = network(features, weights, anchors, posed, 1.0)
    torch.testing.assert_close(out.means, means)
    torch.testing.assert_close(out.quats, posed.quats)
    torch.testing.assert_close(out.log_scales, posed.log_scales)
    torch.nn.init.normal_(network.out.weight, generator=generator())
    out = network(features, weights, anchors, posed, 1.0)
    (grad,) = torch.autograd.grad(out.means.sum(), means)
    torch.testing.assert_close(grad, torch.ones(5, 3))
    assert (out.log_scales - posed.log_scales).abs().max() <= 1.0


def test_folded_attention_equals_the_plain_one() -> None:
    network = DeformNetwork(8, 16, Deform(width=32, heads=4), generator()).double()
    query = torch.randn(6, network.inputs, generator=generator(), dtype=torch.float64)
    features = torch.randn(20, 16, generator=generator(), dtype=torch.float64)
    split = [
        part.view(-1, 4, 8).transpose(0, 1)
        for part in (network.query(query), network.key(features), network.value(features))
    ]
    plain = torch.nn.functional.scaled_dot_product_attention(*split).transpose(0, 1).reshape(6, 32)
    torch.testing.assert_close(network._attend(query, features), network.project(plain))


def test_field_samples_stay_on_the_simplex_and_follow_the_prior() -> None:
    template = QUADRUPED.build()
    field = build_field(template.vertices, template.weights, torch.tensor(MIRROR), Skinning(resolution=24))
    points = 6 * torch.rand(500, 3, generator=generator()) - 3
    weights = field.sample(field.probabilities(), points)
    torch.testing.assert_close(weights.sum(-1), torch.ones(500))
    assert weights.min() >= 0
    own = field.sample(field.probabilities(), template.vertices)
    agree = (own.argmax(-1) == template.weights.argmax(-1)).float().mean()
    assert agree > 0.7


def test_field_interpolates_linearly_between_voxels() -> None:
    template = QUADRUPED.build()
    field = build_field(template.vertices, template.weights, torch.tensor(MIRROR), Skinning(resolution=8, sweeps=1))
    table = field.probabilities()
    row = (3 * 8 + 4) * 8 + 5
    corner = field.origin + field.pitch * torch.tensor((3.0, 4.0, 5.0))
    between = corner + field.pitch * torch.tensor((0.25, 0.0, 0.0))
    got = field.sample(table, torch.stack((corner, between)))
    torch.testing.assert_close(got[0], table[row], atol=1e-5, rtol=0)
    torch.testing.assert_close(got[1], 0.75 * table[row] + 0.25 * table[row + 64], atol=1e-5, rtol=0)


def test_tied_field_is_its_own_mirror_image() -> None:
    template, mirror = QUADRUPED.build(), torch.tensor(MIRROR)
    field = build_field(template.vertices, template.weights, mirror, Skinning(resolution=16, tied=True))
    with torch.no_grad():
        field.logits += torch.randn(field.logits.shape, generator=generator())
    points = torch.randn(50, 3, generator=generator())
    table = field.probabilities()
    torch.testing.assert_close(
        field.sample(table, mirror_points(points)), field.sample(table, points)[:, mirror], atol=1e-5, rtol=0
    )


def test_compact_loss_is_the_two_small_eigenvalues() -> None:
    points = torch.randn(60, 3, generator=generator()) * torch.tensor((3.0, 1.0, 0.5))
    points.requires_grad_()
    weights = torch.rand(60, 4, generator=generator())
    weights = weights / weights.sum(-1, keepdim=True)
    weights[:, 3] = 0
    loss = compact_loss([points], weights, 2.0)

    def by_eigenvalues(points: Tensor) -> Tensor:
        total, mass = points.new_zeros(()), weights.sum(0)
        for joint in range(3):
            share = weights[:, joint] / mass[joint]
            centered = points - share @ points
            small = torch.linalg.eigvalsh((centered * share[:, None]).T @ centered)[:2]
            total = total + torch.exp(-2 * mass[joint] / mass.max()) * small.sum()
        return total / 4  # a part without mass has no spread

    expected = by_eigenvalues(points)
    torch.testing.assert_close(loss, expected)
    ours, theirs = (torch.autograd.grad(value, points)[0] for value in (loss, expected))
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)


def test_tv_loss_by_hand() -> None:
    grid = torch.zeros(2, 2, 2, 1)
    grid[1] = 0.3
    # Along x every difference is 0.3, outside delta 0.1: 0.1 * (0.3 - 0.05); along y and z nothing.
    torch.testing.assert_close(tv_loss(grid.view(8, 1), 2, 0.1), torch.tensor(0.1 * (0.3 - 0.05) / 3))
    torch.testing.assert_close(tv_loss(grid.view(8, 1), 2, 1.0), torch.tensor(0.3**2 / 2 / 3))


def test_ssim_on_the_crop_is_exact() -> None:
    target_rgb, mask = torch.zeros(3, 60, 70), torch.zeros(1, 60, 70)
    rgb, alpha = target_rgb.clone(), mask.clone()
    mask[:, 20:35, 0:25], alpha[:, 24:40, 12:30] = 1.0, 0.8
    target_rgb[:, 20:35, 0:25] = torch.rand(3, 15, 25, generator=generator())
    rgb[:, 24:40, 12:30] = 0.8 * torch.rand(3, 16, 18, generator=generator())
    target, background = Target(target_rgb, mask, CAMERA, 30.0), torch.tensor((0.2, 0.5, 0.9))
    window = union_window([alpha, mask], 10)
    assert (window[0], window[1]) == (slice(10, 50), slice(0, 40))
    l1, dissimilarity = colour_losses(rgb, alpha, target, background, window)
    x, y = (image + (1 - matte) * background[:, None, None] for image, matte in ((rgb, alpha), (target_rgb, mask)))
    area = 3 * 30.0**2
    torch.testing.assert_close(l1, (x - y).abs().sum() / area)
    torch.testing.assert_close(dissimilarity, (1 - ssim_map(x, y)).sum() / area, atol=1e-5, rtol=1e-5)
    whole = (slice(0, 60), slice(0, 70))
    torch.testing.assert_close(
        silhouette_loss(alpha, target, window), silhouette_loss(alpha, target, whole), atol=2e-4, rtol=0
    )


def test_joint_limit_and_attachment() -> None:
    parents = torch.tensor((-1, 0))
    pivots = torch.tensor(((0.0, 0, 0), (1.0, 0, 0)))

    def turned(degrees: float) -> Poses:
        half = math.radians(degrees) / 2
        quats = torch.tensor([[[1.0, 0, 0, 0], [math.cos(half), 0, 0, math.sin(half)]]])
        return Poses(quats, torch.zeros(1, 2, 3), torch.zeros(1, 2, 1))

    assert limit_loss(turned(59), parents, 60) == 0
    expected = (math.cos(math.radians(30)) - math.cos(math.radians(45))) ** 2
    assert float(limit_loss(turned(90), parents, 60)) == pytest.approx(expected, rel=1e-4)
    assert relative_angles(turned(90).quats, parents)[0].tolist() == pytest.approx([0, 90], abs=1e-3)
    shifts = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0]]])
    pose = turned(90)
    assert float(attach_loss(joint_transforms(pose.quats, pose.shifts, pivots), pivots, parents)) < 1e-12
    assert float(attach_loss(joint_transforms(pose.quats, shifts, pivots), pivots, parents)) == pytest.approx(0.25 / 25)


def test_blend_goes_from_the_prior_to_the_network() -> None:
    quats, shifts = random_poses(2)
    identity = torch.tensor((1.0, 0, 0, 0)).expand(2, 20, 4)
    network = Poses(identity, torch.zeros(2, 20, 3), torch.zeros(2, 20, 1))
    full = blend_poses(network, quats, shifts, 1.0)
    torch.testing.assert_close((full.quats * quats).sum(-1).abs(), torch.ones(2, 20))
    torch.testing.assert_close(full.shifts, shifts)
    half = blend_poses(network, quats, shifts, 0.5)
    # The half-way rotation turns by half the angle.
    torch.testing.assert_close(half.quats[..., 0], (0.5 * quats[..., 0].abs().acos()).cos(), atol=1e-5, rtol=1e-5)


def test_schedules() -> None:
    assert exponential(1e-2, 1e-4, 0.5) == pytest.approx(1e-3)
    assert [ramp(x, 0.25, 0.75) for x in (0.0, 0.25, 0.5, 0.75, 1.0)] == [0, 0, 0.5, 1, 1]
    assert [fade(x, 0.5) for x in (0.0, 0.25, 0.5, 0.9)] == [1, 0.5, 0, 0]
    assert fade(0.0, 0.0) == 0
    jitter = Pose().time_noise * fade(0.25, Pose().time_noise_until)
    assert jitter == pytest.approx(0.1 * (1 - 0.25 / 0.5))


def test_replacing_gaussians_keeps_the_moments_of_those_that_stay() -> None:
    values = {"means": (4, 3), "quats": (4, 4), "log_scales": (4, 3), "logit_opacities": (4,), "colors": (4, 3)}
    own = Gaussians({name: torch.rand(shape, generator=generator()) for name, shape in values.items()}, 0.05)
    optimizer = torch.optim.Adam([{"params": [getattr(own, name)]} for name in NAMES])
    sum(
        (getattr(own, name) * torch.arange(1.0, 5).view(-1, *[1] * (getattr(own, name).ndim - 1))).sum()
        for name in NAMES
    ).backward()
    optimizer.step()
    before = optimizer.state[own.means]["exp_avg"].clone()
    source = torch.tensor((3, 1, 1))
    new = {name: getattr(own, name).detach()[source] for name in NAMES}
    replace_gaussians(own, optimizer, new, source, kept=2)
    after = optimizer.state[own.means]["exp_avg"]
    assert len(own) == 3 and optimizer.param_groups[0]["params"][0] is own.means
    torch.testing.assert_close(after, torch.stack((before[3], before[1], torch.zeros(3))))


def test_root_motion_between_frames() -> None:
    times = torch.tensor((0.0, 0.1, 0.3), dtype=torch.float64)
    assert [frame_position(times, t) for t in (-1.0, 0.0, 0.2, 9.0)] == pytest.approx([0, 0, 1.5, 2])
    quarter = torch.tensor(((0.0, -1, 0), (1, 0, 0), (0, 0, 1)), dtype=torch.float64)
    start = similarity(2.0, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    end = similarity(2.0, quarter, torch.tensor((2.0, 0, 0), dtype=torch.float64))
    middle = interpolate_similarity(torch.stack((start, end)), 0.5)
    turn = math.sqrt(0.5)
    expected = torch.tensor(((turn, -turn, 0), (turn, turn, 0), (0, 0, 1)), dtype=torch.float64)
    torch.testing.assert_close(middle, similarity(2.0, expected, torch.tensor((1.0, 0, 0), dtype=torch.float64)))
    assert interpolate_similarity(torch.stack((start, end)), 1.0) is not None


def test_mirroring_an_orientation_twice_is_nothing() -> None:
    quats = random_poses(1)[0]
    torch.testing.assert_close(mirror_quats(mirror_quats(quats)), quats)


def test_the_default_is_the_papers_profile() -> None:
    config = Config()
    assert (config.image_size, config.iterations) == (512, 20_000)
    assert (config.geometry.tv, config.geometry.compact, config.geometry.smooth) == (10.0, 0.1, 0.1)
    assert config.density == Density(cap=40_000)
    assert len(PARENTS) == 20


def test_neighbours_of_few_points_are_all_others() -> None:
    points = torch.tensor(((0.0, 0, 0), (1.0, 0, 0), (3.0, 0, 0)))
    assert neighbours(points, 5).tolist() == [[1, 2], [0, 2], [1, 0]]
    assert neighbours(points[:1], 5).shape == (1, 0)
