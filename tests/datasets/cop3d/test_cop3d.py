"""CoP3D: PyTorch3D's cameras, frames by their numbers, soft masks, splits, what is missing and what is wrong."""

import gzip
from pathlib import Path
from typing import Any

import benchmark_films
import moving
import numpy as np
import pytest
import torch
from calling import call, output, refusal

from rewild4d.contracts import Selection
from rewild4d.datasets.builtin import filming
from rewild4d.datasets.cop3d.cameras import FORMATS, Viewpoint, from_opencv, to_opencv
from rewild4d.datasets.cop3d.reader import Cop3d, evaluation_sequences, refined_sequences
from rewild4d.datasets.images import read_alpha
from rewild4d.datasets.video.splits import split_frames
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol

pytestmark = pytest.mark.usefixtures("cache")

CASE = "dog/1_2_3"
FIFTEEN_OF_TWENTY, ALL_SHOWN = (find_protocol("cop3d", name).selection.split for name in ("cop3d-v1", "cop3d-all-v1"))
HELD_OUT = Selection(cameras="known", size=96, framing="letterbox", split=FIFTEEN_OF_TWENTY)
SHOWN = Selection(cameras="known", size=96, framing="full", split=ALL_SHOWN, mask_threshold=0.7)


def pytorch3d_pixels(view: Viewpoint, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Project as PyTorch3D does: X R + T, then f X / Z + p, then normalised device coordinates to the screen.

    "ndc_norm_image_bounds": each axis runs over [-1, 1] from right to left and from the bottom to the top; in
    "ndc_isotropic" the shorter one does, and the longer one has the same scale.
    """
    width, height = size
    seen = points @ np.array(view.R) + np.array(view.T)
    x, y = (seen[:, :2] / seen[:, 2:] * view.focal_length + view.principal_point).T
    if view.intrinsics_format == "ndc_norm_image_bounds":
        return np.stack(((1 - x) / 2 * width, (1 - y) / 2 * height), axis=1)
    short = min(width, height)
    return np.stack((width / 2 - x * short / 2, height / 2 - y * short / 2), axis=1)


@pytest.mark.parametrize("size", [(640, 360), (360, 640), (500, 500)])
@pytest.mark.parametrize("form", FORMATS)
def test_cameras_project_as_pytorch3d_does(form: str, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    view = Viewpoint(
        tuple(map(tuple, rotation)), tuple(rng.normal(size=3)), (2.1, 1.7), (0.1, -0.2), form,  # type: ignore[arg-type]
    )  # fmt: skip
    points = (rng.normal(size=(50, 3)) + (0, 0, 9) - np.array(view.T)) @ rotation.T
    camera = to_opencv(view, size)
    pixels, depths = camera.project(torch.from_numpy(points))
    assert (depths > 0).all()
    assert np.abs(pixels.numpy() - pytorch3d_pixels(view, points, size)).max() < 1e-9
    back = from_opencv(camera, form)
    for name in ("R", "T", "focal_length", "principal_point"):
        assert np.allclose(back[name], getattr(view, name), atol=1e-12)


def test_a_camera_that_looks_along_z_needs_no_arithmetic() -> None:
    """PyTorch3D's identity: x to the left, y up. A point up left of the axis is above and left of the middle."""
    identity: Any = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))
    camera = to_opencv(Viewpoint(identity, (0, 0, 0), (1, 1), (0, 0), "ndc_isotropic"), (200, 100))
    pixels, _ = camera.project(torch.tensor([[1.0, 1.0, 2.0]], dtype=torch.float64))
    assert pixels.tolist() == [[100 - 50 * 1 / 2, 50 - 50 * 1 / 2]]
    camera = to_opencv(Viewpoint(identity, (0, 0, 0), (1, 1), (0, 0), "ndc_norm_image_bounds"), (200, 100))
    pixels, _ = camera.project(torch.tensor([[1.0, 1.0, 2.0]], dtype=torch.float64))
    assert pixels.tolist() == [[100 - 100 * 1 / 2, 50 - 50 * 1 / 2]]


@pytest.mark.parametrize("form", FORMATS)
def test_frames_are_read_with_their_cameras(form: str, tmp_path: Path) -> None:
    reader = Cop3d(benchmark_films.cop3d(tmp_path, form=form))
    clip, truth = reader.load(CASE, HELD_OUT)
    assert (clip.species, clip.fps, clip.travel) == ("dog", 20, None)
    assert [round(20 * time) for time in clip.times] == [*range(15)]
    assert [round(20 * frame.time) for frame in truth.held_out] == [*range(15, 20)]
    points = torch.from_numpy(np.random.default_rng(1).normal(0, 0.3, (20, 3)))
    for number, frame in enumerate((*clip.frames, *truth.held_out)):
        assert frame.camera is not None and frame.crop is None and frame.mask.shape == (1, 96, 96)
        wanted = benchmark_films.camera(number).project(points)[0]
        found = frame.camera.project(points)[0]
        assert torch.allclose(found, wanted + torch.tensor((0.0, (96 - 64) / 2)), atol=1e-9), "padded above and below"
    frame = clip.frames[0]
    assert not frame.mask[0, :16].any() and not frame.mask[0, -16:].any()
    assert frame.mask[0, 16:-16][moving.mask(0) > 0].eq(1).all()
    whole = Selection(cameras="known", size=48, framing="full", split=(1, 0))
    small = reader.load(CASE, whole)[0].frames[0]
    assert small.camera is not None and small.mask.shape == (1, 32, 48)
    assert torch.allclose(small.camera.project(points)[0], benchmark_films.camera(0).project(points)[0] / 2)


def test_masks_are_soft_or_solid_above_a_threshold(tmp_path: Path) -> None:
    reader = Cop3d(benchmark_films.cop3d(tmp_path))
    soft = reader.load(CASE, HELD_OUT)[0].frames[0]
    solid = reader.load(CASE, SHOWN)[0].frames[0]
    assert soft.mask.unique().tolist() == pytest.approx([0, 128 / 255, 1])
    assert solid.mask.unique().tolist() == [0, 1] and solid.mask.sum() == (moving.mask(0) > 0).sum()
    image = torch.from_numpy(moving.image(0)).permute(2, 0, 1).float() / 255
    assert torch.allclose(solid.rgb, image * solid.mask)
    assert reader.load(CASE, HELD_OUT)[0].digest != reader.load(CASE, SHOWN)[0].digest


def test_splits_are_those_of_the_two_papers() -> None:
    assert [i for i, test in enumerate(split_frames(42, FIFTEEN_OF_TWENTY)) if test] == [*range(15, 20), *range(35, 40)]
    assert not any(split_frames(42, ALL_SHOWN))


def test_every_frame_is_shown_and_scored_where_none_is_held_out(tmp_path: Path) -> None:
    clip, truth = Cop3d(benchmark_films.cop3d(tmp_path)).load(CASE, SHOWN)
    assert len(clip.frames) == 20 and list(clip.times) == [frame.time for frame in truth.held_out]
    first = Selection(cameras="known", size=96, framing="full", split=(15, 0), frames=7)
    assert len(Cop3d(tmp_path).load(CASE, first)[0].frames) == 7


def test_missing_files_are_told_and_move_no_frame_to_another_side(tmp_path: Path) -> None:
    root = benchmark_films.cop3d(tmp_path)
    for number, kind in ((2, "images"), (3, "images"), (9, "masks"), (16, "masks")):
        (root / CASE / kind / f"frame{2 * number + 1:06d}.png").unlink()
    clip, truth = Cop3d(root).load(CASE, HELD_OUT)
    assert [round(20 * time) for time in clip.times] == [0, 1, 4, 5, 6, 7, 8, 10, 11, 12, 13, 14]
    assert [round(20 * frame.time) for frame in truth.held_out] == [15, 17, 18, 19]
    assert clip.notes == (
        "2 of 20 frames without an image left out: frame 2 to frame 3",
        "2 of 20 frames without a mask left out: frame 9, frame 16",
    )


def test_sequences_that_are_not_unpacked_are_no_cases(tmp_path: Path) -> None:
    root = benchmark_films.cop3d(tmp_path)
    assert Cop3d(root).cases(SHOWN) == [CASE] == Cop3d(root / "dog").cases(SHOWN)
    (root / CASE / "images").rename(root / CASE / "pictures")
    with pytest.raises(UserError, match="expected folders of sequences"):
        Cop3d(root).cases(SHOWN)
    (root / CASE / "images").mkdir()
    with pytest.raises(UserError, match=r"expected an image for its 20 frames, got none \(is its part of the download"):
        Cop3d(root).load(CASE, SHOWN)


def test_the_fifty_evaluation_sequences_are_the_default(tmp_path: Path) -> None:
    names = evaluation_sequences()
    assert len({*names}) == 50 and len(refined_sequences()) == 40 and {*refined_sequences()} <= {*names}
    benchmark_films.cop3d(tmp_path)
    assert Cop3d(tmp_path).default_cases(SHOWN) == [CASE]
    benchmark_films.cop3d(tmp_path, sequence="1006_75_704")
    reader = Cop3d(tmp_path)
    assert reader.default_cases(SHOWN) == ["dog/1006_75_704"]


def test_refined_masks_are_found_by_the_frames_number(tmp_path: Path) -> None:
    root = benchmark_films.cop3d(tmp_path / "data")
    for number in range(20):
        moving.save(tmp_path / "refined" / "1_2_3" / f"frame{number:06d}.png", moving.mask(number, left=30) // 255)
    reader = Cop3d(root, masks=tmp_path / "refined")
    mask = reader.load(CASE, SHOWN)[0].frames[4].mask
    assert torch.equal(mask[0], torch.from_numpy(moving.mask(4, left=30)).float() / 255)
    assert reader.settings == {"masks": str((tmp_path / "refined").resolve())}


def test_times_that_do_not_ascend_are_replaced_and_told(tmp_path: Path) -> None:
    root = benchmark_films.cop3d(tmp_path)
    benchmark_films.changed_frames(root, frame_timestamp=-1.0)
    clip, _ = Cop3d(root).load(CASE, SHOWN)
    assert clip.fps == 20 / (20 / 4), "20 frames of a film of 5 seconds"
    assert clip.notes[0] == "the times of its frames do not ascend: 4 frames a second assumed"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"intrinsics_format": "pixels"},
            "expected intrinsics_format ndc_norm_image_bounds or ndc_isotropic, got 'pix",
        ),
        ({"T": [0.0, float("nan"), 1.0]}, "expected a camera of finite numbers, got a NaN or an infinite one."),
        ({"R": [[1.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0]]}, "expected a rotation as R, got a matrix that is none."),
        ({"R": [[-1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]}, "expected a rotation as R, got a matrix that is none."),
        ({"focal_length": [1.0, -2.0]}, "expected a focal_length above 0, got [1.0, -2.0]."),
    ],
)
def test_a_camera_that_cannot_be_used_is_one_sentence(changes: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    root = benchmark_films.cop3d(tmp_path)
    benchmark_films.changed_frames(root, viewpoint=changes)
    with pytest.raises(UserError) as error:
        Cop3d(root).load(CASE, SHOWN)
    assert str(error.value).startswith(f"{root}/dog/frame_annotations.jgz: frame 0 of 1_2_3: {sentence}")


def test_files_that_cannot_be_used_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = benchmark_films.cop3d(tmp_path / "a")
    whole = root / "dog" / "frame_annotations.jgz"
    data = whole.read_bytes()
    for content, said in (
        (data[: len(data) // 2], "it is cut off or damaged (Compressed file ended before"),
        (b"[]", "it is cut off or damaged (Not a gzipped file"),
        (gzip.compress(b"[{}]"), "Object missing required field `sequence_name`"),
        (gzip.compress(b"[]"), "expected annotations of the frames of 1_2_3, got none"),
    ):
        whole.write_bytes(content)
        with pytest.raises(UserError) as error:
            Cop3d(root).load(CASE, SHOWN)
        assert str(error.value).startswith(f"{whole}: ") and said in str(error.value)
    whole.write_bytes(data)
    moving.save(root / CASE / "masks" / "frame000003.png", moving.mask(1, (48, 32)))
    said = refusal(capsys, "run", "--method", "empty", "--dataset", "cop3d", "--data", root, "--out", tmp_path / "runs")
    assert "frame000003.png: expected 96x64 pixels like its image, got 48x32." in said and "Traceback" not in said
    benchmark_films.changed_frames(root, image={"size": [10, 10]})
    with pytest.raises(UserError, match=r"frame000001.png: expected 10x10 pixels like its annotation, got 96x64"):
        Cop3d(root).load(CASE, SHOWN)
    with pytest.raises(UserError, match=r"expected CoP3D's folder with cat/frame_annotations.jgz or dog/.*neither"):
        Cop3d(moving.frames(tmp_path / "b"))


def test_a_written_film_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("make", "cop3d", "--seeds", "0", "--frames", "6", "--size", "64x96")
    (folder,) = map(Path, output(capsys, *words, "--intrinsics", "ndc_isotropic", "--out", tmp_path / "a").split())
    assert folder == tmp_path / "a" / "dog" / "0_6_6"
    reader = Cop3d(tmp_path / "a")
    clip, _ = reader.load("dog/0_6_6", SHOWN)
    subsets = reader.set_list("dog", "manyview_0")
    assert subsets["train"][1] == ("0_6_6", 2, "dog/0_6_6/images/frame000005.jpg") and len(subsets["test"]) == 3
    for frame, shot in zip(clip.frames, filming.film(0, 6, 64, 96), strict=True):
        assert frame.camera is not None
        assert torch.allclose(frame.camera.world_to_camera, shot.camera.world_to_camera)
        assert torch.allclose(frame.camera.intrinsics, shot.camera.intrinsics)
    solid = read_alpha(folder / "masks" / "frame000003.png") > 0.7 * 255
    assert torch.equal(clip.frames[1].mask[0] > 0, torch.from_numpy(solid)), "frame 1 is the second file, number 3"
    assert call("check", "--dataset", "cop3d", "--data", tmp_path / "a", "--sheets", tmp_path / "sheets") == 0
    assert "6 frames of 64x96 at 20 a second" in capsys.readouterr().out
    said = refusal(capsys, "make", "cop3d", "--seeds", "1", "--out", tmp_path / "b")
    assert "expected cats and dogs, as CoP3D has (0, 3, 20, 23, 40, 43, ...), got 1, a stag" in said
    assert not (tmp_path / "b").exists()
