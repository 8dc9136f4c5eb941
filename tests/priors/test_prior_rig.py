"""The prior that is the truth: a skeleton of a data set in the object frame, and what it is made from on disk."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from animals import yaw
from artemis_animals import FRAMES, block, turned, write_animal
from prior_files import a_prior
from torch import Tensor

from rewild4d.datasets.artemis.files import list_motions
from rewild4d.datasets.artemis.rig import read_rig
from rewild4d.datasets.artemis.volume import read_pose
from rewild4d.errors import UserError
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import require_loadable
from rewild4d.priors.kinematics import pose
from rewild4d.priors.rig import rig_prior, twins
from rewild4d.transforms import axis_angle_to_matrix, rigid, similarity, skin_points
from rewild4d.types import Camera, Clip, Frame, Rig, Truth

COUNT, SIZE = 3, 0.3
TRUE = torch.from_numpy(turned(1))


def moved(points: Tensor, matrix: Tensor) -> Tensor:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def a_rig() -> tuple[Rig, Tensor]:
    """The template as somebody's rig: any axes, bones with local axes of their own, a body that goes its way; and the
    vertices as they are in the world at each frame, [T, n, 3]."""
    template, generator = QUADRUPED.build(), torch.Generator().manual_seed(0)
    stand = similarity(SIZE, TRUE, torch.tensor((0.4, -0.2, 3.0), dtype=torch.float64))
    pivots = template.bones[:, 0].double()
    axes = axis_angle_to_matrix(torch.randn(20, 3, generator=generator, dtype=torch.float64))
    rest = rigid(axes, pivots)
    angles = 0.3 * torch.randn(COUNT, 20, 3, generator=generator)
    angles[0] = 0  # a plane of symmetry leaves the pitch open, which is the template's in the first frame
    going = rigid(
        axis_angle_to_matrix(torch.tensor([[0.0, 0.2 * t, 0] for t in range(COUNT)], dtype=torch.float64)),
        torch.tensor([[0.0, 0, 0.3 * t] for t in range(COUNT)], dtype=torch.float64),
    )
    joints = pose(angles, template.bones[:, 0], PARENTS).double()
    points = torch.stack(
        [
            moved(skin_points(template.vertices.double(), template.weights.double(), joints[t]), stand @ going[t])
            for t in range(COUNT)
        ]
    )
    bones = stand @ going[:, None] @ joints @ rest
    vertices = moved(template.vertices.double(), stand)
    parents = torch.tensor(PARENTS)
    rig = Rig(vertices, template.faces, template.weights.double(), stand @ rest, bones, parents)
    return rig, points


def a_clip() -> Clip:
    camera = Camera(
        rigid(torch.eye(3, dtype=torch.float64), torch.tensor((0.0, 0.0, 2.0), dtype=torch.float64)),
        torch.tensor(((60.0, 0, 32), (0, 60.0, 20), (0, 0, 1)), dtype=torch.float64), 64, 40,
    )  # fmt: skip
    image = torch.zeros(3, 40, 64), torch.ones(1, 40, 64)
    frames = tuple(Frame(t / 24, camera, *image) for t in range(COUNT))
    return Clip("made/up", "none", frames, 24.0, "CC0 1.0", "0")


def fitted(degrees: float) -> Tensor:
    """object_to_world of a template that was fitted well but for a turn about the vertical and its size."""
    return similarity(1.3 * SIZE, TRUE @ yaw(degrees), torch.zeros(3, dtype=torch.float64)).repeat(COUNT, 1, 1)


@pytest.mark.parametrize("degrees", [0.0, 17.0, -33.0])
def test_a_rig_becomes_a_prior_that_moves_as_the_animal_does(degrees: float) -> None:
    rig, points = a_rig()
    template = replace(a_prior([0.0] * COUNT, [0.0] * COUNT), object_to_world=fitted(degrees))
    found = rig_prior(a_clip(), rig, template)
    require_loadable(found, Path("rig"))
    for t in range(COUNT):
        posed = skin_points(found.vertices.double(), found.weights.double(), found.transforms[t].double())
        assert (moved(posed, found.object_to_world[t]) - points[t]).abs().max() < 1e-5
    # the object frame is the template's own but for where its origin lies in the plane of symmetry
    shift = found.vertices.mean(0) - QUADRUPED.build().vertices.mean(0)
    assert abs(shift[0]) < 2e-3 and (found.vertices - shift - QUADRUPED.build().vertices).abs().max() < 1e-2
    assert found.mirror.tolist() == list(MIRROR) and found.parents.tolist() == list(PARENTS)
    assert found.name == "rig" and "mask_iou" in found.quality


def test_bones_that_are_scaled_keep_their_joints() -> None:
    rig, _ = a_rig()
    swollen = rig.bones.clone()
    swollen[:, 8, :3, :3] *= 1.4
    template = replace(a_prior([0.0] * COUNT, [0.0] * COUNT), object_to_world=fitted(0.0))
    found = rig_prior(a_clip(), replace(rig, bones=swollen), template)
    require_loadable(found, Path("rig"))
    for t in range(COUNT):
        joint = moved(found.bones[8, :1, :].double(), found.transforms[t, 8].double())
        assert (moved(joint, found.object_to_world[t]) - swollen[t, 8, :3, 3]).abs().max() < 1e-5


def test_twins_are_each_others_and_near() -> None:
    places = torch.tensor([(0.0, 0, 0), (1, 0, 0), (-1.05, 0, 0), (1, 2, 0), (-1.6, 2, 0), (0.02, 3, 0)])
    bones = places[:, None].repeat(1, 2, 1)
    assert twins(bones).tolist() == [0, 2, 1, 3, 4, 5]


def test_a_rig_is_read_from_a_folder(tmp_path: Path) -> None:
    folder = write_animal(tmp_path / "box")
    motion = next(iter(list_motions(folder)))
    rig = read_rig(folder, [read_pose(folder, motion, frame, 2) for frame in range(FRAMES)])
    wanted = block()
    # through the outermost centres but for what the blur takes from the corners: a third of a cell
    assert np.allclose(np.ptp(rig.vertices.numpy(), axis=0), np.ptp(wanted, axis=0), atol=0.1)
    assert torch.allclose(rig.vertices.mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-6)
    assert torch.allclose(rig.weights, torch.tensor((0.75, 0.25), dtype=torch.float64).expand(len(rig.vertices), 2))
    assert rig.parents.tolist() == [-1, 0] and rig.bones.shape == (FRAMES, 2, 4, 4)
    corners = rig.vertices[rig.faces]
    signed = (torch.linalg.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6
    assert 0.5 * np.prod(np.ptp(wanted, axis=0)) < signed < 1.5 * np.prod(np.ptp(wanted, axis=0)), "outward-facing"


def test_bones_that_move_nothing_are_left_out(tmp_path: Path) -> None:
    folder = write_animal(tmp_path / "box")
    for path in folder.glob("bones/**/Bones_*.inf"):
        lines = path.read_text().splitlines()
        path.write_text("\n".join([lines[0], lines[0], *lines[1:]]) + "\n")  # a bone between the two, without weight
    indices = torch.load(folder / "volumes" / "volume_indices.pth", weights_only=True)
    torch.save(torch.where(indices == 1, 2, indices), folder / "volumes" / "volume_indices.pth")
    (parents,) = [path for path in (folder / "bones").iterdir() if path.suffix == ".npy"]
    np.save(parents, np.array((0, 0, 1)))  # the root's own parent is itself in some files
    poses = [read_pose(folder, "walk", frame, 3) for frame in range(FRAMES)]
    rig = read_rig(folder, poses)
    assert rig.parents.tolist() == [-1, 0]
    assert torch.equal(rig.bones[2, 1], torch.from_numpy(poses[2][2]))


def test_a_data_set_without_a_rig() -> None:
    with pytest.raises(UserError, match="--prior rig: expected a data set with bones and a volume, but made/up has"):
        PriorChoice("rig", STANDARD).identity(a_clip(), Truth((), None, "0"))
