"""Camera clusters and the command `prior fit`, at tiny size."""

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import torch
from prior_files import a_prior, ring

from rewild4d.cli import main
from rewild4d.commands import prior as command
from rewild4d.datasets.video.travel import TravelMeter
from rewild4d.errors import UserError
from rewild4d.priors import choose
from rewild4d.priors.config import FOOTAGE
from rewild4d.priors.io import load_prior, save_prior, seal
from rewild4d.priors.steady import EPS, clusters, steady, without_hops
from rewild4d.transforms import mirror_matrix


def test_clusters_are_those_of_the_definition() -> None:
    generator = torch.Generator().manual_seed(3)
    points = torch.cat(
        [torch.randn(20, 2, generator=generator) * 0.1 + 3 * k for k in range(3)] + [torch.ones(1, 2) * 9]
    )
    labels = clusters(points, 0.25, 3)
    near = (points[:, None] - points).norm(dim=-1) <= 0.25
    dense = near.sum(1) >= 3
    for i in range(len(points)):
        assert (labels[i] < 0) == (not dense[i] and not (near[i] & dense).any())
        for j in range(len(points)):
            if near[i, j] and dense[i] and dense[j]:
                assert labels[i] == labels[j]
    assert len({int(x) for x in labels[dense]}) >= 3 and labels[-1] == -1


def test_a_frame_is_left_out_where_both_cameras_hop_and_else_mended_from_the_steady_one() -> None:
    angles = [0.1 * t for t in range(12)]
    hopping = [a + math.pi * (t in (4, 9)) for t, a in enumerate(angles)]
    mirrored = [-a + math.pi * (t in (7, 9)) for t, a in enumerate(angles)]
    times = torch.arange(12).double() / 24
    assert steady(ring(angles), times).all() and steady(ring(hopping), times).tolist() == [
        t not in (4, 9) for t in range(12)
    ]
    given = a_prior(hopping, mirrored)
    filtered = without_hops(given)
    made, kept = filtered.prior, [t for t in range(12) if t != 9]
    assert filtered.kept == tuple(kept) and len(made.cameras) == len(made.cameras_flip) == len(made.times) == 11
    # Rows before 9 keep their numbers. The unsteady camera is now the mirror image of the steady one.
    for found, angle in ((made.cameras[4], 0.4), (made.cameras_flip[7], -0.7)):
        assert torch.allclose(found.world_to_camera, ring([angle])[0].world_to_camera, atol=1e-6)
    assert torch.allclose(made.transforms[4], mirror_matrix(given.transforms_flip[4, given.mirror]))
    assert made.steady is not None and made.digest != seal(replace(made, steady=None)).digest
    assert made.steady.tolist() == [[t != 4 for t in kept], [t != 7 for t in kept]]
    left_out, plain, flipped = filtered.notes
    assert left_out.startswith("1 of 12 frames left out") and left_out.endswith(": 9")
    assert plain.startswith("1 of 12 frames trained from the mirrored sequence alone") and plain.endswith(": 4")
    assert flipped.startswith("1 of 12 frames trained from the plain sequence alone") and flipped.endswith(": 7")
    for name in ("template", "learned"):
        own = replace(given, name=name)
        unfiltered = without_hops(own)
        assert unfiltered.prior is own and unfiltered.kept == tuple(range(12)) and not unfiltered.notes
    nothing = without_hops(a_prior(angles, [-a for a in angles]))
    assert nothing.notes == () and len(nothing.kept) == 12 and nothing.prior.steady is None


def test_a_frame_that_is_held_out_parts_no_smooth_way_but_a_hop_stays_one() -> None:
    shown = [t for t in range(15) if t % 5 != 2]
    times, fast = torch.tensor(shown).double() / 24, [0.2 * t for t in shown]
    assert 2 * math.sin(0.2) > EPS > 2 * math.sin(0.1)  # two steps are too far apart, one is not
    assert steady(ring(fast), times).all()
    assert not steady(ring(fast), torch.arange(12).double()).all()
    turned = [angle + math.pi / 2 * (t > 12) for angle, t in zip(fast, shown, strict=True)]
    assert steady(ring(turned), times).tolist() == [t < 12 for t in shown]


def test_cameras_of_which_few_agree_all_stay_and_that_is_told() -> None:
    scattered = without_hops(a_prior([0.1 * t if t < 4 else 1.5 * t for t in range(12)], [-0.1 * t for t in range(12)]))
    assert len(scattered.kept) == 12
    assert scattered.notes == ("no camera left out: the largest group that agrees is 4 of 12 frames",)


def test_travel_is_measured_against_a_background_that_moves() -> None:
    scene = np.random.default_rng(0).integers(0, 255, (120, 400, 3), dtype=np.uint8)
    scene = cv2.GaussianBlur(scene, (0, 0), 2.0)
    meter = TravelMeter()
    for t in range(4):
        image, mask = scene[:, 10 * t : 10 * t + 200].copy(), np.zeros((120, 200), np.uint8)
        mask[40:80, 80:120] = 255  # stays in the image while the camera pans to the right
        image[mask > 0] = 200
        meter.add(image, mask)
    steps = meter.result()
    assert torch.allclose(steps, torch.tensor((10.0, 0.0)).expand(3, 2), atol=0.5)
    large = TravelMeter()
    for t in (0, 1):  # nine times as large as frames are looked at, in pixels of the large ones
        image = cv2.resize(scene[:, 10 * t : 10 * t + 200], (1800, 1080), interpolation=cv2.INTER_LINEAR)
        mask = np.zeros((1080, 1800), np.uint8)
        mask[360:720, 720:1080] = 255
        large.add(image, mask)
    assert torch.allclose(large.result(), torch.tensor(((90.0, 0.0),)), atol=3.0)


def write_frames(folder: Path, count: int) -> None:
    for name in ("frames", "masks"):
        (folder / name).mkdir()
    for t in range(count):
        mask = np.zeros((48, 64), np.uint8)
        cv2.ellipse(mask, (26 + 2 * t, 20), (16, 7), 0, 0, 360, 255, -1)
        for x in (18, 36):
            mask[22:38, x + 2 * t : x + 3 + 2 * t] = 255
        cv2.imwrite(str(folder / "frames" / f"{t}.png"), np.full((48, 64, 3), 90, np.uint8))
        cv2.imwrite(str(folder / "masks" / f"{t}.png"), mask)


def test_the_command_writes_a_prior_and_its_pictures(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    stages = tuple(msgspec.structs.replace(stage, steps=1, frames=3) for stage in FOOTAGE.stages)
    monkeypatch.setattr(choose, "FOOTAGE", msgspec.structs.replace(FOOTAGE, stages=stages, yaw_starts=4))
    write_frames(tmp_path, 11)
    (tmp_path / "masks" / "3.png").unlink()
    arguments = [
        "--frames",
        str(tmp_path / "frames"),
        "--masks",
        str(tmp_path / "masks"),
        "--out",
        str(tmp_path / "p.npz"),
        "--fps",
        "24",
    ]
    entry = {"image_path": "2.jpg", "joints": [[540, 960]] * 34, "visibility": [1] * 34}
    (tmp_path / "k.json").write_text(json.dumps([entry, entry | {"image_path": "10.jpg"}]))
    keypoints = ["--keypoints", str(tmp_path / "k.json"), "--mapping", "badja", "--use", "half"]
    assert command.main(["fit", *arguments, *keypoints]) == 0
    prior = load_prior(tmp_path / "p.npz")
    # 2 before 10, and the frame without a mask leaves a gap in time
    assert torch.allclose(prior.times * 24, torch.tensor((0.0, 1, 2, 4, 5, 6, 7, 8, 9, 10)).double())
    assert (prior.cameras[0].width, prior.cameras[0].height) == (64, 48) and 0 <= prior.quality["pck"] <= 1
    assert (tmp_path / "p.png").is_file() and (tmp_path / "p.mp4").is_file()
    said = capsys.readouterr().out
    assert "1 of 11 frames without a mask left out" in said and "mask_iou" in said


def test_bad_input_to_the_command_is_one_sentence(tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    write_frames(tmp_path, 2)
    frames, masks, out = (
        ["--frames", str(tmp_path / "frames")],
        ["--masks", str(tmp_path / "masks")],
        ["--out", "p.npz"],
    )
    cv2.imwrite(str(tmp_path / "masks" / "1.png"), np.zeros((10, 10), np.uint8))
    (tmp_path / "other").mkdir()
    cases = [
        (
            ["fit", *frames, *masks, *out],
            "1.png: expected a mask of 64x48 pixels like its frame (or of that shape)",
        ),
        (
            ["fit", *frames, "--masks", str(tmp_path / "none"), *out],
            "none: expected a video file or a folder of",
        ),
        (["fit", *frames, "--masks", str(tmp_path / "other"), *out], "other: expected masks (.png, .jpg, "),
        (["fit", *frames, *masks, *out, "--mapping", "badja"], "--keypoints and --mapping: expected both or neither"),
        (["fitt"], "fit"),
    ]
    for arguments, message in cases:
        with pytest.raises(SystemExit) as stop:
            main(["prior", *arguments])
        said = capsys.readouterr().err
        assert stop.value.code == 2 and message in said and said.count("\n") == 1
    (tmp_path / "masks" / "1.png").write_bytes(b"no image")
    with pytest.raises(UserError, match="1.png: expected a mask image that can be read"):
        command.main(["fit", *frames, *masks, *out])
    for file in (tmp_path / "masks").iterdir():
        cv2.imwrite(str(file), np.zeros((48, 64), np.uint8))
    with pytest.raises(UserError, match="expected at least 1 frame with a mask of the animal, got 0 of 2"):
        command.main(["fit", *frames, *masks, *out])


@pytest.mark.parametrize(
    ("out", "message"),
    [("clip/masks", "clip/masks: expected the name of a file to write, but it is a folder"),
     ("taken/p.npz", "taken: expected a folder that can be written, but: File exists")],
)  # fmt: skip
def test_a_place_that_cannot_be_written_is_told_before_the_fit(tmp_path: Path, monkeypatch, out, message) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "clip").mkdir()
    (tmp_path / "taken").touch()
    write_frames(tmp_path / "clip", 4)
    monkeypatch.setattr("rewild4d.priors.footage.fit_footage", lambda *_, **__: pytest.fail("it was fitted"))
    flags = ["--frames", str(tmp_path / "clip" / "frames"), "--masks", str(tmp_path / "clip" / "masks")]
    with pytest.raises(UserError, match=message):
        command.main(["fit", *flags, "--out", str(tmp_path / out)])


def test_replacing_times_keeps_a_prior_valid(tmp_path: Path) -> None:
    filtered = without_hops(a_prior([0.1 * t for t in range(5)], [-0.1 * t for t in range(5)])).prior
    save_prior(replace(filtered, name="kept"), tmp_path / "p.npz")
    assert len(load_prior(tmp_path / "p.npz").cameras) == 5
