"""The procedural quadruped: layout, symmetry, closed surface, skinning, kinematics."""

import pytest
import torch

from rewild4d.priors.bodies.body import Proportions, diagonal
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS, SECTIONS
from rewild4d.priors.kinematics import depth_levels, pose
from rewild4d.transforms import mirror_points, mirror_transforms, skin_points


@pytest.fixture(params=[0, 1])
def shape(request: pytest.FixtureRequest) -> Proportions:
    """The average animal and a random one."""
    generator = torch.Generator().manual_seed(3)
    return Proportions(request.param * 0.7 * torch.randn(QUADRUPED.measures, generator=generator))


def test_rest_shape_has_the_units_and_axes_of_the_object_frame(shape: Proportions) -> None:
    template = QUADRUPED.build(shape)
    assert float(diagonal(template.vertices)) == pytest.approx(5.0, abs=1e-5)
    head, tail = template.bones[0, 1], template.bones[4, 1]
    assert head[2] > tail[2]
    assert all(template.bones[foot, 1, 1] < template.bones[3, 0, 1] for foot in (8, 11, 14, 17))
    for foot, left, front in ((8, 1, 1), (11, 1, -1), (14, -1, -1), (17, -1, 1)):
        assert template.bones[foot, 1, 0].sign() == left and template.bones[foot, 0, 2].sign() == front


def test_symmetric_about_the_plane_with_the_mirror_involution(shape: Proportions) -> None:
    template, mirror = QUADRUPED.build(shape), torch.tensor(MIRROR)
    assert (mirror[mirror] == torch.arange(20)).all()
    assert torch.allclose(mirror_points(template.bones), template.bones[mirror], atol=1e-6)
    distances = torch.cdist(mirror_points(template.vertices), template.vertices)
    nearest = distances.min(1)
    assert float(nearest.values.max()) < 1e-3
    off_plane = template.vertices[:, 0].abs() > 0.01
    mirrored = template.weights[nearest.indices][:, mirror]
    assert torch.allclose(mirrored[off_plane], template.weights[off_plane], atol=1e-4)


def test_every_edge_of_the_mesh_is_shared_by_two_opposite_triangles(shape: Proportions) -> None:
    template = QUADRUPED.build(shape)
    edges = torch.cat([template.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]).tolist()
    directed = {tuple(edge) for edge in edges}
    assert len(directed) == len(edges)
    assert all((b, a) in directed for a, b in directed)


def test_every_tube_faces_outwards(shape: Proportions) -> None:
    template = QUADRUPED.build(shape)
    a, b, c = template.vertices[template.faces].unbind(1)
    volumes = (a * torch.linalg.cross(b, c)).sum(1) / 6
    body, leg = 2 * 47 * 16 + 32, 2 * 15 * 10 + 20
    assert len(volumes) == body + 4 * leg
    assert all(float(part.sum()) > 0 for part in volumes.split([body, leg, leg, leg, leg]))


def test_weights_sum_to_one_and_never_join_two_legs() -> None:
    weights = QUADRUPED.build().weights
    assert torch.allclose(weights.sum(1), torch.ones(len(weights)), atol=1e-6) and bool((weights >= 0).all())
    legs = torch.stack([weights[:, 8 + 3 * k : 11 + 3 * k].sum(1) for k in range(4)], 1)
    assert int(((legs > 0).sum(1) > 1).sum()) == 0
    assert all(float(weights[:, bone].max()) > 0.9 for bone in range(20))


def test_measures_change_what_they_name_and_carry_gradients() -> None:
    plain = QUADRUPED.build(QUADRUPED.proportions(neck_length=0.5), unit=False)
    longer = QUADRUPED.build(QUADRUPED.proportions(neck_length=1.5), unit=False)
    assert float((longer.bones[2, 0] - longer.bones[1, 1]).norm()) == pytest.approx(1.5, abs=1e-5)
    assert torch.allclose(plain.bones[8:], longer.bones[8:])
    deviations = torch.zeros(QUADRUPED.measures, requires_grad=True)
    template = QUADRUPED.build(Proportions(deviations), unit=False)
    (template.vertices.square().sum() + template.bones.square().sum()).backward()
    assert deviations.grad is not None and bool((deviations.grad != 0).all())


def test_relief_widens_one_place_of_both_sides_and_leaves_the_bones() -> None:
    relief = torch.zeros(sum(SECTIONS), 4, requires_grad=True)
    level = Proportions(torch.zeros(QUADRUPED.measures), relief)
    plain, flat = QUADRUPED.build(unit=False), QUADRUPED.build(level, unit=False)
    assert torch.equal(plain.vertices, flat.vertices)
    wide = relief.detach().clone()
    wide[8, 0] = 1.0
    widened = QUADRUPED.build(Proportions(torch.zeros(QUADRUPED.measures), wide), unit=False)
    moved = (widened.vertices - plain.vertices).abs()
    belly = moved[:, 0] > 1e-4
    assert float(moved[:, 1:].max()) < 1e-6 and torch.equal(plain.bones, widened.bones)
    assert float(plain.vertices[belly, 2].abs().max()) < 1.0 and 0 < int(belly.sum()) < 300
    flat.vertices.square().sum().backward()
    assert relief.grad is not None and bool((relief.grad != 0).all())


def test_turning_the_top_of_a_leg_moves_that_leg_rigidly_and_nothing_else() -> None:
    template = QUADRUPED.build()
    angles = torch.zeros(20, 3)
    angles[10, 0] = 0.7
    transforms = pose(angles, template.bones[:, 0], PARENTS)
    moved = [bone for bone in range(20) if not torch.allclose(transforms[bone], torch.eye(4), atol=1e-6)]
    assert moved == [8, 9, 10]
    assert torch.allclose(transforms[8], transforms[10], atol=1e-6)
    pivot = template.bones[10, 0]
    assert torch.allclose(transforms[10, :3, :3] @ pivot + transforms[10, :3, 3], pivot, atol=1e-6)


def test_mirrored_angles_give_the_mirrored_pose() -> None:
    template, mirror = QUADRUPED.build(), torch.tensor(MIRROR)
    angles = 0.5 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    swapped = angles[mirror] * torch.tensor((1.0, -1.0, -1.0))
    posed = pose(angles, template.bones[:, 0], PARENTS)
    mirrored = pose(swapped, template.bones[:, 0], PARENTS)
    assert torch.allclose(mirrored, mirror_transforms(posed, mirror), atol=1e-5)
    joints = template.bones[:, 1]
    left = skin_points(joints, torch.eye(20), posed)
    assert torch.allclose(skin_points(joints, torch.eye(20), mirrored)[mirror], mirror_points(left), atol=1e-5)


def test_a_cycle_of_parents_is_a_bug_that_says_so() -> None:
    with pytest.raises(ValueError, match="do not form a forest"):
        depth_levels((1, 0))
