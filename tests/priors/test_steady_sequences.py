"""Rows that are steady in one sequence alone: image, pose, world and root agree after the other one was mended."""

import math
from dataclasses import replace

import pytest
import torch
from prior_files import a_prior, ring

from rewild4d.ours.motion import Root
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS
from rewild4d.priors.kinematics import pose
from rewild4d.priors.placing import known_frames, with_cameras
from rewild4d.priors.steady import without_hops
from rewild4d.transforms import camera_in_object, mirror_points, rigid
from rewild4d.types import Camera, Clip, Frame, Prior

COUNT, PLAIN_HOPS, FLIP_HOPS = 12, 4, 7
ANGLES = [0.1 * t for t in range(COUNT)]


def posed_prior() -> Prior:
    """A prior whose plain camera hops in one frame and whose mirrored one in another, in poses of no symmetry."""
    hopping = [angle + math.pi * (t == PLAIN_HOPS) for t, angle in enumerate(ANGLES)]
    mirrored = [-angle + math.pi * (t == FLIP_HOPS) for t, angle in enumerate(ANGLES)]
    angles = 0.3 * torch.randn(2, COUNT, 20, 3, generator=torch.Generator().manual_seed(0))
    plain, flipped = (pose(each, QUADRUPED.build().bones[:, 0], PARENTS) for each in angles)
    made = a_prior(hopping, mirrored)
    return replace(made, transforms=plain, transforms_flip=flipped, mirror=torch.tensor(MIRROR))


def pixels(points: torch.Tensor, transforms: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Project points that are fixed to one bone each, [J, 3] and [J, 4, 4] -> [J, 2]."""
    return camera.project((transforms[:, :3, :3] @ points[..., None])[..., 0] + transforms[:, :3, 3])[0]


@pytest.mark.parametrize("row", [PLAIN_HOPS, FLIP_HOPS])
def test_a_mended_sequence_shows_the_mirror_image_of_the_other(row: int) -> None:
    """A point of a bone lies in one image where its reflection, on the other side's bone, lies in the flipped one."""
    given = posed_prior()
    made = without_hops(given).prior
    points = QUADRUPED.build().bones[:, 1] + 0.1
    reflected = mirror_points(points)[given.mirror]  # given.mirror is its own inverse
    plain = pixels(points, made.transforms[row], made.cameras[row])
    flipped = pixels(reflected, made.transforms_flip[row], made.cameras_flip[row])[given.mirror]
    torch.testing.assert_close(plain[:, 0], 64 - flipped[:, 0], atol=1e-3, rtol=0)
    torch.testing.assert_close(plain[:, 1], flipped[:, 1], atol=1e-3, rtol=0)
    steady = (given.transforms_flip, made.transforms_flip) if row == PLAIN_HOPS else (given.transforms, made.transforms)
    assert torch.equal(steady[0][row], steady[1][row]), "the steady sequence stays as it is"


def film() -> Clip:
    """Frames without cameras at the prior's times."""
    frames = [Frame(t / 24, None, torch.zeros(3, 64, 64), torch.ones(1, 64, 64)) for t in range(COUNT)]
    return Clip("a/film", "none", tuple(frames), 24.0, "CC0", "")


@pytest.mark.parametrize("walks", [False, True])
def test_the_camera_in_the_world_and_the_root_agree(walks: bool) -> None:
    """Of an animal that walks past a fixed camera, object_to_world hops with the camera in the object frame."""
    given = posed_prior()
    if walks:  # the camera's own axes are the world
        given = replace(given, object_to_world=torch.stack([camera.world_to_camera for camera in given.cameras]))
    made = without_hops(given).prior
    clip = with_cameras(known_frames(film(), made), made)
    root = Root.of(clip, made)
    assert len(clip.frames) == COUNT
    for row, frame in enumerate(clip.frames):
        assert frame.camera is not None and root.cameras[row] is frame.camera
        seen = camera_in_object(frame.camera, root.object_to_world[row]).world_to_camera
        torch.testing.assert_close(seen, made.cameras[row].world_to_camera)
        wanted = torch.eye(4).double() if walks else ring(ANGLES)[row].world_to_camera
        torch.testing.assert_close(frame.camera.world_to_camera, wanted, atol=1e-6, rtol=0)
    others = [row for row in range(COUNT) if row != PLAIN_HOPS]
    assert torch.equal(made.object_to_world[others], given.object_to_world[others])
    if not walks:
        assert torch.equal(made.object_to_world, given.object_to_world), "the world of a film is the object frame"


def test_a_root_that_nothing_tells_is_that_of_the_nearest_steady_frame() -> None:
    ends = [angle + math.pi * (t in (0, COUNT - 1)) for t, angle in enumerate(ANGLES)]
    shifts = torch.arange(COUNT).double()[:, None] * torch.tensor((0.0, 0.0, 1.0)).double()
    walked = rigid(torch.eye(3).double().expand(COUNT, 3, 3), shifts)
    given = replace(a_prior(ends, [-angle for angle in ANGLES]), object_to_world=walked)
    made = without_hops(given).prior
    assert made.object_to_world[:, 2, 3].tolist() == [1, *range(1, COUNT - 1), COUNT - 2]
