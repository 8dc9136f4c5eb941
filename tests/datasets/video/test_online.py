"""A person's own video, well formed and not: every fault is one sentence or a stated fallback."""

import re
from pathlib import Path

import moving
import numpy as np
import pytest
from films import SELECTION, iou, restored
from PIL import Image

from rewild4d import cli
from rewild4d.datasets.video import video_file
from rewild4d.datasets.video.davis import Davis
from rewild4d.datasets.video.online import Online
from rewild4d.datasets.video.video_file import ascending, video_facts
from rewild4d.errors import UserError

pytestmark = pytest.mark.usefixtures("cache")

H264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-qp", "12")


def load(root: Path, **options):  # type: ignore[no-untyped-def]
    reader = Online(root, **options)
    (case,) = reader.cases(SELECTION)
    return reader.load(case, SELECTION)


def whole(clip, truth):  # type: ignore[no-untyped-def]
    return sorted((*clip.frames, *truth.held_out), key=lambda frame: frame.time)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """clip/frames and clip/masks: twelve frames."""
    moving.frames(tmp_path / "clip" / "frames")
    moving.masks(tmp_path / "clip" / "masks")
    return tmp_path / "clip"


def test_a_folder_with_masks_beside(walk: Path) -> None:
    clip, truth = load(walk)
    assert (clip.name, len(clip.frames), len(truth.held_out), clip.fps) == ("clip", 10, 2, pytest.approx(25))
    assert "25 a second assumed" in clip.notes[0]
    assert load(walk, fps=12.5)[0].fps == pytest.approx(12.5)


def test_a_video_with_a_folder_of_masks(walk: Path, tmp_path: Path) -> None:
    film = moving.film(tmp_path / "walk.mp4", walk / "frames", *H264)
    clip, truth = load(film, masks=walk / "masks")
    frames = whole(clip, truth)
    assert [round(frame.time * 10, 4) for frame in frames] == list(range(12))
    assert iou(restored(frames[5], moving.SIZE), moving.mask(5) > 0) > 0.93
    inside = frames[5].mask[0] > 0.99
    assert frames[5].rgb[0][inside].median() > 0.6 and frames[5].rgb[1][inside].median() < 0.3


def test_a_part_of_a_video_at_another_rate(walk: Path, tmp_path: Path) -> None:
    film = moving.film(tmp_path / "walk.mp4", walk / "frames", *H264)
    reader = Online(film, masks=walk / "masks", start=0.15, end=1.05, fps=5)
    video = reader.video("walk")
    assert [moment.label for moment in video.moments] == ["frame 2", "frame 4", "frame 6", "frame 8", "frame 10"]
    found = [mask for mask in video.masks() if mask is not None]
    assert all((mask == moving.mask(i)).all() for i, mask in zip((2, 4, 6, 8, 10), found, strict=True))
    pictures = list(video.images())
    assert len(pictures) == 5 and np.abs(pictures[1].astype(int) - moving.image(4)).mean() < 4
    clip, _ = reader.load("walk", SELECTION)
    assert clip.times[0] == 0 and clip.fps == pytest.approx(5)


def test_masks_of_the_chosen_frames_with_numbers_of_their_own(walk: Path, tmp_path: Path) -> None:
    """Eight masks from 0 on for the frames 4 to 11 are not those of 0 to 7, of which four have such a name."""
    for i in range(8):
        moving.save(tmp_path / "masks" / f"{i:05d}.png", moving.mask(i + 4))
    video = Online(walk / "frames", masks=tmp_path / "masks", start=4 / 25).video("frames")
    assert [moment.label for moment in video.moments] == [f"{i:05d}.png" for i in range(4, 12)]
    assert all((mask == moving.mask(i + 4)).all() for i, mask in enumerate(video.masks()))
    assert "one mask for each of the 8 chosen frames: matched in order, 00000.png first" in video.notes


def test_a_video_of_masks(walk: Path, tmp_path: Path) -> None:
    film = moving.film(tmp_path / "walk.mp4", walk / "frames", *H264)
    matte = moving.film(tmp_path / "matte.mp4", walk / "masks", *H264)
    clip, truth = load(film, masks=matte)
    assert iou(restored(whole(clip, truth)[5], moving.SIZE), moving.mask(5) > 0) > 0.9
    for i in range(12):
        moving.save(tmp_path / "red" / f"{i:05d}.png", moving.mask(i)[..., None] // 255 * np.uint8((128, 0, 0)))
    clip, truth = load(film, masks=moving.film(tmp_path / "red.mp4", tmp_path / "red", *H264))
    assert iou(restored(whole(clip, truth)[5], moving.SIZE), moving.mask(5) > 0) > 0.8, "a dark colour is an animal too"
    short = moving.film(tmp_path / "short.mp4", walk / "masks", *H264, "-frames:v", 5)
    with pytest.raises(UserError, match="expected a mask for each of the 12 frames of walk.mp4, got 5"):
        load(film, masks=short)


@pytest.mark.parametrize("codec", [("-c:v", "qtrle"), ("-c:v", "libvpx-vp9", "-lossless", "1")])
def test_alpha_is_a_mask(codec: tuple[str, ...], tmp_path: Path) -> None:
    for i in range(12):
        moving.save(tmp_path / "rgba" / f"{i:05d}.png", np.dstack((moving.image(i), moving.mask(i))))
    clip, truth = load(tmp_path / "rgba")
    assert iou(restored(whole(clip, truth)[5], moving.SIZE), moving.mask(5) > 0) > 0.93
    suffix = "mov" if codec[1] == "qtrle" else "webm"
    kind = "argb" if suffix == "mov" else "yuva420p"
    film = moving.film(tmp_path / f"a.{suffix}", tmp_path / "rgba", *codec, "-pix_fmt", kind)
    clip, truth = load(film)
    assert "masks are the frames' alpha channel" in clip.notes
    assert iou(restored(whole(clip, truth)[5], moving.SIZE), moving.mask(5) > 0) > 0.93


def test_a_turned_video_and_turned_photos(tmp_path: Path) -> None:
    """Phones store a vertical film lying on its side."""
    upright = (64, 96)
    moving.masks(tmp_path / "masks", size=upright)
    for i in range(12):
        lying = np.rot90(moving.image(i, upright)).copy()
        exif = Image.Exif()
        exif[0x0112] = 6  # rotate by 90 degrees clockwise to see it upright
        moving.save(tmp_path / "lying" / f"{i:05d}.png", lying)
        (tmp_path / "photos").mkdir(exist_ok=True)
        Image.fromarray(lying).save(tmp_path / "photos" / f"{i:05d}.jpg", exif=exif, quality=95)
    stored = moving.film(tmp_path / "stored.mp4", tmp_path / "lying", *H264)
    moving.ffmpeg("-display_rotation", "-90", "-i", stored, "-c", "copy", tmp_path / "turned.mp4")
    for source in ("photos", "turned.mp4"):
        reader = Online(tmp_path / source, masks=tmp_path / "masks")
        (case,) = reader.cases(SELECTION)
        video = reader.video(case)
        assert video.size == upright
        picture = list(video.images())[3]
        assert np.abs(picture.astype(int) - moving.image(3, upright)).mean() < 6, source
        frame = whole(*reader.load(case, SELECTION))[3]
        assert iou(restored(frame, upright), moving.mask(3, upright) > 0) > 0.93


def test_a_variable_frame_rate_keeps_its_times(walk: Path, tmp_path: Path) -> None:
    lines = [f"file '{walk}/frames/{i:05d}.png'\nduration {0.84 if i == 5 else 0.12}\n" for i in range(12)]
    (tmp_path / "list.txt").write_text("".join(lines))
    film = tmp_path / "v.mkv"
    moving.ffmpeg("-f", "concat", "-safe", 0, "-i", tmp_path / "list.txt", "-fps_mode", "vfr", *H264, film)
    assert video_facts(film).times == pytest.approx([0.12 * i for i in (*range(6), *range(12, 18))], abs=2e-3)
    clip, _ = load(film, masks=walk / "masks")
    assert clip.fps == pytest.approx(11 / (17 * 0.12), rel=1e-2)
    even = Online(film, masks=walk / "masks", fps=5).video("v")
    assert [moment.label for moment in even.moments][:3] == ["frame 0", "frame 2", "frame 3"]


def test_a_large_and_a_vertical_video(tmp_path: Path) -> None:
    size = (3840, 2160)
    moving.frames(tmp_path / "c" / "frames", 4, size, "jpg")
    moving.masks(tmp_path / "c" / "masks", 4, size)
    clip, truth = load(tmp_path / "c")
    frame = whole(clip, truth)[2]
    assert frame.crop is not None and (frame.crop.width, frame.crop.height) == size
    assert abs(float(frame.mask.mean()) - (moving.mask(2, size) > 0).sum() / frame.crop.side**2) < 0.003


def test_small_masks_are_enlarged(walk: Path, tmp_path: Path) -> None:
    for i in range(12):
        small = Image.fromarray(moving.mask(i)).resize((48, 32))
        moving.save(tmp_path / "small" / f"{i:05d}.png", np.asarray(small))
    clip, truth = load(walk / "frames", masks=tmp_path / "small")
    assert iou(restored(whole(clip, truth)[5], moving.SIZE), moving.mask(5) > 0) > 0.85


def test_masks_for_half_of_the_frames(walk: Path) -> None:
    for i in range(0, 12, 2):
        (walk / "masks" / f"{i:05d}.png").unlink()
    clip, truth = load(walk)
    assert len(whole(clip, truth)) == 6
    assert clip.notes[1].startswith("6 of 12 frames without a mask left out: 00000.png, 00002.png")


def test_frames_are_ordered_by_their_numbers(tmp_path: Path) -> None:
    for i in range(12):
        moving.save(tmp_path / "c" / "frames" / f"shot {i}.png", moving.image(i))
        moving.save(tmp_path / "c" / "masks" / f"shot {i}.png", moving.mask(i))
    labels = [moment.label for moment in Online(tmp_path / "c").video("c").moments]
    assert labels == [f"shot {i}.png" for i in range(12)]


def test_two_animals_by_id_are_two_cases(walk: Path) -> None:
    for i in range(12):
        both = moving.mask(i, left=20) // 255 + 2 * (moving.mask(i, left=60) // 255)
        moving.save(walk / "masks" / f"{i:05d}.png", both.astype(np.uint8), "P")
    reader = Online(walk)
    assert reader.cases(SELECTION) == ["clip", "clip@1", "clip@2"]
    assert reader.default_cases(SELECTION) == ["clip@1", "clip@2"]
    both = next(iter(reader.video("clip").masks()))
    assert both is not None and ((both > 0) == ((moving.mask(0, left=20) | moving.mask(0, left=60)) > 0)).all()
    frame = reader.load("clip@2", SELECTION)[0].frames[0]
    assert iou(restored(frame, moving.SIZE), moving.mask(0, left=60) > 0) > 0.93


def test_two_animals_in_one_mask_are_taken_as_one_and_told(walk: Path) -> None:
    for i in (3, 4):
        moving.save(walk / "masks" / f"{i:05d}.png", moving.mask(i, left=20) | moving.mask(i, left=60))
    clip, truth = load(walk, parts="all")
    assert len(whole(clip, truth)) == 12
    told = "with two parts of like size (two animals?) taken as one animal (--parts main takes one)"
    assert f"2 of 12 frames {told}: 00003.png to 00004.png" in clip.notes


def test_time_stamps_out_of_order_are_replaced_and_told(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ascending(["0.5", "0.6", "0.8"], 3) == pytest.approx((0, 0.1, 0.3))
    assert ascending(["0.5", "0.8", "0.6"], 3) is None and ascending(["0.5", "NOPTS"], 2) is None
    film = moving.film(tmp_path / "walk.mp4", walk / "frames", *H264)
    shuffled = re.compile(r"showinfo.*\bn: *\d+ .*\bpts_time:\S*?(\d)\b")  # tenths alone: 0 to 9, then 0 again
    monkeypatch.setattr(video_file, "_TIME", shuffled)
    clip, truth = load(film, masks=walk / "masks")
    assert [frame.time for frame in whole(clip, truth)] == pytest.approx([i / 25 for i in range(12)])
    assert "time stamps are missing or out of order: 25 frames a second assumed" in clip.notes


def test_check_tells_what_a_person_should_look_at(walk: Path, tmp_path: Path) -> None:
    masks = [moving.mask(i) for i in range(12)]
    masks[2][28:33, 18:26] = 0
    masks[4] |= moving.mask(4, left=70)
    masks[6][:] = 0
    masks[8][50:60, 80:84] = 255
    for i, values in enumerate(masks):
        moving.save(walk / "masks" / f"{i:05d}.png", values)
    findings = Online(walk, parts="all").check(sheets=tmp_path / "sheets")
    said = "\n".join(finding.message for finding in findings)
    assert "holes (or gaps between legs) above 1% of the animal in 1 of 12 frames: 00002.png" in said
    assert "two parts of like size (two animals?) in 1 of 12 frames: 00004.png" in said
    assert "no mask or an empty one in 1 of 12 frames: 00006.png" in said
    assert "a second part beside the animal in 1 of 12 frames: 00008.png" in said
    assert "a jump from the frame before in 3 of 12 frames: 00004.png, 00005.png, 00008.png" in said
    sheet = np.asarray(Image.open(tmp_path / "sheets" / "clip.png"))
    assert sheet.shape[1] == 6 * 240
    clean = Davis(moving.davis(tmp_path / "d")).check()
    assert [finding.level for finding in clean] == ["ok", "ok"]
    assert clean[0].message.startswith("masks: green: ")


@pytest.mark.parametrize(
    ("case", "sentence"),
    [
        ("no masks", "expected masks of the animal, but no frame is transparent anywhere and no --masks was given"),
        ("empty masks", "expected at least 4 frames with a mask of the animal, got 0 of 12 (12 an empty one)"),
        ("one frame", "expected at least 4 frames with a mask of the animal, got 1 of 1"),
        ("other size", "00000.png: expected a mask of 96x64 pixels like its frame (or of that shape), got 64x64"),
        ("other frame", "00003.png: expected 96x64 pixels like 00000.png, got 48x64"),
        ("damaged frame", "00004.png: expected a whole image, got a PNG that is cut off after 60 bytes"),
        ("damaged mask", "00004.png: expected a mask image that can be read, got a damaged or another file"),
        ("no frames", "expected frames (.png, .jpg, .jpeg), got none"),
        ("a picture", "expected a video or a folder of frames, got one image"),
        ("damaged video", "expected a video that ffmpeg can read, got"),
        ("late start", "expected frames between 90 and inf s, but the last is at 0.44 s"),
        ("backwards", "--start and --end: expected 0 <= start < end, got 2 and 1"),
        ("before", "--start and --end: expected 0 <= start < end, got -1 and no end"),
        ("link to nothing", "00004.png: expected an image that can be read, but: No such file or directory"),
        ("link to itself", "00004.png: expected an image that can be read, but: Too many levels of"),
        ("no rate", "--fps: expected a number above 0, up to 1000, got -1"),
        ("missing", "expected a video file or a folder of images, but there is no such thing"),
    ],
)
def test_bad_input_is_one_sentence(
    case: str, sentence: str, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("run", "check"):
        words = spoil(case, walk, tmp_path)
        with pytest.raises(SystemExit) as stop:
            cli.main([command, "--dataset", "online", *map(str, words), *extra(command, tmp_path)])
        out, err = capsys.readouterr()
        assert stop.value.code == 2
        assert sentence in out + err
        assert "Traceback" not in out + err


def extra(command: str, tmp_path: Path) -> list[str]:
    if command == "check":
        return ["--sheets", str(tmp_path / "sheets")]
    return ["--method", "empty", "--jobs", "1", "--out", str(tmp_path / "runs")]


def spoil(case: str, walk: Path, tmp_path: Path) -> list[object]:
    """Break something and give the flags that name it."""
    masks, frames = walk / "masks", walk / "frames"
    match case:
        case "no masks":
            return ["--video", frames]
        case "empty masks":
            for file in masks.iterdir():
                moving.save(file, moving.mask(0) * 0)
        case "one frame":
            for file in (*sorted(masks.iterdir())[1:], *sorted(frames.iterdir())[1:]):
                file.unlink()
        case "other size":
            moving.save(masks / "00000.png", moving.mask(0)[:, :64])
        case "other frame":
            moving.save(frames / "00003.png", moving.image(3)[:, :48])
        case "damaged frame" | "damaged mask":
            folder = frames if case == "damaged frame" else masks
            data = (folder / "00004.png").read_bytes()
            (folder / "00004.png").write_bytes(data[:60])
        case "no frames":
            for file in frames.iterdir():
                file.unlink()
        case "a picture":
            return ["--video", moving.save(tmp_path / "one.png", moving.image(0))]
        case "damaged video":
            film = moving.film(tmp_path / "cut.mp4", frames, *H264)
            film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
            return ["--video", film, "--masks", masks]
        case "late start":
            return ["--video", walk, "--start", 90]
        case "backwards":
            return ["--video", walk, "--start", 2, "--end", 1]
        case "before":
            return ["--video", walk, "--start=-1"]
        case "link to nothing" | "link to itself":
            (frames / "00004.png").unlink()
            (frames / "00004.png").symlink_to(tmp_path / "none" if case == "link to nothing" else "00004.png")
        case "no rate":
            return ["--video", walk, "--fps", -1]
        case "missing":
            return ["--video", tmp_path / "nowhere.mp4"]
    return ["--video", walk]


def test_a_video_that_breaks_off_is_used_as_far_as_it_goes(walk: Path, tmp_path: Path) -> None:
    film = moving.film(tmp_path / "walk.ts", walk / "frames", *H264, "-bf", 0, "-g", 1)
    film.write_bytes(film.read_bytes()[: film.stat().st_size * 6 // 10])
    facts = video_facts(film)
    assert 4 <= len(facts.times) < 12
    clip, _ = load(film, masks=walk / "masks")
    assert len(clip.frames) >= 3


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--dataset", "artemis", "--masks", "x"], "--masks: the data set 'artemis' does not take it"),
        (["--dataset", "davis", "--data", "x", "--fps", "3"], "--fps: the data set 'davis' does not take it"),
        (["--dataset", "davis", "--video", "x.mp4"], "--video: expected --dataset online with it, got davis"),
        (["--dataset", "online", "--video", "x", "--data", "y"], "--video: expected either this or --data, got both"),
        (["--dataset", "online"], "--video: the data set 'online' has no built-in data; name its file or folder"),
        (["--dataset", "davis", "--data", "/nowhere"], "expected frames in one of 480p, 1080p, Full-Resolution"),
    ],
)
def test_flags_that_do_not_fit(words: list[str], sentence: str, tmp_path: Path,
                               capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    with pytest.raises(SystemExit) as stop:
        cli.main(["run", *words, "--out", str(tmp_path)])
    assert stop.value.code == 2
    assert sentence in capsys.readouterr().err
