"""Artemis folders: what the writer writes the reader reads, and cameras follow the pixels through every framing."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from artemis_animals import DOT, FRAMES, HEIGHT, VIEWS, WIDTH, block, dot_image, ring, turned, write_animal

from rewild4d.contracts import Selection
from rewild4d.datasets.artemis.files import (
    NO_LICENCE,
    frames_per_second,
    list_motions,
    read_cameras,
    read_intrinsics,
    read_matrices,
    read_parents,
)
from rewild4d.datasets.artemis.reader import Artemis
from rewild4d.datasets.artemis.selection import placed_view, selected_views, up_direction
from rewild4d.datasets.artemis.volume import is_surface, lattice
from rewild4d.datasets.images import read_rgb
from rewild4d.errors import UserError
from rewild4d.types import Frame

pytestmark = pytest.mark.usefixtures("cache")

SWEEP = Selection(cameras="sweep", size=WIDTH)


def centroid(frame: Frame) -> np.ndarray:
    """Centre of the matte in pixels, centres at +0.5, (u, v)."""
    mask = frame.mask[0].double().numpy()
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]] + 0.5
    return np.array(((mask * columns).sum(), (mask * rows).sum())) / mask.sum()


def test_row_is_third_first_second_fourth_column(tmp_path: Path) -> None:
    path = tmp_path / "Bones_0000.inf"
    path.write_text("13 23 33 11 21 31 12 22 32 14 24 34\n")
    expected = [[11, 12, 13, 14], [21, 22, 23, 24], [31, 32, 33, 34], [0, 0, 0, 1]]
    assert read_matrices(path, "bone").tolist() == [expected]


def test_intrinsics_gain_half_a_pixel_with_or_without_index(tmp_path: Path) -> None:
    block = "1000 0 959.5\n0 1001 539.5\n0 0 1\n"
    for text in (f"0\n{block}\n1\n{block}\n", block + block):
        path = tmp_path / "Intrinsic.inf"
        path.write_text(text)
        expected = [[1000, 0, 960], [0, 1001, 540], [0, 0, 1]]
        assert read_intrinsics(path, 2).tolist() == [expected, expected]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cameras_survive_the_round_trip_in_any_world(tmp_path: Path, seed: int) -> None:
    cameras = ring(world=turned(seed))
    folder = write_animal(tmp_path / "cat", cameras)
    _, truth = Artemis(folder).load("cat/walk", SWEEP)
    seen = {frame.view: frame.camera for frame in truth.held_out}
    assert sorted(seen) == list(range(VIEWS))
    for view, camera in seen.items():
        torch.testing.assert_close(camera.world_to_camera, cameras[view].world_to_camera, atol=1e-6, rtol=0)
        torch.testing.assert_close(camera.intrinsics, cameras[view].intrinsics, atol=1e-6, rtol=0)


def test_images_are_premultiplied_and_held_out_is_the_rest(animal: Path) -> None:
    clip, truth = Artemis(animal).load("cat/walk", SWEEP)
    assert [frame.view for frame in clip.frames] == [0, 1, 2]
    assert [frame.time for frame in clip.frames] == [0, 1 / 30, 2 / 30]
    assert len(truth.held_out) == FRAMES * (VIEWS - 1)
    pairs = {(round(frame.time * 30), frame.view) for frame in truth.held_out}
    assert pairs == {(t, v) for t in range(FRAMES) for v in range(VIEWS) if v != t}
    rgb, alpha = dot_image(ring()[1])
    frame = clip.frames[1]
    expected = torch.from_numpy(rgb).permute(2, 0, 1) / 255 * (torch.from_numpy(alpha) / 255)
    torch.testing.assert_close(frame.rgb, expected, atol=0.5 / 255 + 1e-6, rtol=0)
    torch.testing.assert_close(frame.mask[0], torch.from_numpy(alpha) / 255)
    assert clip.species == "cat" and clip.licence == "no licence file with the data; do not redistribute"


@pytest.mark.parametrize(
    ("framing", "size"),
    [("full", 32), ("full", 100), ("letterbox", 32), ("letterbox", 128), ("crop", 24), ("crop", 64)],
)
def test_a_point_keeps_its_pixel_through_every_framing(animal: Path, framing: str, size: int) -> None:
    clip, truth = Artemis(animal).load("cat/walk", Selection("sweep", size, framing))
    for frame in (*clip.frames, *truth.held_out):
        camera = frame.camera
        assert max(camera.width, camera.height) == size
        assert frame.rgb.shape == (3, camera.height, camera.width)
        if framing != "full":
            assert camera.width == camera.height
        pixel, _ = camera.project(DOT)
        magnified = camera.intrinsics[0, 0].item() / 60
        assert np.abs(centroid(frame) - pixel.numpy()).max() < 0.05 * max(magnified, 1)


def test_crop_holds_the_animal_with_padding(animal: Path) -> None:
    clip, _ = Artemis(animal).load("cat/walk", Selection("sweep", 46, "crop"))
    for frame in clip.frames:
        mask = frame.mask[0]
        rows, columns = torch.nonzero(mask.amax(1) > 0.5), torch.nonzero(mask.amax(0) > 0.5)
        longest = max(torch.max(axis) - torch.min(axis) + 1 for axis in (rows, columns)).item()
        # The disc fills 9 of the 11 pixels of its window: 0.075 * 9 rounds up to one on each side.
        assert abs(longest - 46 * 8 / 11) <= 46 / 11
        assert max(edge.max() for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1])) < 0.1


def test_averaging_weighs_colour_by_the_matte(tmp_path: Path) -> None:
    """Two neighbours, white at alpha 1/5 and black at 4/5: colour 0.1, alpha 0.5, whatever the background is."""
    folder = write_animal(tmp_path / "cat")
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[:, ::2] = 255
    alpha = np.full((HEIGHT, WIDTH), 204, np.uint8)
    alpha[:, ::2] = 51
    cv2.imwrite(str(folder / "img/walk/0/img_0000.png"), rgb)
    cv2.imwrite(str(folder / "img/walk/0/img_0000_alpha.png"), alpha)
    clip, _ = Artemis(folder).load("cat/walk", Selection("sweep", WIDTH // 2))
    frame = clip.frames[0]
    assert frame.mask.unique().tolist() == pytest.approx([0.5], abs=1 / 255)
    assert frame.rgb.unique().tolist() == pytest.approx([0.1], abs=1 / 255)


def test_selections() -> None:
    assert selected_views(5, 3, Selection("sweep", 8)) == [0, 1, 2, 0, 1]
    assert selected_views(4, 5, Selection("sweep", 8, step=3)) == [0, 3, 1, 4]
    assert selected_views(3, 5, Selection("fixed", 8), fixed_view=2) == [2, 2, 2]
    drawn = selected_views(50, 5, Selection("random", 8, seed=3))
    assert drawn == selected_views(50, 5, Selection("random", 8, seed=3))
    assert drawn != selected_views(50, 5, Selection("random", 8, seed=4)) and set(drawn) == set(range(5))


def test_stride_keeps_real_time(animal: Path) -> None:
    clip, truth = Artemis(animal).load("cat/walk", Selection("sweep", 32, stride=2))
    assert clip.times == pytest.approx((0, 2 / 30)) and clip.fps == 15
    assert [frame.view for frame in clip.frames] == [0, 1]
    still, moved = truth.surface(0.0), truth.surface(2 / 30)
    torch.testing.assert_close(moved - still, torch.tensor((0.0, 0.25 * 0.2, 0.0)).double().expand_as(still))


def test_surface_is_the_shell_and_follows_the_bones(animal: Path) -> None:
    _, truth = Artemis(animal).load("cat/walk", SWEEP)
    still = truth.surface(0.0)
    assert len(still) == 3 * 3 * 7 - 1 * 1 * 5
    assert still.abs().amax(0).tolist() == pytest.approx([0.1, 0.2, 0.9])
    # A quarter of the weight is on the bone that rises by 0.1 a frame.
    torch.testing.assert_close(truth.surface(1 / 30) - still, torch.tensor((0.0, 0.025, 0.0)).double().expand_as(still))
    with pytest.raises(ValueError, match="known at 3 frames"):
        truth.surface(0.5 / 30)


def test_the_surface_can_be_sampled_again(animal: Path) -> None:
    """The bars of the lattice: 3 x 3 x 7 cells with a hollow of 5, each point anywhere in the cell of a shell voxel."""
    _, truth = Artemis(animal).load("cat/walk", SWEEP)
    voxels = truth.surface(0.0)
    pitch = torch.tensor([0.2 / 2, 0.4 / 2, 1.8 / 6]).double()
    points = truth.sample(0.0, 20 * len(voxels) + 7, 0)
    offset = (points[:, None] - voxels).abs() / pitch
    owner = offset.amax(2).argmin(1)
    assert float(offset.amax(2).amin(1).max()) <= 0.5 + 1e-9
    assert set(owner.bincount(minlength=len(voxels)).tolist()) == {20, 21}
    torch.testing.assert_close(
        truth.sample(1 / 30, len(points), 0) - points, torch.tensor((0.0, 0.025, 0.0)).double().expand_as(points)
    )
    assert torch.equal(points, truth.sample(0.0, len(points), 0))
    assert not torch.equal(points, truth.sample(0.0, len(points), 1))
    assert len(truth.sample(0.0, 5, 0)) == 5


def test_the_rest_pose_and_the_world_are_told(animal: Path) -> None:
    _, truth = Artemis(animal).load("cat/walk", SWEEP)
    assert truth.diagonal == pytest.approx((0.2**2 + 0.4**2 + 1.8**2) ** 0.5)
    torch.testing.assert_close(truth.up, torch.tensor((0.0, 1.0, 0.0)).double())


def test_lattice_of_stored_float32_with_a_hole() -> None:
    points = block((40, 50, 60), (0.0117, 0.0071, 0.0093)).astype(np.float32).astype(np.float64) + 1.3
    cells, error = lattice(points)
    assert error < 0.01 and cells.max(0).tolist() == [39, 49, 59]
    hole = (cells == (20, 25, 30)).all(1)
    kept = cells[~hole]
    shell = 40 * 50 * 60 - 38 * 48 * 58
    assert is_surface(cells).sum() == shell
    assert is_surface(kept).sum() == shell + 6


@pytest.mark.parametrize("elevation", [0.0, 0.5, 2.5])
def test_up_needs_no_axis(elevation: float) -> None:
    for seed in range(3):
        world = turned(seed)
        poses = np.stack([torch.linalg.inv(c.world_to_camera).numpy() for c in ring(7, world, elevation)[:4]])
        assert up_direction(poses) == pytest.approx(world @ (0.0, 1.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_placements_in_any_world(tmp_path: Path, seed: int) -> None:
    """The block is long along z; camera k of 8 stands at k * 45 degrees from +z."""
    world = turned(seed)
    cameras = ring(8, world)
    poses = np.stack([torch.linalg.inv(camera.world_to_camera).numpy() for camera in cameras])
    points = block() @ world.T
    assert placed_view("frontal", points, poses) == 0
    assert placed_view("oblique", points, poses) == 1
    assert placed_view("side", points, poses) == 2


def test_placements_are_cases_of_their_own(animal: Path) -> None:
    fixed = Selection("fixed", 32, placements=("side", "frontal"))
    reader = Artemis(animal)
    assert reader.cases(fixed) == ["cat/walk@side", "cat/walk@frontal"]
    views = [{frame.view for frame in reader.load(case, fixed)[0].frames} for case in reader.cases(fixed)]
    assert views == [{1}, {0}]
    assert reader.cases(Selection("fixed", 32)) == ["cat/walk"]


def test_frame_folders_sort_by_number(tmp_path: Path) -> None:
    folder = tmp_path / "cat" / "img" / "walk"
    for number in range(12):
        (folder / str(number)).mkdir(parents=True)
    assert list_motions(tmp_path / "cat") == {"walk": 12}
    (tmp_path / "cat" / "sequences").write_text("walk 12\n")
    assert list_motions(tmp_path / "cat") == {"walk": 12}


def test_both_spellings_of_the_parents(animal: Path) -> None:
    (animal / "bones" / "bone_parents.npy").rename(animal / "bones" / "bones_parents.npy")
    assert read_parents(animal / "bones").tolist() == [-1, 0]
    assert Artemis(animal).load("cat/walk", SWEEP)[1].surface is not None


def test_jpeg_and_matte_of_another_mode(animal: Path) -> None:
    before, _ = Artemis(animal).load("cat/walk", SWEEP)
    for path in sorted(animal.glob("img/walk/*/img_????.png")):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)), (cv2.IMWRITE_JPEG_QUALITY, 98))
        path.unlink()
    for path in animal.glob("img/walk/*/*_alpha.png"):
        cv2.imwrite(str(path), cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), cv2.COLOR_GRAY2BGRA))
    after, _ = Artemis(animal).load("cat/walk", SWEEP)
    torch.testing.assert_close(after.frames[0].mask, before.frames[0].mask)
    assert (after.frames[0].rgb - before.frames[0].rgb).abs().mean() < 0.01
    assert after.digest != before.digest


def test_a_jpeg_is_whole_where_its_pixels_end(tmp_path: Path) -> None:
    """A phone's trailer hides the end, and that of a thumbnail stands before it."""
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    whole, small = (cv2.imencode(".jpg", image)[1].tobytes() for image in (noise, noise[:16, :16]))
    thumbed = whole[:2] + b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small + whole[2:]
    file = tmp_path / "image.jpg"
    for data in (whole, whole + bytes(5000), thumbed):
        file.write_bytes(data)
        assert (read_rgb(file) == cv2.imdecode(np.frombuffer(whole, np.uint8), 1)[..., ::-1]).all()
    for data in (whole[:-200], thumbed[:-200]):
        file.write_bytes(data)
        with pytest.raises(UserError, match="image.jpg: expected a whole image, got a JPEG that is cut off after"):
            read_rgb(file)


def test_digests_depend_on_content_and_not_on_the_place(animal: Path, tmp_path: Path) -> None:
    clip, truth = Artemis(animal).load("cat/walk", SWEEP)
    shutil.copytree(animal, tmp_path / "elsewhere" / "cat")
    again, truth_again = Artemis(tmp_path / "elsewhere").load("cat/walk", SWEEP)
    assert (clip.digest, truth.digest) == (again.digest, truth_again.digest)
    other = Artemis(animal).load("cat/walk", Selection("sweep", WIDTH, step=2))[0]
    assert other.digest != clip.digest


def test_cache_is_used_and_follows_changed_files(animal: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = Artemis(animal).load("cat/walk", SWEEP)
    with monkeypatch.context() as context:
        context.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded again"))
        assert Artemis(animal).load("cat/walk", SWEEP)[0].digest == first.digest
    path = animal / "img/walk/0/img_0000.png"
    cv2.imwrite(str(path), 255 - cv2.imread(str(path)))
    os.utime(path, ns=(1, 1))
    assert Artemis(animal).load("cat/walk", SWEEP)[0].digest != first.digest


def test_a_folder_of_animals(tmp_path: Path) -> None:
    write_animal(tmp_path / "zoo" / "cat", motions=("run", "s1_24fps"))
    write_animal(tmp_path / "zoo" / "wolf")
    (tmp_path / "zoo" / "wolf" / "licence.txt").write_text("\nCC0 1.0\nmore\n")
    (tmp_path / "zoo" / "notes").mkdir()
    reader = Artemis(tmp_path / "zoo")
    assert reader.cases(SWEEP) == ["cat/run", "cat/s1_24fps", "wolf/walk"]
    assert reader.load("wolf/walk", SWEEP)[0].licence == "CC0 1.0"
    assert reader.load("cat/s1_24fps", SWEEP)[0].fps == 24
    assert frames_per_second("walk") == 30


def test_without_volumes_there_is_no_surface(animal: Path) -> None:
    shutil.rmtree(animal / "volumes")
    shutil.rmtree(animal / "bones")
    (animal / "sequences").unlink()
    _, truth = Artemis(animal).load("cat/walk", SWEEP)
    assert truth.surface is None
    assert truth.up is not None and torch.equal(
        truth.up, torch.from_numpy(up_direction(read_cameras(animal / "CamPose.inf")))
    )


def test_check_of_a_sound_folder(animal: Path) -> None:
    findings = Artemis(animal).check()
    assert [finding.level for finding in findings] == ["warning", "warning", "ok"]
    assert "voxels fall on the mattes" in findings[0].message, "the disc is a stand-in for the block"
    assert findings[1].message == NO_LICENCE
    assert findings[-1].message == "1 motions, 4 views, 2 bones"
    assert read_cameras(animal / "CamPose.inf").shape == (4, 4, 4)
