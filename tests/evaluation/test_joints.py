"""Joints and tracked points of a reconstruction: the template's own skeleton, and a board with a dot behind it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from prior_files import ring
from toys import make_toy

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.baselines.floors_config import PriorOnlyConfig
from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyReconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation.joints import NotThere, bone_ends, joint_tracks, point_tracks
from rewild4d.priors.landmarks import LANDMARKS, load_mapping, marks
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Frame, Keypoints, Splats

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def toy() -> tuple[Clip, PriorOnlyReconstruction]:
    """The posed template as Gaussians, and the clip that it was coloured from."""
    clip, prior = make_toy()
    made = PriorOnly().fit(clip, prior, config=PriorOnlyConfig(gaussians=4000), seed=0, device=torch.device("cpu"),
                           log=lambda *_: None, workdir=None)  # fmt: skip
    return clip, made


def test_bones_end_where_the_template_says_within_a_twentieth_of_its_size(
    toy: tuple[Clip, PriorOnlyReconstruction],
) -> None:
    wanted = toy[1].prior.bones
    off = (bone_ends(toy[1])[:, 1] - wanted[:, 1]).norm(dim=1)
    assert off.max() < OBJECT_DIAGONAL / 20
    inner = [bone for bone in range(20) if bone not in (0, 4, 8, 11, 14, 17)]
    assert off[inner].max() < 1e-5  # where the next bone begins


def test_joints_are_drawn_where_the_prior_projects_its_landmarks(toy: tuple[Clip, PriorOnlyReconstruction]) -> None:
    clip, made = toy
    names = tuple(load_mapping("aptv2"))
    found = joint_tracks(made, load_mapping("aptv2"), names, clip.frames)
    assert found.points.shape == (len(clip.frames), 17, 2) and found.seen.all()
    knee = names.index("left_knee")
    bone, along = LANDMARKS["rear_left_upper"]
    start, end = made.prior.bones[bone]
    for row, frame in enumerate(clip.frames):
        assert frame.camera is not None
        wanted, _ = frame.camera.project((start + along * (end - start)).double())
        assert found.points[row, knee] == pytest.approx(wanted.numpy(), abs=1e-3)


def test_another_order_of_names_is_another_order_of_joints(toy: tuple[Clip, PriorOnlyReconstruction]) -> None:
    clip, made = toy
    mapping = load_mapping("aptv2")
    first = joint_tracks(made, mapping, ("nose", "neck"), clip.frames[:1]).points
    again = joint_tracks(made, mapping, ("neck", "nose"), clip.frames[:1]).points
    assert np.array_equal(first, again[:, ::-1])


def test_what_has_no_such_skeleton_says_why(toy: tuple[Clip, PriorOnlyReconstruction]) -> None:
    clip, made = toy
    with pytest.raises(NotThere, match="this method has no skeleton"):
        joint_tracks(EmptyReconstruction(), load_mapping("aptv2"), ("nose",), clip.frames)
    other = PriorOnlyReconstruction(made.prior, made.sample, made.colors, made.cameras, made.thickness)
    other.parents = torch.arange(-1, 19)
    with pytest.raises(NotThere, match="not the template's of 20 bones"):
        bone_ends(other)
    with pytest.raises(NotThere, match="no Gaussian is drawn"):
        point_tracks(EmptyReconstruction(), clip.frames)


def test_a_skeleton_with_a_nan_is_an_error(toy: tuple[Clip, PriorOnlyReconstruction]) -> None:
    clip, made = toy
    broken = PriorOnlyReconstruction(
        replace(made.prior, transforms=made.prior.transforms * torch.nan), made.sample, made.colors, made.cameras,
        made.thickness,
    )  # fmt: skip
    with pytest.raises(UserError, match="joints at 0.0000 s hold a NaN"):
        joint_tracks(broken, load_mapping("aptv2"), ("nose",), clip.frames)


class Board:
    """A board of Gaussians at z = 0 seen from +z, and one dot a unit behind its middle; they move right with time."""

    def at(self, time: float) -> Splats:
        grid = torch.cartesian_prod(torch.linspace(-2, 2, 21), torch.linspace(-2, 2, 21))
        means = torch.cat((torch.nn.functional.pad(grid, (0, 1)), torch.tensor([[0.05, 0.05, -1.0]])))
        means = means + torch.tensor((time, 0.0, 0.0))
        count = len(means)
        return Splats(means, torch.tensor((1.0, 0, 0, 0)).expand(count, 4), torch.full((count, 3), 0.15),
                      torch.full((count,), 0.9), torch.full((count, 1, 3), 0.5))  # fmt: skip

    def camera(self, time: float) -> Camera | None:
        return ring([0.0])[0]

    def save(self, folder: object) -> None: ...


def still(time: float) -> Frame:
    return Frame(time, None, torch.zeros(3, 64, 64), torch.zeros(1, 64, 64))


def test_a_point_behind_the_board_is_hidden_and_all_points_move_with_it() -> None:
    found = point_tracks(Board(), [still(0.0), still(0.5)])
    assert found.points.shape[1] == 442
    assert not found.seen[:, -1].any() and found.seen[:, :-1].all()
    moved = found.points[1, :441] - found.points[0, :441]
    assert (moved[:, 0] > 3).all() or (moved[:, 0] < -3).all()
    assert abs(moved[:, 1]).max() < 0.2


def test_gaussians_that_come_and_go_cannot_be_tracked() -> None:
    class Growing(Board):
        def at(self, time: float) -> Splats:
            splats = super().at(time)
            return Splats(*(value[: 400 if time else 441] for value in vars(splats).values()))

    with pytest.raises(NotThere, match="not the same ones at every moment"):
        point_tracks(Growing(), [still(0.0), still(0.5)])


def test_every_keypoint_of_the_mappings_has_a_place() -> None:
    for name in ("aptv2", "badja"):
        names = tuple(load_mapping(name))
        shown = Keypoints(names, torch.zeros(len(names), 2), torch.ones(len(names), dtype=torch.bool))
        assert len(marks([shown], load_mapping(name))) == len(names)
