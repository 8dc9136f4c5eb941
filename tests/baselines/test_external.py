"""Programs of others: every layout read back, every failure a sentence and a failed record, nobody's code needed."""

import math
from pathlib import Path

import pytest
import torch
from external_program import UPPER, bodies, fit, psnr, settings
from torch import Tensor

from rewild4d.baselines import external_alignment
from rewild4d.baselines.external_folder import crop_box
from rewild4d.cameras.rendering import render
from rewild4d.errors import UserError
from rewild4d.priors.motion import pose_at
from rewild4d.transforms import similarity, skin_points
from rewild4d.types import Case

pytestmark = pytest.mark.usefixtures("coarse_grid")


@pytest.mark.parametrize("what", ["plain", "ascii", "order", "sh1", "sh2", "sh3"])
def test_every_kind_of_ply_gives_the_same_pictures(case: Case, tmp_path: Path, what: str) -> None:
    known = bodies(case)
    found = fit(case, settings(tmp_path, what, known))
    assert psnr(found, case) > 25
    assert found.marks == () and found.at(0.0).colors.shape[1] == (int(what[2]) + 1) ** 2 if what[:2] == "sh" else True
    torch.testing.assert_close(found.at(case.clip.times[1]).means, torch.tensor(known[1]["points"]), atol=1e-5, rtol=0)
    frame = case.clip.frames[1]
    assert frame.camera is not None
    plain = fit(case, settings(tmp_path, "plain", known))
    images = [render(each.at(frame.time), frame.camera)[0] for each in (found, plain)]
    assert (images[0] - images[1]).abs().max() < 0.02


@pytest.mark.parametrize("what", ["colored", "textured", "mesh"])
def test_meshes_become_gaussians(case: Case, tmp_path: Path, what: str) -> None:
    """With colours of their own, with a texture, and without either: then the frames paint them."""
    found = fit(case, settings(tmp_path, what, bodies(case)))
    splats = found.at(0.0)
    assert len(splats) == 4000
    frame = case.clip.frames[0]
    assert frame.camera is not None
    alpha = render(splats, frame.camera)[1]
    shared = ((alpha > 0.5) & (frame.mask > 0.5)).sum() / ((alpha > 0.5) | (frame.mask > 0.5)).sum()
    assert shared > 0.9
    if what == "textured":
        colors = {tuple(color) for color in splats.colors[:, 0].round().int().tolist()}
        assert colors == {(1, 0, 0), (0, 1, 0)}
    else:
        assert psnr(found, case) > (25 if what == "colored" else 21)
        assert psnr(found, case, held_out=True) > 17


def test_a_result_elsewhere_is_rotated_to_the_best_input_view_and_marked(case: Case, tmp_path: Path) -> None:
    """DreamMesh4D's layout, turned, moved and grown: the search brings it back, and says that it did."""
    turn = upright(case, up=2, azimuth=70.0)
    away = similarity(4.0, turn, torch.tensor((1.0, 2.0, 3.0)).double())
    config = settings(tmp_path, "dreammesh4d", bodies(case, away), profile="dreammesh4d")
    found = fit(case, config)
    assert found.marks == (UPPER,)
    truth = torch.tensor(bodies(case)[1]["points"]).double()
    means = found.at(case.clip.times[1]).means.double()
    diagonal = float((truth.amax(0) - truth.amin(0)).norm())
    # The stub's texture is grey, so the place comes from the outlines.
    assert float((means.median(0).values - truth.median(0).values).norm()) < 0.1 * diagonal
    size = float(means.std(0).norm() / truth.std(0).norm())
    assert 0.85 < size < 1.15
    assert found.diagnostics()["placed_scale"] == pytest.approx(1 / 4, rel=0.15)
    assert "moments" not in found.diagnostics(), "as many files as frames need no remark"


def test_gaussians_elsewhere_are_found_by_their_colours(case: Case, tmp_path: Path) -> None:
    """GVFDiffusion's layout: its axes, its own number of moments."""
    away = similarity(0.5, upright(case, up=1, azimuth=200.0, sign=-1), torch.tensor((0.3, 0.1, 0.2)).double())
    config = settings(tmp_path, "gvfdiffusion", bodies(case, away), profile="gvfdiffusion")
    found = fit(case, config)  # tries every axis for up
    own = fit(case, settings(tmp_path, "plain", bodies(case)))
    assert psnr(found, case) > psnr(own, case) - 2.5
    assert len(found.moments) == 3 and found.times == pytest.approx(case.clip.times)
    notes = found.diagnostics()
    assert notes["program"] == "GVFDiffusion" and notes["placed_psnr"] > 20


def test_files_for_other_moments_than_the_frames_are_told(case: Case, tmp_path: Path) -> None:
    config = settings(tmp_path, "gvfdiffusion", bodies(case)[:2], profile="gvfdiffusion", placed="yes")
    found = fit(case, config)
    assert found.diagnostics()["moments"] == "2 files for 3 frames, spread evenly over the clip"
    assert found.times == pytest.approx((0.1 / 3, 0.5 / 3)) and found.marks == ()


def test_gaussians_in_one_place_are_not_searched_for(case: Case, tmp_path: Path) -> None:
    content = [{**body, "points": [[1.0, 2.0, 3.0]] * 4000} for body in bodies(case)]
    with pytest.raises(UserError, match="expected an object with an extent, got 4000 Gaussians in one place"):
        fit(case, settings(tmp_path, "plain", content, placed="no"))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["0"] * 11, "pose.txt: expected twelve finite numbers, got 11."),
        (["0"] * 11 + ["nan"], "pose.txt: expected twelve finite numbers, got 12."),
        (["0"] * 11 + ["x"], "pose.txt: expected twelve numbers, but: could not convert"),
        (["1"] * 11 + ["10"], "pose.txt: expected a mesh before 3D-Fauna's camera, got one at depth 0."),
    ],
)
def test_a_damaged_camera_of_fauna_is_one_sentence(case: Case, tmp_path: Path, words: list[str], sentence: str) -> None:
    (tmp_path / "pose.txt").write_text(" ".join(words))
    camera = case.clip.frames[0].camera
    assert camera is not None
    with pytest.raises(UserError, match=sentence):
        external_alignment.place_fauna(tmp_path / "pose.txt", (0.0, 0.0, 64.0), camera, 2.0)


def upright(case: Case, up: int, azimuth: float, sign: int = 1) -> Tensor:
    """World -> a frame of reference whose axis ``up`` (times ``sign``) is the first camera's up, turned about it."""
    camera = case.clip.frames[0].camera
    assert camera is not None
    top = torch.nn.functional.normalize(case.prior.object_to_world[0, :3, 1], dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(top, camera.world_to_camera[2, :3]), dim=0)
    angle = math.radians(azimuth)
    spin = torch.tensor(
        ((math.cos(angle), -math.sin(angle), 0), (math.sin(angle), math.cos(angle), 0), (0, 0, 1))
    ).double()
    to_z = spin @ torch.stack((side, torch.linalg.cross(top, side), top))
    if up == 2:
        return to_z
    to_y = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0))).double() @ to_z
    return to_y if sign > 0 else torch.diag(torch.tensor((1.0, -1.0, -1.0)).double()) @ to_y


def test_faunas_camera_puts_its_mesh_where_the_frame_shows_it(case: Case, tmp_path: Path) -> None:
    """A mesh as 3D-Fauna predicts it: in object space, with a camera of its own for the crop."""
    content = bodies(case)
    rest = case.prior.vertices
    for index, (frame, body) in enumerate(zip(case.clip.frames, content, strict=True)):
        assert frame.camera is not None
        object_to_world, transforms = pose_at(case.prior, frame.time)
        body["vertices"] = skin_points(rest, case.prior.weights, transforms).tolist()
        whole = frame.camera.world_to_camera @ object_to_world
        scale = torch.linalg.det(whole[:3, :3]) ** (1 / 3)
        turn, place = whole[:3, :3] / scale, whole[:3, 3] / scale
        left, top, side = crop_box(frame.mask)
        focal = side / 2 / math.tan(math.radians(12.5))
        k = frame.camera.intrinsics
        pixel = k @ (place / place[2])
        # The same size in the crop fixes its depth; the same place in the crop the rest.
        depth = float(place[2]) * focal / float(k[0, 0])
        center = torch.stack(
            ((pixel[0] - left - side / 2) / focal, (pixel[1] - top - side / 2) / focal, torch.ones(()))
        )
        seen = external_alignment._between(place / place[2], center) @ turn
        flip = torch.diag(torch.tensor((1.0, -1.0, -1.0)).double())
        moved = flip @ (depth * center.double()) - torch.tensor((0.0, 0.0, -10.0)).double()
        body["pose"] = [*(flip @ seen).T.flatten().tolist(), *moved.tolist()]
        assert index < 3
    found = fit(case, settings(tmp_path, "fauna", content, profile="3d-fauna"))
    assert found.marks == (), "its camera places it, so it is no upper bound"
    for frame in case.clip.frames:
        assert frame.camera is not None
        alpha = render(found.at(frame.time), frame.camera)[1]
        shared = ((alpha > 0.5) & (frame.mask > 0.5)).sum() / ((alpha > 0.5) | (frame.mask > 0.5)).sum()
        assert shared > 0.85
