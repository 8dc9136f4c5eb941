"""One prediction under every definition: known films, known images, the tables, and the command on a saved run."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch
from extractors import SquaredError
from films import PROTOCOL
from toys import make_toy

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.baselines.floors_config import PriorOnlyConfig
from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyReconstruction
from rewild4d.cameras.placement import IDENTITY
from rewild4d.errors import UserError
from rewild4d.evaluation.definitions import LazyDrawn, _draw, joint_scores, picture_scores, tables
from rewild4d.evaluation.film_keypoints import Annotated, Part, annotated, mapped, score_keypoints, score_transfer
from rewild4d.evaluation.film_pictures import Drawn, score_pictures
from rewild4d.evaluation.joints import joint_tracks
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.networks import Networks, families_of
from rewild4d.metrics.definitions import KEYPOINT_SOURCES, KEYPOINTS, PICTURES, TRANSFER, definition
from rewild4d.priors.landmarks import load_mapping
from rewild4d.types import Frame, Keypoints, Truth

pytestmark = pytest.mark.usefixtures("one_thread")
LPIPS = {"lpips_alex": SquaredError(), "lpips_vgg": SquaredError()}


def silent(*_: object) -> None:
    return None


def film(frames: int = 12, joints: int = 4) -> Annotated:
    """Joints that walk to the right in images of 64 pixels, whose masks have 20 x 20 pixels and are 40 pixels wide."""
    start = np.random.default_rng(1).uniform(10, 40, (1, joints, 2))
    true = start + np.arange(frames)[:, None, None] * np.array([1.0, 0.0])
    full = np.ones((frames, joints), dtype=bool)
    return Annotated(
        ("a", "b", "c", "d")[:joints], true, full, full, np.ones(frames, dtype=bool), np.full(frames, 20.0),
        np.full(frames, 40.0), 64.0, np.arange(frames) / 10,
    )  # fmt: skip


def whole(truth: Annotated, points: np.ndarray) -> list[Part]:
    return [Part(np.arange(len(points)), points, np.ones(points.shape[1], dtype=bool))]


def test_one_error_of_three_pixels_has_three_pcks() -> None:
    truth = film()
    scores = score_keypoints(truth, whole(truth, truth.true + np.array([0.0, 3.0])), "bones")
    values = {name: score.value for name, score in scores.items()}
    assert values["pck@0.1_mask_area_bones"] == 0.0  # 3 > 0.1 * 20
    assert values["pck@0.1_box_bones"] == values["pck@0.1_crop_bones"] == 1.0  # 3 < 0.1 * 40
    assert values["pck@0.05_box_bones"] == 0.0 and values["pck@0.05_crop_bones"] == 1.0  # 2 < 3 < 0.05 * 64
    assert values["mpjve_bones"] == pytest.approx(0, abs=1e-9) and scores["mpjve_bones"].count == 11 * 4
    assert scores["pck@0.1_box_bones"].note.startswith("12 annotated frames, 48 joints; 10 steps a second")


def test_joints_that_a_network_placed_unsurely_count_for_one_paper_alone() -> None:
    truth = replace(film(), placed=np.ones((12, 4), dtype=bool))
    truth.counted[:, 0] = False
    points = truth.true.copy()
    points[:, 0] += 30  # far off, and nobody is sure where it is
    scores = score_keypoints(truth, whole(truth, points), "bones")
    assert scores["pck@0.1_mask_area_bones"].value == 3 / 4 and scores["pck@0.1_crop_bones"].value == 1.0


def test_a_fixed_frame_rate_multiplies_accelerations() -> None:
    truth = film()
    shaken = truth.true + np.resize([1.0, -1.0], len(truth.true))[:, None, None] * np.array([0.0, 1.0])
    scores = score_keypoints(truth, whole(truth, shaken), "bones")
    own, published = (scores[f"{name}_bones"].value for name in ("accel", "accel_at_30fps"))
    assert own == pytest.approx(4 / 64 * 10**2) and published == pytest.approx(4 / 64 * 30**2)


def test_frames_annotated_without_a_visible_joint_are_zero_for_one_paper_and_left_out_by_the_other() -> None:
    truth = film()
    truth.counted[3] = False
    scores = score_keypoints(truth, whole(truth, truth.true), "bones")
    assert scores["pck@0.1_crop_bones"].value == pytest.approx(11 / 12)
    assert scores["pck@0.1_mask_area_bones"].value == 1.0
    truth.present[3] = False  # not annotated at all: no frame of the data set
    assert score_keypoints(truth, whole(truth, truth.true), "bones")["pck@0.1_crop_bones"].value == 1.0


def test_sparse_annotations_have_velocities_over_their_usual_distance() -> None:
    truth = film(13)
    truth.counted[np.arange(13) % 3 > 0] = False
    truth.present[:] = truth.counted.any(1)
    note = score_keypoints(truth, whole(truth, truth.true), "bones")["mpjve_bones"].note
    assert note == "5 annotated frames, 20 joints; 3.333 steps a second from one to the next"


def test_what_cannot_be_computed_says_why() -> None:
    truth = film(1)
    scores = score_keypoints(truth, whole(truth, truth.true), "bones")
    assert scores["pck@0.1_box_bones"].value == 1.0
    why = "not computed: no joint is annotated in"
    assert scores["mpjve_bones"].note == f"{why} two evenly spaced frames" and scores["mpjve_bones"].value is None
    assert scores["accel_bones"].note == f"{why} three evenly spaced frames"
    points = np.zeros((1, 3, 2))
    found = score_transfer(truth, points, np.ones(3, dtype=bool))
    assert {score.note for score in found.values()} == {"not computed: it takes two annotated frames"}
    two = film(2)
    assert (
        "no point of the reconstruction is visible"
        in score_transfer(two, np.zeros((2, 3, 2)), np.zeros(3, dtype=bool))["kt@0.1_mask_area"].note
    )
    two.counted[0, :2] = two.counted[1, 2:] = False
    assert (
        "annotated both in the first and in the last"
        in score_transfer(two, np.zeros((2, 3, 2)), np.ones(3, bool))["kt@0.1_mask_area"].note
    )
    with pytest.raises(ValueError, match="at least 6 annotated frames, and there are 2"):
        mapped(two, np.zeros((2, 3, 2)), halves=True)


def test_keypoints_are_carried_from_the_first_annotated_frame_to_the_last() -> None:
    truth = film()
    points = np.stack((truth.true[0], truth.true[0] + np.array([0.0, 9.0])), axis=0).repeat(1, axis=0)
    points = np.concatenate((points[:1].repeat(11, axis=0), truth.true[-1:] + 1.5))  # 1.5 * sqrt(2) > 0.1 * 20
    scores = score_transfer(truth, points, np.ones(4, dtype=bool))
    assert scores["kt@0.1_mask_area"].value == 0.0
    points[-1] = truth.true[-1] + np.array([0.0, 1.5])  # 1.5 < 2, above 0.05 * 20
    scores = score_transfer(truth, points, np.ones(4, dtype=bool))
    assert (scores["kt@0.1_mask_area"].value, scores["kt@0.05_mask_area"].value) == (1.0, 0.0)
    assert scores["kt@0.1_mask_area"].note == "from 0.00 to 1.10 s"


def test_no_half_of_a_film_is_scored_by_a_map_that_was_fitted_to_it() -> None:
    truth = film()
    off = np.array([0.0, 3.0])  # three pixels are wrong, a half of it is right
    points = np.concatenate((truth.true, truth.true + off), axis=1)
    points[6:] = np.concatenate((truth.true + off, truth.true), axis=1)[6:]
    every = score_keypoints(truth, mapped(truth, points, halves=False), "map_test_frames")
    halves = mapped(truth, points, halves=True)
    assert [(part.rows[0], part.rows[-1], part.trained[0], part.trained[-1]) for part in halves] == [
        (0, 5, 0.6, 1.1), (6, 11, 0.0, 0.5)
    ]  # fmt: skip
    other = score_keypoints(truth, halves, "map_other_half")
    assert every["pck@0.1_mask_area_map_test_frames"].value == 1.0
    assert other["pck@0.1_mask_area_map_other_half"].value == 0.0
    assert "map fitted to 6 frames, 0.60 to 1.10 s; map fitted to 6 frames, 0.00 to 0.50 s" in (
        other["mpjve_map_other_half"].note
    )
    assert other["mpjve_map_other_half"].count == 2 * 5 * 4  # no velocity from one half to the other


def drawn(error: float, shift: int, side: int = 32) -> Drawn:
    """A grey square whose colour is off, drawn some pixels to the right of the true one."""
    mask = torch.zeros(1, side, side)
    mask[:, 8:24, 4:20] = 1.0
    alpha = mask.roll(shift, 2)
    return Drawn(alpha.expand(3, -1, -1) * (0.5 - error), alpha, mask.expand(3, -1, -1) * 0.5, mask)


def test_images_of_a_square_have_the_numbers_of_arithmetic() -> None:
    frames = [drawn(0.1, 0), *[drawn(0.1, 4)] * 20]
    found = score_pictures(frames, LPIPS, {}, silent)
    scores = {name: score.value for name, score in found.items()}
    assert (found["psnr_black"].count, found["psnr_black_worst5"].count) == (21, 1)
    assert scores["iou"] == pytest.approx((1 + 20 * 12 / 20) / 21)
    assert scores["iou@0.7"] == pytest.approx(scores["iou"], abs=1e-6)
    assert scores["iou_pooled"] == pytest.approx((16 + 20 * 12) / (16 + 20 * 20))
    share = 16 * 16 / 32**2
    inside = 10 * math.log10(1 / 0.01)
    moved = (12 / 16 * 0.01 + 4 / 16 * 0.25) * share, 4 / 16 * 0.16 * share  # left edge black or white; right edge
    black = [inside - 10 * math.log10(share)] + [-10 * math.log10(sum(moved))] * 20
    assert scores["psnr_black"] == pytest.approx(np.mean(black), abs=1e-3)
    assert scores["psnr_black_worst5"] == pytest.approx(min(black), abs=1e-3)
    masked = [inside] + [-10 * math.log10(12 / 16 * 0.01 + 4 / 16 * 0.25)] * 20
    assert scores["psnrm"] == pytest.approx(np.mean(masked), abs=1e-3)
    white = [black[0]] + [-10 * math.log10((12 / 16 * 0.01 + 4 / 16 * (0.25 + 0.36)) * share)] * 20
    assert scores["psnr_white"] == pytest.approx(np.mean(white), abs=1e-3)
    errors = [10 ** (-value / 10) for value in white]
    assert scores["psnr_pooled_white"] == pytest.approx(-10 * math.log10(np.mean(errors)), abs=1e-3)


def test_the_search_for_a_brightness_hides_an_error_of_exposure() -> None:
    found = score_pictures([drawn(0.1, 0)] * 3, LPIPS, {}, silent)
    plain, searched = (found[f"psnr_pooled_white{end}"].value or 0 for end in ("", "_brightness"))
    assert searched > plain + 20  # 0.4 x 1.2525 is 0.501
    assert found["psnr_pooled_white_brightness"].note == f"brightness × {124 / 99 * 1:.4f}"
    assert (found["ssim_reflected_brightness"].value or 0) > (found["ssim_reflected"].value or 0)
    # half of the scale is a quarter of a squared error
    assert found["lpips_alex_unscaled"].value == pytest.approx((found["lpips_alex"].value or 0) / 4)


def test_missing_networks_few_frames_and_empty_masks_say_so() -> None:
    missing = {"lpips-alex": "weights missing", "lpips-vgg": "weights missing"}
    found = score_pictures([drawn(0.1, 4)] * 19, {}, missing, silent)
    assert {found[name].note for name in PICTURES if name.startswith("lpips_vgg")} == {"not computed: weights missing"}
    assert found["lpips_alex_unscaled_brightness"].note == "not computed: weights missing"
    assert found["iou@0.7_worst5"].note == "not computed: 5 % of 19 frames is no frame, it takes 20"
    nothing = Drawn(*(torch.zeros(channels, 32, 32) for channels in (3, 1, 3, 1)))
    empty = score_pictures([nothing], {}, missing, silent)
    assert empty["psnrm"].note == empty["iou"].note == "not computed: no frame in which it is defined"
    assert empty["psnr_pooled_white"].note == "not computed: the images are identical, so that it is infinite"
    assert empty["iou_pooled"].value is None
    mixed = score_pictures([nothing, drawn(0.1, 0)], {}, missing, silent)["psnrm"]
    assert mixed.count == 1 and mixed.per_item == [None, pytest.approx(20, abs=1e-3)]  # beside the frames' labels
    none = score_pictures([], {}, missing, silent)
    assert all(score.value is None and score.note.startswith("not computed: ") for score in none.values())


@pytest.fixture(scope="module")
def posed() -> tuple[list[Frame], PriorOnlyReconstruction]:
    """The toy seen by one camera, annotated where its own joints are drawn."""
    clip, prior = make_toy()
    made = PriorOnly().fit(clip, prior, config=PriorOnlyConfig(gaussians=1000), seed=0, device=torch.device("cpu"),
                           log=silent, workdir=None)  # fmt: skip
    camera = replace(clip.frames[0].camera, width=48, height=48)  # type: ignore[type-var]
    square = [
        replace(frame, camera=camera, rgb=frame.rgb[:, :, :48], mask=frame.mask[:, :, :48]) for frame in clip.frames
    ]
    names = tuple(load_mapping("aptv2"))
    points = torch.from_numpy(joint_tracks(made, load_mapping("aptv2"), names, square).points)
    seen = torch.ones(17, dtype=torch.bool)
    return [replace(f, keypoints=Keypoints(names, at, seen)) for f, at in zip(square, points, strict=True)], made


def test_a_reconstruction_whose_joints_were_annotated_is_perfect_by_its_bones(
    posed: tuple[list[Frame], PriorOnlyReconstruction],
) -> None:
    frames, made = posed
    scores = joint_scores(made, frames, load_mapping("aptv2"))
    assert {*scores} == {*TRANSFER, *(f"{name}_{source}" for name in KEYPOINTS for source in KEYPOINT_SOURCES)}
    for name in KEYPOINTS:
        assert scores[f"{name}_bones"].value == pytest.approx(1.0 if name.startswith("pck") else 0.0, abs=1e-6)
    assert scores["pck@0.1_box_map_other_half"].note == (
        "not computed: two halves need at least 6 annotated frames, and there are 5"
    )
    assert (scores["pck@0.1_box_map_test_frames"].value or 0) > 0.9
    assert (scores["kt@0.1_mask_area"].value or 0) > 0.8  # nothing moves


def test_keypoints_in_another_order_or_of_another_set_are_matched_by_name(
    posed: tuple[list[Frame], PriorOnlyReconstruction],
) -> None:
    frames, made = posed
    flipped = [
        replace(f, keypoints=Keypoints(f.keypoints.names[::-1], f.keypoints.points.flip(0), f.keypoints.visible))
        for f in frames if f.keypoints is not None
    ]  # fmt: skip
    assert joint_scores(made, [frames[0], *flipped[1:]], load_mapping("aptv2"))["pck@0.05_box_bones"].value == 1.0
    nothing = joint_scores(made, frames, {"hoof": "nose"})
    assert nothing["pck@0.05_box_bones"].note == "not computed: no keypoint of these frames is known"
    bare = [replace(frame, keypoints=None) for frame in frames]
    assert joint_scores(made, bare, load_mapping("aptv2"))["mpjve_bones"].note == (
        "not computed: these frames have no keypoints"
    )
    without = [
        frames[0],
        *(replace(f, keypoints=Keypoints(("nose",), torch.zeros(1, 2), torch.ones(1) > 0)) for f in frames),
    ]
    with pytest.raises(UserError, match="keypoints of frame 1: expected the joint 'left_eye' among nose"):
        joint_scores(made, without, load_mapping("aptv2"))


def test_a_method_without_a_skeleton_still_has_images_and_says_so_of_its_joints(
    posed: tuple[list[Frame], PriorOnlyReconstruction],
) -> None:
    frames, _ = posed
    scores = joint_scores(EmptyReconstruction(), frames, load_mapping("aptv2"))
    assert scores["pck@0.1_box_bones"].note == "not computed: this method has no skeleton"
    assert scores["kt@0.1_mask_area"].note == "not computed: no Gaussian is drawn"
    images = picture_scores(EmptyReconstruction(), frames, Networks(lpips=LPIPS), silent)
    assert images["iou"].value == 0.0 and images["psnrm"].value is not None


def test_square_images_are_asked_for_where_there_are_keypoints(
    posed: tuple[list[Frame], PriorOnlyReconstruction],
) -> None:
    tall = [replace(frame, mask=frame.mask[:, :40]) for frame in posed[0]]
    with pytest.raises(UserError, match="expected square images of one size"):
        annotated(tall)


def test_every_cell_of_the_tables_is_a_number_a_reason_or_no_part_of_the_paper(
    posed: tuple[list[Frame], PriorOnlyReconstruction],
) -> None:
    frames, made = posed
    scores = joint_scores(made, frames, load_mapping("aptv2"))
    (joints,) = tables(scores, "toy", ["remark"])
    scores |= picture_scores(made, frames, Networks(missing={"lpips-alex": "weights missing"}), silent)
    both = tables(scores, "toy", ["remark"])
    assert both[0] == joints and [table.name for table in both] == ["definitions-keypoints", "definitions-images"]
    for table in both:
        assert len({column.title for column in table.columns}) == len(table.columns)
        for cell in (cell for row in table.rows for cell in row.cells):
            assert (cell.text == "") == (not cell.note) and (cell.text == "n/a") == ("not computed: " in cell.note)
    names = {name for row in both[1].rows for name in row.stubs}
    assert {"Animal-in-Motion", "Animal Avatars", "4D-Animal", "4DEquine, appearance"} <= names
    for name, score in scores.items():
        assert (score.unit, score.better) == (definition(name).unit, definition(name).better)


def test_a_protocol_may_ask_for_the_scores_of_other_papers(posed: tuple[list[Frame], PriorOnlyReconstruction]) -> None:
    frames, made = posed
    asked = ("psnr", "psnr_black", "pck@0.1_box_bones", "lpips_vgg_black", "iou")
    protocol = msgspec.structs.replace(PROTOCOL, dataset="aptv2", scores=asked)
    clip, _ = make_toy()
    found = evaluate(made, clip, Truth(frames, None, ""), protocol, silent, torch.device("cpu"))
    assert list(found.scores) == list(asked)
    assert found.scores["pck@0.1_box_bones"].value == 1.0
    alone = score_pictures([*LazyDrawn(len(frames), lambda i: _draw(made, frames[i], IDENTITY))], {}, {}, silent)
    assert found.scores["psnr_black"] == alone["psnr_black"]
    assert families_of(asked) == ["lpips-vgg"]
