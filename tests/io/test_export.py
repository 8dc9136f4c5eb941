"""Exported files, read back: Gaussians, the skinned animation, cameras and films."""

import json
from dataclasses import replace
from pathlib import Path

import moving
import numpy as np
import pytest
import torch
from imageio.v2 import get_reader
from records_for_tests import PROTOCOL, record

from rewild4d import cli
from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.baselines.external_gltf import read_animation
from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyConfig, PriorOnlyReconstruction
from rewild4d.contracts import Articulated
from rewild4d.datasets.rigs.reader import clips, load_rig
from rewild4d.errors import UserError
from rewild4d.io.export import camera_table, export, parse_kinds, why_not
from rewild4d.io.ply import read_splats
from rewild4d.io.skinned_glb import SEEN, influences, squares, write_glb
from rewild4d.leaderboard.records import write_record
from rewild4d.ours.config import Canonical, Config, Deform, Skinning
from rewild4d.ours.model import build_model
from rewild4d.ours.motion import Root
from rewild4d.ours.reconstruction import OursReconstruction
from rewild4d.running.conformance import tiny_case
from rewild4d.transforms import skin_points
from rewild4d.types import Case, Crop, Frame, Splats

CONFIG = Config(
    canonical=Canonical(samples=150, sh_degree=1), skinning=Skinning(resolution=10, sweeps=5), deform=Deform(width=16)
)


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case(frames=5, width=48, height=32)


@pytest.fixture(scope="module")
def prior_only(case: Case) -> PriorOnlyReconstruction:
    return PriorOnly().fit(
        case.clip, case.prior, config=PriorOnlyConfig(gaussians=300), seed=0, device=torch.device("cpu"),
        log=lambda *_: None, workdir=None,
    )  # fmt: skip


@pytest.fixture(scope="module")
def ours(case: Case) -> OursReconstruction:
    """A model whose joints turn and shift at random; its deformation network is still zero."""
    generator = torch.Generator().manual_seed(1)
    model = build_model(CONFIG, case.prior, generator)
    with torch.no_grad():
        model.network.head.weight.normal_(0, 0.15, generator=generator)
    return OursReconstruction(model, CONFIG, Root.of(case.clip, case.prior))


@pytest.mark.parametrize("name", ["prior_only", "ours"])
def test_skinning_the_glb_gives_the_posed_points(
    name: str, case: Case, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    reconstruction = request.getfixturevalue(name)
    (path,) = export(reconstruction, case.clip, ["glb"], tmp_path)
    assert clips(path) == ["motion"]
    animal = load_rig(path, "motion", frames=len(case.clip.frames) - 1)  # the keys but the last
    bones, rest = len(case.prior.parents), reconstruction.canonical()
    assert len(animal.bone_names) == bones
    order = [int(bone.removeprefix("bone_")) for bone in animal.bone_names]
    parents = [order[p] if p >= 0 else -1 for p in animal.parents]
    assert parents == [int(case.prior.parents[bone]) for bone in order]
    seen = rest.opacities >= SEEN
    moved = 0.0
    for index, time in enumerate(case.clip.times[:-1]):
        corners = torch.from_numpy(animal.posed(index)[0]).reshape(-1, 4, 3)
        at = reconstruction.at(time).means.double()[seen]
        size = float((at.amax(0) - at.amin(0)).norm())
        assert float((corners.mean(1) - at).abs().max()) < 2e-4 * size
        transforms, to_world = reconstruction.articulation(time)
        objects = skin_points(rest.means.double(), reconstruction.weights.double(), transforms.double())
        world = objects @ to_world.double()[:3, :3].T + to_world.double()[:3, 3]
        assert float((corners.mean(1) - world[seen]).abs().max()) < 2e-4 * size
        moved = max(moved, float((objects - rest.means).abs().max()))
    assert moved > 0.1


def test_an_exported_glb_read_as_a_result_has_the_frames_poses(
    prior_only: PriorOnlyReconstruction, case: Case, tmp_path: Path
) -> None:
    """Frame k of the video lies at frame k of the file, the last one included: a video is no loop."""
    paths = export(prior_only, case.clip, ["glb"], tmp_path)
    found = read_animation(paths[0], case.clip.times)
    for parts, time in zip(found, case.clip.times, strict=True):
        corners = torch.cat([part.vertices for part in parts]).double()
        middles = corners.view(-1, 4, 3).mean(1)
        torch.testing.assert_close(middles, prior_only.at(time).means.double(), atol=1e-4, rtol=0)


def test_the_squares_lie_in_their_gaussians(prior_only: PriorOnlyReconstruction) -> None:
    splats = prior_only.canonical()
    corners, faces, normals = squares(splats)
    assert corners.shape == (4 * len(splats), 3) and faces.shape == (2 * len(splats), 3)
    torch.testing.assert_close(corners.reshape(-1, 4, 3).mean(1), splats.means)
    out = corners.reshape(-1, 4, 3) - splats.means[:, None]
    assert float((out * normals.reshape(-1, 4, 3)).sum(-1).abs().max()) < 1e-5
    a, b, c = corners[faces].unbind(1)
    turned = torch.linalg.cross(b - a, c - a)
    assert bool(((turned * normals[faces[:, 0]]).sum(-1) > 0).all())
    longest = splats.scales.sort(1, descending=True).values
    torch.testing.assert_close(turned.norm(dim=1)[::2], (3 * longest[:, 0]) * (3 * longest[:, 1]))


def test_influences_are_sorted_and_sum_to_one() -> None:
    weights = torch.softmax(3 * torch.randn(50, 20, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), 1)
    joints, shares = influences(weights)
    assert shares.shape[1] % 4 == 0
    torch.testing.assert_close(shares.sum(1), torch.ones(50, dtype=torch.float64))
    assert bool((shares[:, 1:] <= shares[:, :-1]).all())
    assert float((weights.gather(1, joints) - shares)[shares > 0].abs().max()) < 20 * 1e-3
    one = influences(torch.eye(3, dtype=torch.float64))
    assert one[0].shape == (3, 4) and one[0][:, 0].tolist() == [0, 1, 2]


def test_ply_frames_are_the_gaussians_of_their_times(
    prior_only: PriorOnlyReconstruction, case: Case, tmp_path: Path
) -> None:
    paths = export(prior_only, case.clip, ["ply"], tmp_path)
    assert [path.name for path in paths] == [f"{i:05d}.ply" for i in range(5)]
    for path, time in zip(paths, case.clip.times, strict=True):
        read, wanted = read_splats(path), prior_only.at(time)
        torch.testing.assert_close(read.means, wanted.means)
        torch.testing.assert_close(read.scales, wanted.scales)


def test_cameras_project_as_the_clip_does(prior_only: PriorOnlyReconstruction, case: Case, tmp_path: Path) -> None:
    (path,) = export(prior_only, case.clip, ["cameras"], tmp_path)
    table = json.loads(path.read_text())
    point = np.array((0.4, -0.1, 0.6))
    for row, frame in zip(table["frames"], case.clip.frames, strict=True):
        assert frame.camera is not None and row["time"] == frame.time
        local = np.array(row["world_to_camera"]) @ np.append(point, 1)
        pixel = np.array(row["intrinsics"]) @ local[:3]
        assert np.allclose(pixel[:2] / pixel[2], frame.camera.project(torch.from_numpy(point))[0].numpy())
        assert (row["width"], row["height"]) == (48, 32)


def test_a_crop_is_told_beside_its_camera(prior_only: PriorOnlyReconstruction) -> None:
    frame = Frame(0.0, None, torch.zeros(3, 8, 8), torch.zeros(1, 8, 8), 0, Crop(1.5, -2.0, 40.0, 96, 54))
    (row,) = camera_table(EmptyReconstruction(), [frame])["frames"]
    assert row == {"time": 0.0, "crop": {"left": 1.5, "top": -2.0, "side": 40.0, "original": [96, 54]}}


def test_films_have_a_picture_for_each_frame(prior_only: PriorOnlyReconstruction, case: Case, tmp_path: Path) -> None:
    paths = export(prior_only, case.clip, ["mp4"], tmp_path)
    with get_reader(paths[0], format="ffmpeg") as reader:  # type: ignore[arg-type]
        pictures = [frame for frame in reader]  # noqa: C416 - list() asks for a length that a film has not
    assert len(pictures) == len(case.clip.frames) and pictures[0].shape == (32, 48, 3)
    assert (np.asarray(pictures[2]) < 200).any()


class Cloud:
    """Gaussians without a skeleton."""

    def at(self, time: float) -> Splats:
        return Splats(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1),
                      torch.ones(1, 1, 3))  # fmt: skip

    def camera(self, time: float) -> None:
        return None

    def save(self, folder: Path) -> None: ...


def test_what_cannot_be_written_says_why(case: Case, prior_only: PriorOnlyReconstruction) -> None:
    assert isinstance(prior_only, Articulated)
    assert why_not(prior_only, "glb", case.clip) == ""
    assert why_not(Cloud(), "glb", case.clip) == "the method has no skeleton with skinning weights"
    blind = replace(case.clip, frames=tuple(replace(frame, camera=None) for frame in case.clip.frames))
    assert why_not(Cloud(), "cameras", blind) == "neither the data set nor the method knows a camera"
    assert why_not(EmptyReconstruction(), "ply", case.clip) == "there are no Gaussians"
    with pytest.raises(UserError, match="unknown kind of export 'gbl'. Did you mean 'glb'?"):
        parse_kinds("ply,gbl")


def test_the_command(
    tmp_path: Path, case: Case, prior_only: PriorOnlyReconstruction, capsys: pytest.CaptureFixture[str], cache: Path
) -> None:
    moving.frames(tmp_path / "clip" / "frames")
    moving.masks(tmp_path / "clip" / "masks")
    settings = {"settings": json.dumps({"fps": "10.0", "end": "0.85"})}
    for method, reconstruction in (("prior-only", prior_only), ("empty", EmptyReconstruction())):
        saved = tmp_path / method / "reconstruction"
        saved.mkdir(parents=True)
        reconstruction.save(saved)
        found = record(method=method, dataset="online", case="clip", protocol=PROTOCOL | {"name": "online-256-v2"},
                       data={"root": str(tmp_path / "clip"), **settings})  # fmt: skip
        write_record(found, tmp_path / method)
    with pytest.raises(SystemExit) as stop:
        cli.main(["export", str(tmp_path / "prior-only"), "--out", str(tmp_path / "files"), "--what", "ply,glb"])
    assert stop.value.code == 0
    frames = [f"ply/{i:05d}.ply" for i in range(9)]  # nine frames up to 0.85 s, the two that are held out too
    assert capsys.readouterr().out.split() == [str(tmp_path / "files" / name) for name in (*frames, "animated.glb")]
    with pytest.raises(SystemExit) as stop:
        cli.main(["export", str(tmp_path / "empty"), "--out", str(tmp_path / "none"), "--what", "glb"])
    assert stop.value.code == 2
    assert "nothing can be written: glb: the method has no skeleton" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_key_times_that_do_not_ascend_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"key times that ascend in single precision, got \[0.0, 0.1, 0.1\]"):
        write_glb(tmp_path / "a.glb", None, [0.0, 0.1, 0.1], "", "")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())
