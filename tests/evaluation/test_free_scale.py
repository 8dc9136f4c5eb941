"""One fixed camera cannot know the animal's scale: its protocols score a reconstruction alike at every scale."""

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from animals import animal

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.cameras.rendering import render
from rewild4d.evaluation import placing
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.protocol import Protocol, find_protocol
from rewild4d.running.conformance import tiny_case
from rewild4d.transforms import axis_angle_to_matrix, transform_splats
from rewild4d.types import Camera, Case, Splats
from rewild4d.visualize.run_pictures import comparison

CPU = torch.device("cpu")
DIAGONAL = 5.0


class Still:
    """Gaussians on an animal that stands still in a case's world, scaled about the input camera's centre."""

    def __init__(self, case: Case, scale: float = 1.0, yaw: float = 0.0, squeeze: float = 1.0) -> None:
        camera = case.clip.frames[0].camera
        assert camera is not None
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = axis_angle_to_matrix(torch.tensor((0.0, yaw, 0.0), dtype=torch.float64))
        about = torch.eye(4, dtype=torch.float64)
        about[:3] *= scale
        about[:3, 3] = (1 - scale) * camera.center.double()
        self._matrix, self._squeeze = about @ case.prior.object_to_world[0] @ pose, squeeze

    def at(self, time: float) -> Splats:
        means = animal(1500, 0) * torch.tensor((1.0, self._squeeze, 1.0), dtype=torch.float64)
        colors = torch.zeros(1500, 4, 3).index_fill(1, torch.tensor(0), 0.4)
        colors[:, 3] = 0.6  # looks different from side to side
        quats = torch.tensor((1.0, 0, 0, 0)).expand(1500, 4)
        body = Splats(means.float(), quats, torch.full((1500, 3), 0.1), torch.full((1500,), 0.9), colors)
        return transform_splats(body, self._matrix)

    def camera(self, time: float) -> None: ...

    def save(self, folder: Path) -> None: ...


@pytest.fixture(scope="module")
def case() -> Case:
    """Two frames of one camera, and held-out views of the same still animal from others."""
    made = tiny_case()
    first = made.clip.frames[0]
    frames = tuple(replace(frame, camera=first.camera) for frame in made.clip.frames[:2])
    made = replace(made, clip=replace(made.clip, frames=frames))
    world, true = made.prior.object_to_world[0], Still(made).at(0.0)
    held_out = []
    for frame in [one for one in made.truth.held_out if one.time in {frame.time for frame in frames}]:
        assert frame.camera is not None
        rgb, mask = render(true, frame.camera)
        held_out.append(replace(frame, rgb=rgb, mask=mask))
    truth = replace(
        made.truth, held_out=held_out, diagonal=DIAGONAL * float(world[:3, 0].norm()),
        sample=lambda _, count, seed: animal(count, seed + 10) @ world[:3, :3].T + world[:3, 3],
        up=torch.nn.functional.normalize(world[:3, 1], dim=0),
    )  # fmt: skip
    return replace(made, truth=truth)


def quiet(*_: object) -> None:
    """No progress."""


def asking(*scores: str) -> Protocol:
    base = find_protocol("artemis", "artemis-fixed-128-v3")
    return msgspec.structs.replace(base, scores=scores, points=1200)


WANTED = ("psnr", "ssim", "iou", "camera_scale", "psnr_rigid", "iou_rigid", "chamfer_relative", "fscore_2")


@pytest.mark.parametrize("scale", [0.5, 1.29, 2.0])
def test_a_reconstruction_scaled_about_the_camera_scores_the_same(case: Case, scale: float) -> None:
    plain, scaled = (
        evaluate(Still(case, one), case.clip, case.truth, asking(*WANTED), quiet, CPU).scores for one in (1.0, scale)
    )
    assert scaled["camera_scale"].value == pytest.approx((plain["camera_scale"].value or 0) / scale, rel=1e-5)
    for name in set(WANTED) - {"camera_scale"}:
        assert scaled[name].value == pytest.approx(plain[name].value, abs=1e-3), name


def test_the_scale_that_was_lost_is_found_again_and_told(case: Case) -> None:
    found = evaluate(Still(case, 1 / 1.29), case.clip, case.truth, asking(*WANTED), quiet, CPU)
    scale = found.scores["camera_scale"]
    assert scale.value == pytest.approx(1.29, rel=0.01)
    assert (scale.better, scale.unit, scale.count) == ("", "1", 1)
    assert found.scores["psnr"].note == f"after a scale of {scale.value:.4g} about the input camera"
    assert found.scores["psnr_rigid"].note == f"{found.scores['psnr'].note} and a rigid motion"
    assert [one["fit"] for one in found.alignments] == ["sequence", "scale", "rigid"]
    matrix = torch.tensor(found.alignments[1]["matrix"], dtype=torch.float64)
    camera = case.clip.frames[0].camera
    assert camera is not None
    torch.testing.assert_close(matrix[:3, :3] @ camera.center + matrix[:3, 3], camera.center)


def test_the_older_version_scores_the_same_images_below(case: Case) -> None:
    """What the mend is for: without it a good reconstruction at another scale is scored for what nobody can see."""
    free = asking("iou")
    held = msgspec.structs.replace(free, free_scale=None)
    near, far = (
        evaluate(Still(case, 0.7), case.clip, case.truth, one, quiet, CPU).scores["iou"] for one in (free, held)
    )
    assert (near.value or 0) > (far.value or 0) + 0.1


def test_a_wrong_heading_is_lost_before_the_rigid_motion_and_not_after(case: Case) -> None:
    right, turned = (
        evaluate(Still(case, 1.5, yaw), case.clip, case.truth, asking(*WANTED), quiet, CPU).scores for yaw in (0, 0.35)
    )
    assert (turned["iou"].value or 0) < (right["iou"].value or 0) - 0.05
    assert turned["iou_rigid"].value == pytest.approx(right["iou_rigid"].value, abs=0.01)


def test_a_wrong_shape_is_lost_after_the_rigid_motion_too(case: Case) -> None:
    right, flat = (
        evaluate(Still(case, squeeze=one), case.clip, case.truth, asking(*WANTED), quiet, CPU).scores
        for one in (1, 0.6)
    )
    assert (flat["iou_rigid"].value or 0) < (right["iou_rigid"].value or 0) - 0.1


def test_an_empty_reconstruction_has_scores_and_no_scale(case: Case) -> None:
    scores = evaluate(EmptyReconstruction(), case.clip, case.truth, asking("psnr", "camera_scale"), quiet, CPU).scores
    assert scores["psnr"].value is not None and scores["psnr"].note == ""
    assert scores["camera_scale"].note == "not computed: there is nothing to scale"


def test_without_a_true_surface_no_held_out_view_is_scored(case: Case) -> None:
    bare = replace(case.truth, sample=None)
    scores = evaluate(Still(case), case.clip, bare, asking("psnr", "camera_scale", "psnr_rigid"), quiet, CPU).scores
    said = "not computed: the scale is open, and the data set has no geometry"
    assert [(one.value, one.note) for one in scores.values()] == [(None, said)] * 3


def test_a_camera_of_a_placement_sees_the_moved_points_where_the_camera_does() -> None:
    turn = axis_angle_to_matrix(torch.tensor((0.3, -0.5, 0.2), dtype=torch.float64))
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = 1.7 * turn, torch.tensor((0.4, -0.2, 0.9))
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[2, 3] = 8.0
    intrinsics = torch.tensor(((90.0, 0, 32), (0, 90, 24), (0, 0, 1)), dtype=torch.float64)
    camera, placement = Camera(world_to_camera, intrinsics, 64, 48), Placement(matrix)
    points = animal(20, 3)
    seen, depth = placement.camera(camera).project(points)
    expected, far = camera.project(placement.apply(points))
    torch.testing.assert_close(seen, expected)
    torch.testing.assert_close(depth, far / 1.7)
    same = IDENTITY.camera(camera)
    assert torch.equal(same.world_to_camera, camera.world_to_camera)


def test_pictures_show_held_out_views_as_they_are_scored(case: Case) -> None:
    protocol = asking(*WANTED)
    shown = []
    for scale in (1.0, 0.5):
        reconstruction = Still(case, scale)
        found = evaluate(reconstruction, case.clip, case.truth, protocol, quiet, CPU)
        placement = placing.scale_of(found.alignments)
        shown.append(comparison(reconstruction, case.clip, case.truth, placement))
    torch.testing.assert_close(shown[0], shown[1], atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("change", "text"),
    [({"selection": {"cameras": "sweep", "size": 128}}, "'free_scale' needs cameras = 'fixed' and 'points'"),
     ({"free_scale": None}, "the score 'camera_scale' needs 'free_scale'"),
     ({"free_scale": None, "scores": ["iou_rigid"]}, "the score 'iou_rigid' needs 'free_scale'")],
)  # fmt: skip
def test_a_protocol_that_frees_a_scale_says_what_it_needs(change: dict[str, object], text: str) -> None:
    given = msgspec.to_builtins(find_protocol("artemis", "artemis-fixed-128-v3")) | change
    with pytest.raises(msgspec.ValidationError, match=text):
        msgspec.convert(given, Protocol)
