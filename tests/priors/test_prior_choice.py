"""A prior file under known cameras: taken where it is for the clip, one sentence where it is not."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from prior_files import two_frames

from rewild4d.errors import UserError
from rewild4d.priors.choose import ELSEWHERE, OTHER_BONES, PriorChoice, make_prior
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import save_prior, seal
from rewild4d.types import Clip, Keypoints, Prior, Truth

NOTHING = Truth((), None, "")


def chosen(prior: Prior, clip: Clip, folder: Path) -> Prior:
    save_prior(seal(prior), folder / "p.npz")
    return make_prior(PriorChoice(str(folder / "p.npz"), STANDARD), clip, NOTHING, folder / "no", lambda *_: None)


def test_a_file_that_a_run_left_is_taken_as_it_is(prior: Prior, tmp_path: Path) -> None:
    found = chosen(prior, two_frames(), tmp_path)
    assert found.notes == (ELSEWHERE,)
    for key in ("transforms", "transforms_flip", "object_to_world", "times"):
        assert torch.equal(getattr(found, key), getattr(prior, key))
    for mine, theirs in zip((*found.cameras, *found.cameras_flip), (*prior.cameras, *prior.cameras_flip), strict=True):
        assert torch.equal(mine.world_to_camera, theirs.world_to_camera)
        assert torch.equal(mine.intrinsics, theirs.intrinsics)


def test_its_figures_are_measured_again(prior: Prior, tmp_path: Path) -> None:
    found = chosen(replace(prior, quality={"mask_iou": 0.99, "cost": 0.25}), two_frames(), tmp_path)
    assert found.quality["mask_iou"] == prior.quality["mask_iou"] != 0.99
    assert found.quality["cost"] == 0.25 and "hops" not in found.quality


def test_a_file_for_frames_of_half_the_size_serves(prior: Prior, tmp_path: Path) -> None:
    half = tuple(camera.resized(32, 20) for camera in prior.cameras)
    found = chosen(replace(prior, cameras=half), two_frames(), tmp_path)
    assert torch.equal(found.cameras[0].intrinsics, prior.cameras[0].intrinsics) and found.cameras[0].width == 64


def test_cameras_that_contradict_the_clips_are_one_sentence(prior: Prior, tmp_path: Path) -> None:
    unknown = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)  # as `prior fit` writes it: the object is the world
    sentence = r"p.npz: expected a prior whose cameras agree with those of made/up, but at 0.000 s they put the temp"
    with pytest.raises(UserError, match=sentence):
        chosen(replace(prior, object_to_world=unknown), two_frames(), tmp_path)


@pytest.mark.parametrize(("shift", "agrees"), [(0.6, True), (0.7, False)])
def test_a_hundredth_of_the_longer_side_is_the_limit(prior, tmp_path, shift, agrees) -> None:  # type: ignore[no-untyped-def]
    """Of 64 pixels it is 0.64."""
    moved = tuple(camera.shifted(shift, 0.0, 64, 40) for camera in prior.cameras)
    if agrees:
        found = chosen(replace(prior, cameras=moved), two_frames(), tmp_path)
        assert torch.equal(found.cameras[0].intrinsics, prior.cameras[0].intrinsics)
        return
    with pytest.raises(UserError, match="joints up to 0.7 pixels apart"):
        chosen(replace(prior, cameras=moved), two_frames(), tmp_path)


def test_a_file_for_another_clip_and_masks_that_are_empty(prior: Prior, tmp_path: Path) -> None:
    clip = two_frames()
    with pytest.raises(UserError, match="p.npz: made/up: expected a prior that knows its 2 frames from 0.000 to 0.042"):
        chosen(replace(prior, times=prior.times + 7.0), clip, tmp_path)
    empty = tuple(replace(frame, mask=0 * frame.mask) for frame in clip.frames)
    with pytest.raises(UserError, match="made/up: expected at least one mask that shows the animal"):
        chosen(prior, replace(clip, frames=empty), tmp_path)


@pytest.mark.parametrize("level", ["nan", "inf", "-1", "-inf"])
def test_noise_that_is_none(level: str) -> None:
    with pytest.raises(UserError, match=f"--prior coarse:{level}: expected a finite noise of 0 or more, got '{level}'"):
        PriorChoice(f"coarse:{level}", STANDARD).identity(two_frames(), NOTHING)


@pytest.mark.parametrize("bones", [5, 20, 30])
def test_keypoints_say_nothing_of_another_skeleton(prior: Prior, tmp_path: Path, bones: int) -> None:
    """A mapping names bones of the template; a skeleton of as many bones in pairs of its own is another one too."""
    shape = {
        "weights": torch.eye(bones)[torch.zeros(len(prior.vertices), dtype=torch.long)],
        "bones": prior.bones[:1].expand(bones, 2, 3).contiguous(),
        "parents": torch.full((bones,), -1),
        "mirror": torch.arange(bones),
        "transforms": torch.eye(4).expand(2, bones, 4, 4).contiguous(),
        "transforms_flip": torch.eye(4).expand(2, bones, 4, 4).contiguous(),
    }
    points = Keypoints(("nose", "left_eye"), torch.tensor(((20.0, 20.0), (30.0, 30.0))), torch.ones(2).bool())
    clip = two_frames()
    clip = replace(clip, frames=tuple(replace(frame, keypoints=points) for frame in clip.frames))
    for made, scored in ((prior, True), (replace(prior, **shape), False)):
        save_prior(seal(made), tmp_path / "p.npz")
        choice = PriorChoice(str(tmp_path / "p.npz"), STANDARD, mapping="aptv2", use="none")
        found = make_prior(choice, clip, NOTHING, tmp_path / "no", lambda *_: None)
        assert found.notes == ((ELSEWHERE,) if scored else (ELSEWHERE, OTHER_BONES))
        assert ("pck" in found.quality) == scored


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("coarse:x", r"--prior coarse:x: expected coarse:<number>, got 'x'\."),
        ("coarse:-1", r"--prior coarse:-1: expected a finite noise of 0 or more, got '-1'\."),
        ("learned", r"--prior learned: expected learned:<weights>, since no weights come with the package yet; "),
        ("learned:none", r"none: expected weights of the learned prior \(`prior train` writes them\), got no"),
        ("nowhere.npz", r"nowhere\.npz: expected a prior file, but there is no such file\."),
    ],
)
def test_a_name_that_is_no_prior_is_told_before_anything_is_fitted(name: str, sentence: str) -> None:
    for sound in ("template", "rig", "coarse", "coarse:0.5"):
        PriorChoice(sound, STANDARD).require()
    with pytest.raises(UserError, match=sentence):
        PriorChoice(name, STANDARD).require()
