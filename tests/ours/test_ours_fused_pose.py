"""The fused kernels of poses and skeleton against their plain torch twins in double precision."""

import copy
import math

import msgspec
import pytest
import torch
from torch import Tensor
from twins import check_twins, leaves, normal, same_on_any_threads, unit

from rewild4d.kernels.switch import VARIABLE
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.config import Config, Deform
from rewild4d.ours.config import Pose as PoseConfig
from rewild4d.ours.losses.config import Geometry
from rewild4d.ours.losses.skeleton import posture, skeleton_losses
from rewild4d.ours.model import Model
from rewild4d.ours.pose import Pose, PoseNetwork, blend_poses, pose_distance, time_code
from rewild4d.ours.skinning import SkinningField
from rewild4d.ours.symmetry import Key
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS
from rewild4d.types import OBJECT_DIAGONAL

SMALL = PoseConfig(width=32, heads=2, anchor_size=5, frequencies=2)


def network(config: PoseConfig, joints: int = 20, dtype: torch.dtype = torch.float32) -> PoseNetwork:
    """One whose every parameter matters: norms, biases and head are not at their start."""
    made = PoseNetwork(joints, config, torch.Generator().manual_seed(0))
    for i, (name, parameter) in enumerate(made.named_parameters()):
        if parameter.dim() == 1 or name.startswith("head"):
            parameter.data += 0.1 * normal(*parameter.shape, seed=i).float()
    return made.to(dtype)


def model(dtype: torch.dtype = torch.float32, pose: PoseConfig = SMALL) -> Model:
    values = {name: torch.zeros(4, size) for name, size in (("means", 3), ("quats", 4), ("log_scales", 3))}
    values |= {"logit_opacities": torch.zeros(4), "colors": torch.zeros(4, 1, 3)}
    grid = SkinningField(torch.zeros(8, 20), torch.zeros(3), torch.ones(3), torch.tensor(MIRROR), False)
    skeleton = QUADRUPED.build().bones[:, 0].float(), torch.tensor(PARENTS), torch.tensor(MIRROR)
    config = Config(deform=Deform(width=16), pose=pose)
    made = Model(config, Gaussians(values, 1.0), grid, *skeleton, torch.Generator().manual_seed(0))
    made.network = network(pose)
    return made.to(dtype)


@pytest.mark.parametrize(
    ("batch", "joints", "config"),
    [
        (1, 20, PoseConfig()),
        (3, 20, SMALL),
        (13, 20, msgspec.structs.replace(SMALL, blocks=1)),
        (2, 17, msgspec.structs.replace(SMALL, width=16, heads=1, anchor_size=8, blocks=3)),
        (5, 3, msgspec.structs.replace(SMALL, blocks=0)),
    ],
)
def test_poses(batch: int, joints: int, config: PoseConfig) -> None:
    flipped = torch.arange(batch) % 2 == 1
    mirror = torch.arange(joints).flip(0)

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        own = network(config, joints, dtype)
        code = normal(batch, 2 + 2 * config.frequencies, seed=1).to(dtype)
        return [*own(code), *own(code, flipped, mirror)], dict(own.named_parameters())

    check_twins(make)


@pytest.mark.parametrize(("width", "heads"), [(24, 3), (16, 4)])
def test_sizes_that_the_kernels_do_not_take_go_to_the_twin(width: int, heads: int) -> None:
    config = msgspec.structs.replace(SMALL, width=width, heads=heads)
    code = normal(2, 6, seed=1)
    wanted, found = network(config, dtype=torch.float64)(code), network(config)(code.float())
    for one, other in zip(wanted, found, strict=True):
        torch.testing.assert_close(one.float(), other, atol=1e-5, rtol=1e-5)


def test_poses_are_the_same_bits_for_any_number_of_threads_and_without_a_gradient() -> None:
    own, code = network(SMALL), normal(30, 6, seed=1).float()

    def make() -> list[Tensor]:
        own.zero_grad()
        pose = own(code)
        torch.stack([part.square().sum() for part in pose]).sum().backward()
        return [*pose, *(parameter.grad for parameter in own.parameters())]

    found = same_on_any_threads(make)
    with torch.no_grad():
        assert all(torch.equal(a, b) for a, b in zip(own(code), found[:3], strict=True))


def test_one_pose_does_not_depend_on_the_others_of_its_batch() -> None:
    own, code = network(SMALL), normal(30, 6, seed=1).float()
    whole = own(code)
    for row in (0, 11, 12, 29):
        for all_of_them, alone in zip(whole, own(code[row : row + 1]), strict=True):
            torch.testing.assert_close(all_of_them[row], alone[0], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("explicit", [False, True])
def test_time_codes(explicit: bool) -> None:
    signs = torch.tensor((1.0, -1.0, 1.0)), torch.tensor((1.0, 1.0, -1.0))
    times = torch.tensor((0.1, 0.7, 1.0))
    wanted = time_code(times.double(), signs[0], signs[1], 4, explicit)
    found = time_code(times, *signs, 4, explicit)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, wanted.float(), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("tied", [False, True])
def test_poses_of_views(tied: bool) -> None:
    keys = [Key(1, 1, 0), Key(-1, 1, 2), Key(1, -1, 3), Key(-1, -1, 1)]
    times = torch.tensor([(key.frame + 1) / 4 for key in keys])

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        own = model(dtype, msgspec.structs.replace(SMALL, tied=tied))
        return list(own.pose(times.to(dtype), keys)), dict(own.network.named_parameters())

    check_twins(make)


@pytest.mark.parametrize("kernels", ["auto", "torch"])
def test_tied_poses_of_a_mirror_image_are_those_of_the_image_mirrored(
    kernels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, kernels)
    own = model(pose=msgspec.structs.replace(SMALL, tied=True))
    times = torch.tensor((0.25, 0.25))
    for group in (1, -1):
        pose = own.pose(times, [Key(group, 1, 0), Key(group, -1, 0)])
        for wanted, found in zip(pose.mirrored(own.mirror), pose, strict=True):
            torch.testing.assert_close(found[1], wanted[0])
        assert (pose.quats[1] - pose.quats[0]).abs().max() > 1e-3, "left and right are alike"


def batch_of_poses(dtype: torch.dtype, batch: int) -> dict[str, Tensor]:
    """Some joints turn far beyond the limit, some have the other sign."""
    turns = torch.nn.functional.normalize(torch.tensor((1.0, 0, 0, 0)) + normal(batch, 20, 4, seed=1), dim=-1)
    return leaves(dtype, quats=turns, shifts=normal(batch, 20, 3, seed=2), features=normal(batch, 20, 4, seed=3))


def triples(batch: int) -> Tensor | None:
    """Frames between the views of triples; one triple has a frame missing before its last view."""
    return torch.ones(batch // 3, 2, dtype=torch.float64) + torch.eye(2)[1:] if batch % 3 == 0 else None


@pytest.mark.parametrize(("batch", "rows"), [(1, [0]), (3, [1]), (6, [0, 4]), (2, [])])
@pytest.mark.parametrize(
    "only", ["limit", "attach", "temporal", "still", "limb_plane", "body_plane", "sideways", None, ""]
)
def test_posture(batch: int, rows: list[int], only: str | None) -> None:
    weights = {"limit": 3.0, "attach": 20.0, "temporal": 10.0, "still": 2.0}
    weights |= {"limb_plane": 40.0, "body_plane": 30.0, "sideways": 50.0}
    if only is not None:
        weights = {name: value * (name == only) for name, value in weights.items()}
    config = Geometry(**weights)

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        given = batch_of_poses(dtype, batch)
        pose, transforms, total = posture(
            model(dtype), Pose(**given), torch.tensor(rows, dtype=torch.long), config, triples(batch)
        )
        return [*pose, transforms, total[None]], given

    check_twins(make)


def test_the_sum_alone_is_that_of_the_posture() -> None:
    own, pose, config = model(), Pose(**batch_of_poses(torch.float32, 3)), Geometry()
    alone = skeleton_losses(own, pose, own.transforms(pose), config, triples(3))
    assert float(alone.detach()) == float(posture(own, pose, torch.tensor([1]), config, triples(3))[2].detach()) > 0


def test_only_neighbouring_frames_have_a_bend() -> None:
    own, pose = model(), Pose(**batch_of_poses(torch.float32, 3))
    config = Geometry(limit=0.0, attach=0.0, temporal=10.0, still=1.0)
    assert float(skeleton_losses(own, pose, own.transforms(pose), config, None).detach()) == 0
    assert (
        float(posture(own, pose, torch.tensor([0, 1, 2]), config, None)[2].detach()) == 0
    )  # three views of a clip of two frames
    assert float(posture(own, pose, torch.tensor([1]), config, triples(3))[2].detach()) > 0


def test_a_missing_frame_between_two_doubles_their_distance() -> None:
    """What moves evenly in time has no bend, and a step over two frames is half as long for each."""
    own, rest = model(), torch.tensor((1.0, 0, 0, 0)).repeat(3, 20, 1)
    shifts = torch.zeros(3, 20, 3)
    shifts[:, :, 2] = torch.tensor((0.0, 1.0, 3.0))[:, None]  # at frames 0, 1 and 3
    pose, gaps = Pose(rest, shifts, torch.zeros(3, 20, 4)), torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    bend, drift = (
        Geometry(limit=0.0, attach=0.0, **{"temporal": 0.0, **one}) for one in ({"temporal": 1.0}, {"still": 1.0})
    )
    assert float(posture(own, pose, torch.tensor([1]), bend, gaps)[2]) == pytest.approx(0, abs=1e-12)
    even = float(posture(own, pose, torch.tensor([1]), bend, torch.ones_like(gaps))[2])
    assert even == pytest.approx((3 - 2 * 1 + 0) ** 2 / OBJECT_DIAGONAL**2)
    step, scale = 1 / OBJECT_DIAGONAL, drift.still_step
    assert float(posture(own, pose, torch.tensor([1]), drift, gaps)[2]) == pytest.approx(
        scale * step**2 / (step**2 + scale**2)
    )


def test_a_skeleton_without_parents_has_no_joints_to_hold() -> None:
    given = {dtype: batch_of_poses(dtype, 3) for dtype in (torch.float32, torch.float64)}
    for dtype, leaf in given.items():
        own = model(dtype)
        own.parents.fill_(-1)
        total = posture(own, Pose(**leaf), torch.tensor([1]), Geometry(temporal=0.0), triples(3))[2]
        assert float(total.detach()) == 0, dtype


def test_attachment_of_a_shifted_joint() -> None:
    own, shifts = model(), torch.zeros(1, 20, 3)
    leaf = next(joint for joint in range(20) if joint not in PARENTS)
    shifts[0, leaf, 1] = 0.5
    pose = Pose(torch.tensor((1.0, 0, 0, 0)).repeat(1, 20, 1), shifts, torch.zeros(1, 20, 4))
    config = Geometry(limit=0.0, temporal=0.0, attach=2.0)
    bones = sum(parent >= 0 for parent in PARENTS)
    expected = 2.0 * (0.5 / OBJECT_DIAGONAL) ** 2 / bones
    assert float(posture(own, pose, torch.tensor([0]), config, None)[2]) == pytest.approx(expected, rel=1e-5)


def test_what_drifts_costs_and_what_moves_is_left_alone() -> None:
    own, shifts, quats = model(), torch.zeros(3, 20, 3), torch.tensor((1.0, 0, 0, 0)).repeat(3, 20, 1)
    step = 2e-3
    config = Geometry(limit=0.0, attach=0.0, temporal=0.0, still=2.0, still_step=step)

    def cost(way: float) -> tuple[float, float]:
        """Of one joint that takes the first of its two steps, with the grad by its way in diagonals."""
        moved = shifts.clone()
        moved[1:, 7, 1] = way * OBJECT_DIAGONAL
        moved.requires_grad_(True)
        total = posture(
            own,
            Pose(quats, moved, torch.zeros(3, 20, 4)),
            torch.tensor([1]),
            config,
            torch.ones(1, 2, dtype=torch.float64),
        )[2]
        total.backward()
        return float(total.detach()), -float(moved.grad[0, 7, 1]) * OBJECT_DIAGONAL

    share = 2.0 / (2 * 20)  # one of two steps of one of twenty joints
    quats[1] = -quats[1]  # the same rotation
    assert cost(0.0) == (0, 0)
    assert cost(step) == pytest.approx((share * step / 2, share / 2), rel=1e-4)
    assert cost(3 * step) == pytest.approx((share * step * 9 / 10, share * 6 / 100), rel=1e-4)


def test_a_bone_beyond_its_limit() -> None:
    own, quats = model(), torch.tensor((1.0, 0, 0, 0)).repeat(1, 20, 1)
    leaf = next(joint for joint in range(20) if joint not in PARENTS)
    half = math.radians(90) / 2
    quats[0, leaf] = torch.tensor((math.cos(half), 0, 0, math.sin(half)))
    pose = Pose(quats, torch.zeros(1, 20, 3), torch.zeros(1, 20, 4))
    config = Geometry(limit=1.0, limit_degrees=60.0, attach=0.0, temporal=0.0)
    bones = sum(parent >= 0 for parent in PARENTS)
    expected = (math.cos(math.radians(30)) - math.cos(half)) ** 2 / bones
    assert float(posture(own, pose, torch.tensor([0]), config, None)[2]) == pytest.approx(expected, rel=1e-4)


def test_what_leaves_the_planes_along_the_body() -> None:
    own, rest, flat = model(), torch.tensor((1.0, 0, 0, 0)), Geometry(limit=0.0, attach=0.0, temporal=0.0)
    limbs = sum(other != joint for joint, other in enumerate(MIRROR))
    half = math.radians(20) / 2
    foot, head = 8, 0

    def cost(joint: int, axis: int, **weights: float) -> float:
        """Of a bone that turns by 20 degrees about an axis, and whose joint is .5 along it from its parent's."""
        quats, shifts = rest.repeat(1, 20, 1), torch.zeros(1, 20, 3)
        quats[0, joint, 0], quats[0, joint, 1 + axis], shifts[0, joint, axis] = math.cos(half), math.sin(half), 0.5
        pose = Pose(-quats, shifts, torch.zeros(1, 20, 4))  # the same rotations
        return float(posture(own, pose, torch.tensor([0]), msgspec.structs.replace(flat, **weights), None)[2])

    out = math.sin(half) ** 2
    assert [cost(foot, axis, limb_plane=3.0) for axis in range(3)] == pytest.approx(
        [0, 3 * out / limbs, 3 * out / limbs]
    )
    assert [cost(foot, axis, sideways=3.0) for axis in range(3)] == pytest.approx([3 * 0.1**2 / limbs, 0, 0])
    assert [cost(head, axis, body_plane=3.0) for axis in range(3)] == pytest.approx([0, 3 * out / 8, 3 * out / 8])
    assert cost(head, 1, limb_plane=3.0, sideways=3.0) == cost(foot, 1, body_plane=3.0) == 0
    # What turns with its parent has not left its plane.
    turned = torch.tensor((math.cos(half), 0, math.sin(half), 0)).repeat(1, 20, 1)
    pose = Pose(turned, torch.zeros(1, 20, 3), torch.zeros(1, 20, 4))
    held = msgspec.structs.replace(flat, limb_plane=3.0)
    assert float(posture(own, pose, torch.tensor([0]), held, None)[2]) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("weight", [0.3, 1.0])
def test_blend_and_distance(weight: float) -> None:
    others, moved = unit(2, 20, 4, seed=4), normal(2, 20, 3, seed=5)

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        given = batch_of_poses(dtype, 2)
        blended = blend_poses(Pose(**given), others.to(dtype), moved.to(dtype), weight)
        apart = pose_distance(Pose(**given), others.to(dtype), moved.to(dtype))
        return [*blended, apart[None]], given

    check_twins(make)


def test_the_kernels_take_the_parameters_in_the_networks_own_order() -> None:
    own = network(SMALL)
    copied = copy.deepcopy(own)
    copied.load_state_dict({name: 2 * value for name, value in own.state_dict().items()}, assign=True)
    copied.requires_grad_()
    code = normal(1, 6, seed=1)
    wanted = copy.deepcopy(copied).double()(code)
    for one, other in zip(wanted, copied(code.float()), strict=True):
        torch.testing.assert_close(one.float(), other, atol=1e-4, rtol=1e-4)
