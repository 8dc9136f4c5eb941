"""How a prior reaches a run on real footage: travel, keypoints, files of whole frames, the filter, and what is told."""

import math
from dataclasses import replace
from pathlib import Path

import moving
import numpy as np
import pytest
import torch
from films import PAN, SELECTION, TINY, panned, plan
from prior_files import a_prior

from rewild4d.cli import main
from rewild4d.commands.shared import choose_prior
from rewild4d.datasets.video.aptv2 import AptV2
from rewild4d.datasets.video.davis import Davis
from rewild4d.datasets.video.online import Online
from rewild4d.datasets.video.whole_frames import whole_clip
from rewild4d.errors import UserError
from rewild4d.priors.choose import PriorChoice, make_prior
from rewild4d.priors.config import STANDARD
from rewild4d.priors.footage import fit_footage
from rewild4d.priors.io import load_prior, save_prior
from rewild4d.priors.judge import agreement, doubts, prior_verdict
from rewild4d.priors.placing import known_frames, placed
from rewild4d.running import provenance, runner
from rewild4d.types import Clip, Crop, Frame, Prior, Truth

pytestmark = pytest.mark.usefixtures("cache", "tiny_footage")


def silent(*_: object) -> None:
    return None


def test_travel_leads_from_shown_frame_to_shown_frame_in_pixels_of_the_crop(tmp_path: Path) -> None:
    reader = Online(panned(tmp_path / "clip"), fps=10)
    clip, _ = reader.load("clip", SELECTION)
    assert clip.travel is not None
    crops = [frame.crop for frame in clip.frames]
    gaps = torch.tensor(clip.times).diff() * 10  # two frames where one is held out
    assert gaps.round().tolist() == [1, 2, 1, 1, 1, 2, 1, 1, 1]
    wanted = torch.stack([PAN * gap * 64 / crop.side for gap, crop in zip(gaps, crops[1:], strict=True) if crop])
    assert torch.allclose(clip.travel[:, 0], wanted.float(), atol=0.3) and clip.travel[:, 1].abs().max() < 0.3
    # as `prior fit` has it
    whole = whole_clip(reader.video("clip"))
    assert whole.travel is not None and torch.allclose(whole.travel[:, 0], torch.tensor(float(PAN)), atol=0.3)
    assert crops[1] is not None
    in_frame = float(clip.travel[:, 0].sum()) * crops[1].side / 64
    assert in_frame == pytest.approx(float(whole.travel[:, 0].sum()), abs=0.5)


def test_pixels_of_held_out_frames_decide_nothing(tmp_path: Path) -> None:
    folder = panned(tmp_path / "clip")
    clip, truth = Online(folder, fps=10).load("clip", SELECTION)
    for frame in truth.held_out:
        noise = np.random.default_rng(1).integers(0, 255, (64, 96, 3), dtype=np.uint8)
        moving.save(folder / "frames" / f"{round(frame.time * 10):05d}.png", noise)
    again, other = Online(folder, fps=10).load("clip", SELECTION)
    assert other.digest != truth.digest
    assert again.digest == clip.digest and again.travel is not None and torch.equal(again.travel, clip.travel)


def test_a_run_fits_with_travel_and_with_the_keypoints_of_aptv2(tmp_path: Path) -> None:
    reader = AptV2(moving.apt(tmp_path, keypoints=[20, 30, 2] * 17))
    clip, truth = reader.load("easy/29wolf/v1C1@3", SELECTION)
    prior = make_prior(choose_prior("template", "quick", reader), clip, truth, tmp_path / "p.npz", silent)
    assert prior.provenance.endswith("cameras unknown, with 170 keypoints, with the animal's travel, seed 0.")
    assert "pck" not in prior.quality  # nothing is left to score
    assert provenance.keypoints(choose_prior("template", "quick", reader), clip) == {
        "keypoints": "all",
        "mapping": "aptv2",
    }
    names = {"mask_iou", "facing_margin", "facing_agreement", "hops"}
    assert names | {f"{name}_flip" for name in names - {"facing_agreement"}} <= set(prior.quality)
    unseen = replace(choose_prior("template", "quick", reader), use="none")
    assert unseen.identity(clip, truth) != choose_prior("template", "quick", reader).identity(clip, truth)
    plain = make_prior(unseen, clip, truth, tmp_path / "q.npz", silent)
    assert "keypoints" not in plain.provenance and plain.quality["pck_points"] == 170
    half = make_prior(replace(unseen, use="half"), clip, truth, tmp_path / "h.npz", silent)
    assert "with 85 keypoints" in half.provenance and half.quality["pck_points"] == 85


class Options:
    """Flags of `run`."""

    def __init__(self, **flags: object) -> None:
        self.keypoints = self.mapping = self.use_keypoints = None
        self.__dict__ |= flags


def test_which_keypoints_a_run_uses(tmp_path: Path) -> None:
    davis = Davis(moving.davis(tmp_path))
    assert (choose_prior("template", "quick", davis).mapping, choose_prior("template", "quick", davis).use) == (
        "badja", "none",
    )  # fmt: skip
    own = choose_prior("template", "quick", davis, Options(use_keypoints="half"))
    assert (own.mapping, own.use) == ("badja", "half")
    given = choose_prior("template", "quick", davis, Options(keypoints=Path("a.csv"), mapping="superanimal-quadruped"))
    assert (given.mapping, given.use) == ("superanimal-quadruped", "all")
    online = Online(panned(tmp_path / "clip"))
    for flags in ({"keypoints": Path("a.csv")}, {"mapping": "badja"}):
        with pytest.raises(UserError, match="--keypoints and --mapping: expected both or neither"):
            choose_prior("template", "quick", online, Options(**flags))
    with pytest.raises(UserError, match="--use-keypoints all: expected keypoints, but there are none"):
        choose_prior("template", "quick", online, Options(use_keypoints="all"))
    with pytest.raises(UserError, match="unknown keypoint mapping 'badjo'"):
        choose_prior("template", "quick", davis, Options(mapping="badjo"))


@pytest.mark.parametrize("dataset", ["davis", "online"])
def test_a_file_of_keypoints_is_read_with_the_frames(dataset: str, tmp_path: Path) -> None:
    rows = [f"{i},{20 + i},30,0.9,{500 if i == 3 else 10},12,0.9" for i in range(12)]
    head = (
        "scorer,net,net,net,net,net,net\nbodyparts,nose,nose,nose,tail_end,tail_end,tail_end\ncoords"
        + ",x,y,likelihood" * 2
    )
    (tmp_path / "k.csv").write_text("\n".join((head, *rows)))
    if dataset == "davis":
        reader = Davis(moving.davis(tmp_path), keypoints=tmp_path / "k.csv")
        clip, _ = reader.load("camel", SELECTION)
    else:
        moving.frames(tmp_path / "clip" / "frames")
        moving.masks(tmp_path / "clip" / "masks")
        film = moving.film(tmp_path / "film.mp4", tmp_path / "clip" / "frames", "-qp", 12)
        reader = Online(film, masks=tmp_path / "clip" / "masks", keypoints=tmp_path / "k.csv")
        clip, _ = reader.load("film", SELECTION)
    assert "1 keypoints outside their frame taken as not visible" in clip.notes
    assert reader.settings["keypoints"] == str((tmp_path / "k.csv").resolve())
    frame = clip.frames[4]
    points, crop = frame.keypoints, frame.crop
    index = round(frame.time * clip.fps)
    assert points is not None and crop is not None and points.names == ("nose", "tail_end")
    assert torch.allclose(crop.to_original(points.points[0], 64), torch.tensor((20.5 + index, 30.5)), atol=1e-3)
    (tmp_path / "k.csv").write_text("\n".join((head, "400,1,2,0.9,3,4,0.9")))
    with pytest.raises(UserError, match=r"expected keypoints of the frames 00000 to 00011, got those of number 400\."):
        (
            Davis(tmp_path, keypoints=tmp_path / "k.csv")
            if dataset == "davis"
            else Online(film, masks=tmp_path / "clip" / "masks", keypoints=tmp_path / "k.csv")
        ).video(  # fmt: skip
            "camel" if dataset == "davis" else "film"
        )


def crops(count: int = 10, start: float = 0.0, fps: float = 24.0, side: int = 32) -> Clip:
    """Crops of 64x64 frames, at 24 a second, from the second ``start`` of their video."""
    frames = [
        Frame(i / fps, None, torch.zeros(3, side, side), torch.ones(1, side, side), 0, Crop(8.0 + i, 4.0, 48.0, 64, 64))
        for i in range(count)
    ]
    return Clip("cut/out", "none", tuple(frames), fps, "CC0", "", start=start, travel=torch.ones(count - 1, 2))


def on_a_ring(count: int) -> Prior:
    return a_prior([0.1 * t for t in range(count)], [-0.1 * t for t in range(count)])


def test_a_file_of_whole_frames_serves_the_crops_of_its_moments() -> None:
    whole, clip = on_a_ring(20), crops(start=5 / 24)
    found, point = placed(whole, clip), torch.tensor((0.3, 0.1, -0.4), dtype=torch.float64)
    assert found.times.tolist() == pytest.approx([i / 24 for i in range(10)]) and found.notes == ()
    for row in (0, 7):
        pixel = whole.cameras[5 + row].project(point)[0]
        expected = (pixel - torch.tensor((8.0 + row, 4.0))) * 32 / 48
        assert torch.allclose(found.cameras[row].project(point)[0], expected)
        flipped = whole.cameras_flip[5 + row].project(point)[0]
        # in the flipped frame the crop starts at 64 - 8 - row - 48
        expected = (flipped - torch.tensor((8.0 - row, 4.0))) * 32 / 48
        assert torch.allclose(found.cameras_flip[row].project(point)[0], expected)
        assert (found.cameras[row].width, found.cameras[row].height) == (32, 32)


def test_frames_that_a_file_leaves_out_lie_between_their_neighbours() -> None:
    whole = on_a_ring(10)
    rows = [0, 1, 2, 3, 5, 6, 7, 8, 9]
    holed = replace(
        whole, times=whole.times[rows], object_to_world=whole.object_to_world[rows],
        cameras=tuple(whole.cameras[row] for row in rows), transforms=whole.transforms[rows],
        cameras_flip=tuple(whole.cameras_flip[row] for row in rows), transforms_flip=whole.transforms_flip[rows],
    )  # fmt: skip
    found, exact = placed(holed, crops()), placed(whole, crops())
    assert found.notes[0].startswith("1 of 10 frames are not in the prior's file")
    for a, b in ((found.cameras, exact.cameras), (found.cameras_flip, exact.cameras_flip)):
        assert torch.equal(a[3].world_to_camera, b[3].world_to_camera)
        # half of a step of 0.1 around the ring leaves an arc's height
        assert torch.allclose(a[4].world_to_camera, b[4].world_to_camera, atol=15 * 0.1**2 / 2)


def test_a_file_for_the_clips_own_images_is_taken_as_it_is() -> None:
    """What a run wrote into runs/priors."""
    own = placed(on_a_ring(10), crops())
    assert placed(own, crops(start=3.0)).digest == own.digest


@pytest.mark.parametrize(
    ("clip", "sentence"),
    [
        (crops(fps=25.0), "of which 3 are at their times \\(was it made with another --fps\\?\\)"),
        (crops(start=1.0), "expected a prior that knows its 10 frames from 1.000 to 1.375 s, but prior 'made' has 10"),
        (crops(15), "expected a prior that knows its 15 frames from 0.000 to 0.583 s, but prior 'made' has 10 from"),
        (replace(crops(), frames=tuple(replace(f, crop=Crop(0, 0, 40, 80, 60)) for f in crops().frames)),
         "cut/out: expected crops of 64x64 frames as prior 'made' knows, got a crop of 80x60 pixels"),
        (replace(crops(), frames=tuple(replace(f, crop=None) for f in crops().frames)),
         "cut/out: expected a prior for images of 32x32 pixels, but prior 'made' is for 64x64"),
    ],
)  # fmt: skip
def test_a_file_for_another_clip_is_one_sentence(clip: Clip, sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        placed(on_a_ring(10), clip)


def test_frames_whose_camera_hops_are_left_out_of_the_fit_and_told(tmp_path: Path) -> None:
    clip = crops()
    save_prior(a_prior(*([sign * 0.1 * t + math.pi * (t == 4) for t in range(10)] for sign in (1, -1))), tmp_path / "p")
    choice, truth = PriorChoice(str(tmp_path / "p"), STANDARD), Truth((), None, "")
    prior = make_prior(choice, clip, truth, tmp_path / "no", silent)
    assert len(prior.times) == 9 and prior.quality["hops"] == 1
    assert prior.notes[1].startswith("1 of 10 frames left out: the camera is far from")
    shown = known_frames(clip, prior)
    assert [round(time * 24) for time in shown.times] == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert shown.travel is not None and shown.travel[:, 0].tolist() == [1, 1, 1, 2, 1, 1, 1, 1]
    filmed = replace(clip, frames=tuple(replace(f, camera=prior.cameras[0]) for f in clip.frames))
    assert known_frames(filmed, prior) is filmed


def test_what_speaks_against_a_prior_is_said() -> None:
    ring = on_a_ring(10)
    assert agreement(ring.cameras, ring.cameras_flip) == 1.0
    turned = a_prior([0.1 * t for t in range(10)], [-0.1 * t + math.pi * (t < 3) for t in range(10)])
    assert agreement(turned.cameras, turned.cameras_flip) == 7 / 10
    assert doubts({"mask_iou": 0.8, "mask_iou_flip": 0.7, "facing_margin": 0.1, "facing_agreement": 1.0}) == ()
    assert doubts({}) == ()
    assert doubts({"mask_iou": 0.8, "mask_iou_flip": 0.5}) == (
        "the template hardly fits these masks (mask IoU 0.50, below 0.6)",
    )
    assert doubts({"facing_agreement": 0.4}) == (
        "head and tail are uncertain: the clip and its mirror image agree in 40% of the frames",
    )
    assert "costs only 0.0020 more" in doubts({"facing_margin": 0.002})[0]


def test_a_run_warns_of_a_template_that_does_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Bars behind which an animal hides, in parts, and a swan's neck: no four-legged outline."""
    moving.frames(tmp_path / "clip" / "frames")
    for i in range(12):
        bars = np.zeros((64, 96), np.uint8)
        bars[10:60, 20 + i : 24 + i] = bars[30:34, 50 + i : 70 + i] = 255
        moving.save(tmp_path / "clip" / "masks" / f"{i:05d}.png", bars)
    (record,) = runner.execute(plan(Online(tmp_path / "clip", fps=10), "clip", tmp_path / "runs"))
    assert record.status == "ok", record.error
    notes = record.prior["notes"]
    assert any(note.startswith("the template hardly fits these masks (mask IoU 0.") for note in notes)
    assert record.prior["quality"]["mask_iou"] < 0.6 and "keypoints" not in record.prior
    assert record.prior["config"]["yaw_starts"] == 4  # the settings of footage, not of known cameras
    said = capsys.readouterr().err
    assert all(f"clip: prior: {note}" in said for note in notes)


def test_the_command_writes_a_file_that_a_run_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rewild4d.priors.choose.FOOTAGE", TINY)
    folder = panned(tmp_path / "clip", 14)
    moving.save(folder / "masks" / "00000.png", moving.mask(0) * 0)  # the clip starts at the second frame
    words = ["--frames", folder / "frames", "--masks", folder / "masks", "--out", tmp_path / "p.npz", "--fps", 10]
    words += ["--prior", "template:quadruped"]
    with pytest.raises(SystemExit) as stop:
        main(["prior", "fit", *map(str, words)])
    assert stop.value.code == 0
    assert "1 of 14 frames without the animal left out: 00000.png" in capsys.readouterr().out
    made = load_prior(tmp_path / "p.npz")
    assert made.times.tolist() == pytest.approx([i / 10 for i in range(1, 14)])
    (record,) = runner.execute(plan(Online(folder, fps=10), "clip", tmp_path / "runs", str(tmp_path / "p.npz")))
    assert record.status == "ok", record.error
    # the same outlines in crops of 64 pixels
    assert record.prior["quality"]["mask_iou"] == pytest.approx(made.quality["mask_iou"], abs=0.03)
    assert "made elsewhere: it may have seen the frames that are held out here" in record.prior["notes"]
    (refused,) = runner.execute(plan(Online(folder, fps=7), "clip", tmp_path / "runs", str(tmp_path / "p.npz")))
    assert refused.status == "failed" and "was it made with another --fps?" in refused.error


@pytest.mark.parametrize("what", ["dot", "all", "line", "flicker"])
def test_odd_masks_never_crash_a_fit(what: str) -> None:
    frames = []
    for t in range(5):
        mask = torch.zeros(1, 48, 48)
        if what == "dot":
            mask[0, 20:22, 20:22] = 1
        elif what == "all" or (what == "flicker" and t % 2):
            mask[:] = 1
        else:
            mask[0, 5 + t, :] = 1
        frames.append(Frame(t / 24, None, mask.expand(3, -1, -1), mask))
    clip = Clip("odd/masks", "none", tuple(frames), 24.0, "CC0", "", travel=torch.zeros(4, 2))
    prior = fit_footage(clip, config=TINY, seed=0, log=silent)
    assert all(math.isfinite(value) for value in prior.quality.values())
    assert torch.isfinite(prior.transforms).all() and torch.isfinite(prior.transforms_flip).all()


def test_a_prior_is_judged_by_its_fit() -> None:
    def said(quality: dict[str, float], left_out: int = 0) -> str:
        return str(prior_verdict(quality, left_out, 20))

    assert prior_verdict({}, 0, 20) is None, "nothing was fitted"
    assert said({"mask_iou": 0.88}) == "prior: green: the template fits the masks (IoU 0.88)"
    assert said({"mask_iou": 0.88, "mask_iou_flip": 0.5}).startswith(
        "prior: red: the template hardly fits these masks (mask IoU 0.50"
    )
    assert said({"mask_iou": 0.7}).startswith("prior: yellow: the template fits the masks with IoU 0.70 only")
    assert said({"mask_iou": 0.9, "facing_margin": 0.001}).startswith("prior: yellow: head and tail are uncertain")
    assert said({"mask_iou": 0.9}, 12).startswith("prior: red: 60% of the frames are left out")
    assert said({"mask_iou": 0.9}, 6).startswith("prior: yellow: 30% of the frames are left out;")
