"""`score`: folders as people have them. Known errors by arithmetic, every image format, clips, clouds."""

import json
import math
from pathlib import Path

import cv2
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from pictures import GREY, Call, clips, flat, noise, refused, with_alpha, write

from rewild4d import cli
from rewild4d.evaluation.networks import FAMILIES, Networks, load_networks
from rewild4d.metrics.image import PSNR_CAP

FETCH = "weights missing, run: rewild4d-bench weights fetch"


def test_a_known_error(score: Call, tmp_path: Path) -> None:
    for name, value in (("a", 151), ("b", 106)):
        write(tmp_path / "p" / f"{name}.png", flat(value, value, value))
        write(tmp_path / "t" / f"{name}.png", flat(100, 100, 100))
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t")
    errors = [(151 - 100) / 255, (106 - 100) / 255]
    items = [-20 * math.log10(error) for error in errors]
    assert found["scores"]["psnr"]["per_item"] == pytest.approx(items)
    assert found["scores"]["psnr"]["value"] == pytest.approx(sum(items) / 2)
    assert found["scores"]["lpips_alex"]["value"] == pytest.approx((errors[0] ** 2 + errors[1] ** 2) / 2)
    assert found["items"] == [str(tmp_path / "t" / "a.png"), str(tmp_path / "t" / "b.png")]
    assert found["scores"]["psnr_fg"]["note"] == "not computed: no true masks: name them with --masks"
    assert found["scores"]["iou"]["value"] is None
    assert [(d["name"], d["n"], d["m"]) for d in found["distances"]] == [
        ("KID [linear]", 2, 2),
        ("KID-u [linear]", 2, 2),
    ]
    assert found["networks"] == {"lpips_alex": "1" * 64, "lpips_vgg": "1" * 64, "linear": "0" * 64}
    assert found["machine"]["torch"] == torch.__version__


PALETTE = np.where(noise(1)[..., :1] < 128, 40, 200).astype(np.uint8)


@pytest.mark.parametrize(
    ("suffix", "truth", "prediction"),
    [
        (".png", noise(2), noise(2).astype(np.uint16) * 257),  # 16 bits a channel
        (".png", GREY.repeat(3, 2), GREY[..., 0]),
        (".png", GREY.repeat(3, 2), GREY[..., 0].astype(np.uint16) * 257),
        (".png", noise(3), with_alpha(noise(3), slice(None), slice(None))),
        (".npy", noise(4), noise(4)[..., ::-1]),
        (".npy", noise(4), noise(4)[..., ::-1].astype(np.float64) / 255),
        (".npy", GREY.repeat(3, 2), GREY[..., 0].astype(np.float32) / 255),
        (".npy", noise(3), with_alpha(noise(3)[..., ::-1], slice(None), slice(None))),
        (".jpg", flat(120, 120, 120), flat(120, 120, 120)),
    ],
)
def test_every_format_holds_the_same_picture(
    score: Call, tmp_path: Path, suffix: str, truth: np.ndarray, prediction: np.ndarray
) -> None:
    write(tmp_path / "t" / "a.png", truth)
    write(tmp_path / "p" / f"a{suffix}", prediction)
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    assert found["scores"]["psnr"]["value"] == PSNR_CAP
    assert found["scores"]["psnr"]["note"] == "1 identical images counted as 100 dB"


def test_a_palette_is_looked_up(score: Call, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    colors = image.fromarray(noise(5)).quantize(16)
    write(tmp_path / "t" / "a.png", np.asarray(colors.convert("RGB"))[..., ::-1])
    (tmp_path / "p").mkdir()
    colors.save(tmp_path / "p" / "a.png")
    assert cv2.imread(str(tmp_path / "p" / "a.png"), cv2.IMREAD_UNCHANGED).shape[2] == 3
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    assert found["scores"]["psnr"]["value"] == PSNR_CAP


def test_alpha_is_straight_and_lies_on_the_background(score: Call, tmp_path: Path) -> None:
    """Half-transparent 200 on grey 0.2 = 51 is 125.5; a truth of 125 is half a step away."""
    write(tmp_path / "p" / "a.png", np.concatenate((flat(200, 200, 200), flat(128)), axis=2))
    write(tmp_path / "t" / "a.png", flat(125, 125, 125))
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--background", 0.2, "--only", "psnr", "kid")
    error = 200 / 255 * 128 / 255 + 0.2 * (1 - 128 / 255) - 125 / 255
    assert found["scores"]["psnr"]["value"] == pytest.approx(-20 * math.log10(error), abs=1e-3)
    assert found["settings"]["background"] == found["distances"][0]["background"] == "0.2 behind alpha"
    assert (
        "the predictions have alpha, the truths have none: see that they lie on the same background" in found["notes"]
    )


def test_masks_from_a_folder_and_from_alpha(score: Call, tmp_path: Path) -> None:
    truth, prediction = flat(0, 0, 0), flat(0, 0, 0)
    prediction[10:20, 30:40] = 51  # an error of 0.2 on 100 pixels, all outside the true mask
    write(tmp_path / "t" / "a.png", truth)
    write(tmp_path / "p" / "a.png", with_alpha(prediction, slice(10, 20), slice(20, 40)))
    write(tmp_path / "m" / "a.png", with_alpha(truth, slice(10, 20), slice(10, 30))[..., 3])
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--masks", tmp_path / "m", "--background", 0)
    scores = {name: score["value"] for name, score in found["scores"].items()}
    assert scores["psnr_fg"] == PSNR_CAP
    assert scores["psnr"] == pytest.approx(-20 * math.log10(0.2) - 10 * math.log10(100 / (40 * 48)), abs=1e-4)
    assert scores["psnr_union"] == pytest.approx(-20 * math.log10(0.2) - 10 * math.log10(100 / 300), abs=1e-4)
    assert scores["lpips_alex_fg"] == 0.0
    assert scores["lpips_alex_union"] == scores["lpips_alex"] == pytest.approx(0.2**2 * 100 / (40 * 48))
    assert scores["ssim_fg"] > scores["ssim_union"]
    assert scores["iou"] == 100 / 300 and scores["dice"] == 2 * 100 / (200 + 200)
    # the truth's box is 20 wide and 10 high, with a margin of 2, grown to 32 x 32: rows 0 to 31, columns 4 to 36
    assert scores["psnr_crop"] == pytest.approx(-20 * math.log10(0.2) - 10 * math.log10(60 / (32 * 32)), abs=1e-4)


def test_the_union_of_two_images_with_alpha_is_not_computed_again(
    score: Call, networks: Networks, tmp_path: Path
) -> None:
    for side, columns in (("p", slice(5, 30)), ("t", slice(10, 35))):
        write(tmp_path / side / "a.png", with_alpha(noise(6), slice(10, 30), columns))
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t")
    assert networks.lpips["lpips_vgg"].calls == 3  # type: ignore[attr-defined]
    assert found["scores"]["lpips_vgg_union"]["value"] == found["scores"]["lpips_vgg"]["value"]


def test_empty_masks_are_left_out_and_said(score: Call, tmp_path: Path) -> None:
    for name, rows in (("a", slice(0, 0)), ("b", slice(10, 30))):
        write(tmp_path / "p" / f"{name}.png", noise(1))
        write(tmp_path / "t" / f"{name}.png", noise(2))
        write(tmp_path / "m" / f"{name}.png", with_alpha(noise(1), rows, slice(10, 30))[..., 3])
    folders = ["--pred", tmp_path / "p", "--truth", tmp_path / "t", "--masks", tmp_path / "m"]
    for name in ("psnr_fg", "ssim_fg", "lpips_vgg_fg", "psnr_crop"):
        found = score(*folders)["scores"][name]
        assert found["per_item"][0] is None and found["count"] == 1
        assert found["note"] == "1 images left out: not defined there"
    write(tmp_path / "m" / "b.png", flat(0)[..., 0])
    assert score(*folders)["scores"]["psnr_fg"]["note"] == "not computed: no image in which it is defined"
    write(tmp_path / "p" / "a.png", flat(9, 9, 9, size=(8, 8)))
    write(tmp_path / "t" / "a.png", flat(9, 9, 9, size=(8, 8)))
    small = score("--pred", tmp_path / "p", "--truth", tmp_path / "t")["scores"]["ssim"]
    assert small["per_item"][0] is None and small["count"] == 1, "8 pixels are less than the window"


def test_names_in_natural_order_where_that_is_asked_for(
    score: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in (2, 10, 1):
        write(tmp_path / "p" / f"out_{number}.png", flat(number, number, number))
        write(tmp_path / "t" / f"frame{number:03d}.png", flat(number, number, number))
    folders = ("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "psnr")
    names = f"the 3 names of {tmp_path / 't'}"
    assert refused(capsys, *folders) == (
        f"rewild4d-bench: {tmp_path / 'p'}: expected {names}, but they share none; --pair order "
        "matches them in sorted order, out_1 with frame001 first."
    )
    found = score(*folders, "--pair", "order")
    assert found["scores"]["psnr"]["value"] == PSNR_CAP
    assert "share no name: matched in sorted order, out_1 with frame001 first" in found["notes"][0]


def test_clips_in_folders(score: Call, tmp_path: Path) -> None:
    clips(tmp_path / "p", "abc", 12, 0), clips(tmp_path / "t", "abc", 12, 1)
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--fps", 12)
    distances = {d["name"].removesuffix(" [linear-video]"): d for d in found["distances"]}
    assert found["kind"] == "clips" and len(found["items"]) == 36
    for name in ("FVD", "KVD", "KVD-u", "I3D-dist (paired, N=1)"):
        assert distances[name]["value"] is not None
        assert [distances[name][key] for key in ("n", "m", "frames", "fps")] == [3, 3, 12, 12.0]
    assert distances["KID [linear]"]["n"] == 36 and distances["KID [linear]"]["sequences"] == 3
    assert "KID-u" in distances["KID [linear]"]["note"]
    same = score("--pred", tmp_path / "p", "--truth", tmp_path / "p", "--only", "fvd", "kid")
    assert {d["name"]: d["value"] for d in same["distances"]}["KVD-u [linear-video]"] == 0.0
    assert same["scores"] == {}


def test_clips_that_are_too_short_or_unequal_keep_their_image_scores(score: Call, tmp_path: Path) -> None:
    for side in ("p", "t"):
        clips(tmp_path / side, "ab", 8, 0)
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t")
    notes = {d["name"]: d["note"] for d in found["distances"]}
    assert notes["FVD [linear-video]"] == "not computed: clips of 8 frames, and linear-video needs 9"
    assert found["scores"]["psnr"]["value"] == PSNR_CAP
    for side in ("p", "t"):
        write(tmp_path / side / "b" / "8.png", noise(1, (16, 16)))
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t", "--only", "fvd")
    assert "clips of 8, 9 frames, and only equal lengths compare" in found["distances"][0]["note"]


def test_videos(score: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for side, shade in (("p", 151), ("t", 100)):
        (tmp_path / side).mkdir()
        frames = [flat(shade, shade, shade, size=(32, 32))] * 10
        imageio.mimwrite(tmp_path / side / "walk.mp4", frames, fps=24, macro_block_size=2, ffmpeg_log_level="error")
    found = score("--pred", tmp_path / "p", "--truth", tmp_path / "t" / "walk.mp4")
    assert found["scores"]["psnr"]["value"] == pytest.approx(-20 * math.log10((151 - 100) / 255), abs=0.2)
    assert found["settings"]["fps"] == "24"
    assert found["items"][3] == f"{tmp_path}/t/walk.mp4, frame 3"
    assert {d["note"] for d in found["distances"] if d["name"].startswith("FVD")} == {
        "not computed: at least 2 samples a side are needed, got 1 and 1"
    }
    whole = (tmp_path / "p" / "walk.mp4").read_bytes()
    (tmp_path / "p" / "walk.mp4").write_bytes(whole[: len(whole) // 2])
    said = refused(capsys, "--pred", tmp_path / "p", "--truth", tmp_path / "t")
    assert f"{tmp_path}/p/walk.mp4: expected a video that ffmpeg can read" in said


def test_unpaired_sets_of_any_size(score: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for side, count in (("p", 5), ("t", 3)):
        for i in range(count):
            write(tmp_path / side / f"{side}{i}.png", noise(i))
    folders = ["--pred", tmp_path / "p", "--truth", tmp_path / "t"]
    found = score(*folders, "--unpaired")
    assert [(d["name"], d["n"], d["m"]) for d in found["distances"]] == [("KID [linear]", 5, 3)]
    assert found["scores"] == {}
    assert "expected no masks" in refused(capsys, *folders, "--unpaired", "--masks", tmp_path / "t")


def test_missing_weights_leave_the_other_scores(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    none = Networks(missing=dict.fromkeys(("lpips-alex", "lpips-vgg", "kid", "fvd"), FETCH))
    monkeypatch.setattr("rewild4d.evaluation.networks.load_networks", lambda families, device: none)
    clips(tmp_path / "p", "ab", 9, 0)
    with pytest.raises(SystemExit) as stop:
        cli.main(["score", "--pred", str(tmp_path / "p"), "--truth", str(tmp_path / "p")])
    out = capsys.readouterr().out
    assert stop.value.code == 0
    assert "| PSNR, dB ↑ | 100.00 | 18 |" in out
    assert f"LPIPS-alex, LPIPS-vgg, KID, KID-u, FVD, KVD: not computed: {FETCH}" in out
    assert "nan" not in out.lower()


def test_table_and_file(networks: Networks, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for side, columns in (("p", slice(5, 30)), ("t", slice(10, 35))):
        write(tmp_path / side / "a.png", with_alpha(noise(6), slice(10, 30), columns))
    words = ["--pred", str(tmp_path / "p"), "--truth", str(tmp_path / "t"), "--out", str(tmp_path / "new" / "out.json")]
    with pytest.raises(SystemExit):
        cli.main(["score", *words])
    out, err = capsys.readouterr()
    assert "|  | full frame | foreground | union | truth box | images |" in out
    assert f"| mask IoU ↑ | {20 * 20 / (20 * 30):.4f} | 1 |" in out
    assert "images: 100%" in err and "images:" not in out
    record = json.loads((tmp_path / "new" / "out.json").read_text())
    assert record["inputs"] == {"prediction": str(tmp_path / "p"), "truth": str(tmp_path / "t")}
    assert record["scores"]["iou"]["value"] == 20 * 20 / (20 * 30)
    assert record["code"]["version"] and record["seconds"] > 0


def ascii_ply(path: Path, points: torch.Tensor) -> Path:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {axis}" for axis in "xyz")]
    rows = [" ".join(f"{value:.9g}" for value in row) for row in points.tolist()]
    path.write_text("\n".join([*lines, "end_header", *rows, ""]))
    return path


def test_clouds_are_aligned_and_measured(score: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = torch.rand(400, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = points * torch.tensor((1.0, 0.4, 2.0)).double() + (points[:, :1] * points[:, 2:]) ** 2
    turned = 3 * points @ torch.tensor(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0))).double() + 5
    truth = ascii_ply(tmp_path / "t.ply", points)
    found = score("--pred", ascii_ply(tmp_path / "p.ply", turned), "--truth", truth, "--up", "y")
    scores = {name: item["value"] for name, item in found["scores"].items()}
    assert scores["chamfer_relative"] == pytest.approx(0, abs=1e-5)
    assert scores["fscore_1"] == 1.0
    assert found["kind"] == "geometry" and "aligned by scale 0.3333" in found["notes"][0]
    damaged_points = points.clone()
    damaged_points[3, 1] = math.nan
    said = refused(capsys, "--pred", ascii_ply(tmp_path / "nan.ply", damaged_points), "--truth", truth)
    assert "nan.ply" in said and "NaN" in said
    assert "--points: expected a number of at least 1, got 0" in refused(
        capsys, "--pred", truth, "--truth", truth, "--points", "0"
    )


def test_the_real_networks_without_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("REWILD4D_WEIGHTS", "REWILD4D_CACHE", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    found = load_networks(FAMILIES, torch.device("cpu"))
    assert found.missing == dict.fromkeys(("lpips-alex", "lpips-vgg", "kid", "fvd"), FETCH)
    assert load_networks(("psnr", "ssim", "silhouette"), torch.device("cpu")).missing == {}


def test_the_real_networks(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Plain names, the weights' digests, zero for equal clips; values are checked where the networks are."""
    missing = load_networks(FAMILIES, torch.device("cpu")).missing
    if missing:
        pytest.skip(f"no weights here: {FETCH}")
    folder = clips(tmp_path / "p", "ab", 9, 0)
    for clip in folder.iterdir():
        for file in clip.iterdir():
            write(file, cv2.resize(cv2.imread(str(file)), (48, 40)))
    with pytest.raises(SystemExit) as stop:
        cli.main(["score", "--pred", str(folder), "--truth", str(folder), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert stop.value.code == 0
    distances = {d["name"]: d for d in found["distances"]}
    assert list(distances) == ["KID", "KID-u", "FVD", "KVD", "KVD-u", "I3D-dist (paired, N=1)"]
    assert distances["KID-u"]["value"] == distances["KVD-u"]["value"] == 0.0
    assert distances["FVD"]["value"] == pytest.approx(0, abs=1e-6)
    assert distances["KID"]["value"] < 0, "the paired trap"
    assert found["scores"]["lpips_alex"]["value"] == found["scores"]["lpips_vgg"]["value"] == 0.0
    assert found["networks"].keys() == {"lpips_alex", "lpips_vgg", "inception-fid", "i3d-k400"}
    assert all(len(digest) == 64 for digest in found["networks"].values())
