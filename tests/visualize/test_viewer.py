"""What the page in the browser shows at a moment, from which camera, and what it says of what it cannot show."""

import math
import socket
from dataclasses import replace

import numpy as np
import pytest
import torch
from calling import call, refusal
from signposts import CROP, TURNED, UP, Posed, Signpost, clip_of, seen_from

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.baselines.prior_only import PriorOnly
from rewild4d.cameras.placement import Placement
from rewild4d.commands import view
from rewild4d.errors import UserError
from rewild4d.running.conformance import tiny_case
from rewild4d.transforms import axis_angle_to_matrix, matrix_to_quat, similarity
from rewild4d.types import OBJECT_DIAGONAL, Camera, Splats, Truth
from rewild4d.visualize.pictures import over, part_colors
from rewild4d.visualize.viewer.comparing import BRIGHTEST, HeldOut, compare
from rewild4d.visualize.viewer.looking import Look, centered, look_from, look_through
from rewild4d.visualize.viewer.moments import Clock, Moments, pack
from rewild4d.visualize.viewer.staging import Run, posed, set_stage

ORIGIN = torch.zeros(3, dtype=torch.float64)
NOTHING = Truth((), None, "")


def post_run(turned: bool = False) -> Run:
    """A signpost that stands, or one that is a skinned shape and lies on its back in the world."""
    cameras = seen_from((-1.0, 0.2, 0.0))
    if turned:
        return Run("post", Posed(cameras, TURNED), clip_of(cameras, None), NOTHING)
    return Run("post", Signpost(cameras, step=0.4), clip_of(cameras, CROP), NOTHING)


def template_run() -> Run:
    case = tiny_case()
    config = PriorOnly.Config(gaussians=300)
    made = PriorOnly().fit(case.clip, case.prior, config=config, seed=0, device=torch.device("cpu"),
                           log=lambda *_: None, workdir=None)  # fmt: skip
    return Run("template", made, case.clip, case.truth)


def seen_by(look: Look, aspect: float, points: torch.Tensor) -> torch.Tensor:
    """Where a browser shows points: -1 to 1 from left to right and from top to bottom, [n, 2]."""
    ahead = torch.from_numpy(look.target - look.position)
    ahead = ahead / ahead.norm()
    right = torch.linalg.cross(ahead, torch.from_numpy(look.up))
    right = right / right.norm()
    local = (points - torch.from_numpy(look.position)) @ torch.stack((right, torch.linalg.cross(ahead, right), ahead)).T
    return local[:, :2] / local[:, 2:] / math.tan(look.fov / 2) / torch.tensor((aspect, 1.0))


@pytest.mark.parametrize("turned", [False, True])
def test_the_animal_stands_upright_at_the_origin_in_one_size(turned: bool) -> None:
    stage = set_stage(post_run(turned))
    grey, red, green, blue = stage.splats(1.0).means.double()
    for ball, axis in ((blue, 0), (green, 1), (red, 2)):
        assert int((ball - grey).argmax()) == axis and float((ball - grey).norm()) > 1
        torch.testing.assert_close(float((ball - grey)[axis]), float((ball - grey).norm()), rtol=1e-4, atol=0)
    cloud = stage.splats(1.0).means
    assert 0.5 * OBJECT_DIAGONAL < 2 * float((cloud.amax(0) - cloud.amin(0)).norm()) < 2 * OBJECT_DIAGONAL
    assert float(cloud[:, 1].min()) > stage.ground + float(stage.splats(1.0).scales.max()), "above the ground"
    assert float(cloud.norm(dim=1).max()) < stage.reach
    assert stage.shapes == (("deformed", "posed", "canonical") if turned else ("deformed",))
    assert stage.paints == (("appearance", "parts") if turned else ("appearance",))


def test_gaussians_and_cameras_come_to_the_stage_together() -> None:
    run = template_run()
    stage = set_stage(run)
    for frame in run.clip.frames:
        camera = stage.camera(frame)
        assert camera is not None and frame.camera is not None
        pixels, depths = camera.project(stage.splats(frame.time).means.double())
        expected, far = frame.camera.project(run.reconstruction.at(frame.time).means.double())
        torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-3)
        assert float(depths.min()) > 0 and float((depths / far).std()) < 1e-5, "a similarity"
        image, other = over(stage.splats(frame.time), camera), over(run.reconstruction.at(frame.time), frame.camera)
        assert float((image - other).abs().mean()) < 1e-3


def test_posed_is_the_shape_without_its_deformation() -> None:
    run = template_run()  # which has none
    made, time = run.reconstruction, run.clip.times[1]
    skinned, answered = posed(made, time), made.at(time)  # type: ignore[arg-type]
    torch.testing.assert_close(skinned.means, answered.means, rtol=1e-4, atol=1e-5)
    turns = (skinned.quats * answered.quats).sum(1).abs()
    assert float(turns.median()) > 0.999, "the same orientations"
    assert float((made.at(run.clip.times[2]).means - answered.means).norm(dim=1).max()) > 0.01, "and it moves"


def test_the_shape_at_rest_stands_still_in_the_middle() -> None:
    stage = set_stage(template_run())
    first, later = (stage.splats(time, "canonical") for time in (0.0, 0.2))
    assert torch.equal(first.means, later.means)
    assert float((first.means.amax(0) + first.means.amin(0)).abs().max()) < 1e-4
    assert float((first.means.amax(0) - first.means.amin(0)).norm()) == pytest.approx(OBJECT_DIAGONAL, rel=0.1)


def test_parts_have_the_colour_of_their_largest_weight() -> None:
    run = template_run()
    weights = run.reconstruction.weights  # type: ignore[attr-defined]
    colors = set_stage(run).splats(0.0, "deformed", "parts").colors[:, 0]
    palette = part_colors(weights.shape[1]).float()
    for row in (0, 77, 299):
        torch.testing.assert_close(colors[row], palette[int(weights[row].argmax())])
    assert len(colors.unique(dim=0)) > 5


def test_colours_are_those_without_what_depends_on_the_view() -> None:
    class Shiny(Signpost):
        def at(self, time: float) -> Splats:
            splats = super().at(time)
            harmonics = torch.zeros(4, 4, 3)
            harmonics[:, 0], harmonics[:, 1:] = (splats.colors[:, 0] - 0.5) / 0.28209479, 0.3
            return replace(splats, colors=harmonics)

    run = post_run()
    shiny = set_stage(replace(run, reconstruction=Shiny(seen_from((-1.0, 0.2, 0.0)))))
    torch.testing.assert_close(shiny.splats(0.0).colors, set_stage(run).splats(0.0).colors, rtol=0, atol=1e-6)


def test_a_packed_gaussian_has_its_covariance_and_rounded_colours() -> None:
    turn = matrix_to_quat(axis_angle_to_matrix(torch.tensor((0.0, 0.0, math.pi / 2))))[None]  # x -> y
    splats = Splats(torch.ones(1, 3), 3 * turn, torch.tensor([[3.0, 2.0, 1.0]]), torch.tensor([0.5]),
                    torch.tensor([[[1.2, 0.5, -1.0]]]))  # fmt: skip
    moment = pack(splats)
    np.testing.assert_allclose(moment.covariances[0], np.diag((2.0**2, 3.0**2, 1.0)), atol=1e-5)
    assert (moment.rgbs.tolist(), moment.opacities.tolist()) == ([[255, 128, 0]], [[128]])
    assert moment.nbytes == 52


def test_moments_are_computed_once_and_the_longest_unused_is_dropped() -> None:
    class Counting(Signpost):
        asked: list[float]

        def at(self, time: float) -> Splats:
            self.asked.append(time)
            return super().at(time)

    run = post_run()
    counting = Counting(seen_from((-1.0, 0.2, 0.0)))
    counting.asked = []
    stage = set_stage(replace(run, reconstruction=counting))
    counting.asked.clear()
    moments = Moments(stage, most_bytes=2 * 4 * 52)
    for time in (0.0, 1.0, 0.0, 2.0, 0.0, 1.0):
        moments.get(time, "deformed", "appearance")
    assert counting.asked == [0.0, 1.0, 2.0, 1.0] and moments.nbytes == 2 * 4 * 52
    first = moments.get(0.0, "deformed", "appearance")
    assert moments.get(0.0, "deformed", "appearance") is first
    before, after = (moments.get(time, "deformed", "appearance") for time in (0.0, 99.0))
    np.testing.assert_array_equal(after.centers, pack(stage.splats(2.0)).centers)  # after the end: the last
    assert not np.array_equal(before.centers, after.centers) or counting.step == 0


def test_a_film_plays_at_its_rate_and_begins_again() -> None:
    times = [0.1 * i for i in range(10)]
    clock = Clock(times, 10.0)
    clock.seek(3, now=100.0)
    assert [clock.moment(100.0 + 0.1 * i, 1.0) for i in range(1, 9)] == [4, 5, 6, 7, 8, 9, 0, 1]
    assert clock.moment(100.9, 2.0) == 3, "twice as fast"
    assert clock.moment(108.9, 0.25) == 3, "eight seconds at a quarter are two turns"
    clock.seek(0, now=0.0)
    assert clock.moment(0.35, 1.0) == 3, "a slow page leaves frames out"
    late = Clock([5.0, 5.5], 2.0)
    assert [late.moment(now, 1.0) for now in (0.4, 0.6, 1.1)] == [0, 1, 0], "times need not begin at 0"


def test_a_crop_is_seen_whole_from_the_same_place() -> None:
    camera = next(iter(seen_from((-1.0, 0.3, 0.4)).values()))
    crop = camera.shifted(40, -20, 48, 32)
    straight = centered(crop)
    torch.testing.assert_close(straight.center, camera.center)
    turned = straight.world_to_camera[:3, :3]
    torch.testing.assert_close(turned @ turned.T, torch.eye(3).double())
    corners = torch.tensor([(u, v, 1.0) for u in (0, 48) for v in (0, 32)]).double()
    points = camera.center + (corners @ torch.linalg.inv(crop.intrinsics).T) @ crop.world_to_camera[:3, :3]
    for aspect in (1.6, 1.0):
        seen = seen_by(look_through(crop, aspect, ORIGIN), aspect, points)
        assert float(seen.abs().max()) == pytest.approx(1), "all of the image, and nothing else"
    same = centered(camera)
    torch.testing.assert_close(same.world_to_camera, camera.world_to_camera)
    torch.testing.assert_close(same.intrinsics, camera.intrinsics)


def test_the_films_camera_shows_what_the_rasterizer_does() -> None:
    camera = next(iter(seen_from((-1.0, 0.3, 0.4)).values()))
    points = torch.tensor(((0, 0, 0), (0, 0, 1.5), (0, 1.0, 0), (0.7, 0, 0))).double()
    pixels, _ = camera.project(points)
    look = look_through(camera, 1.0, ORIGIN)
    torch.testing.assert_close(seen_by(look, 1.0, points), pixels / 32 - 1, rtol=0, atol=1e-6)
    np.testing.assert_allclose(look.target, ORIGIN, atol=1e-6)
    rolled = Camera(camera.world_to_camera.clone(), camera.intrinsics, 64, 64)
    rolled.world_to_camera[:3] = (
        axis_angle_to_matrix(torch.tensor((0, 0, math.pi))).double() @ rolled.world_to_camera[:3]
    )
    upside_down = seen_by(look_through(rolled, 1.0, ORIGIN), 1.0, points)
    torch.testing.assert_close(upside_down, 1 - pixels / 32, rtol=0, atol=1e-6)


@pytest.mark.parametrize("aspect", [1.6, 0.46])
def test_the_whole_animal_is_in_view_and_above_a_phones_panel(aspect: float) -> None:
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    look = look_from(math.pi / 2, 0.2, 3.0, aspect, ORIGIN)
    seen = seen_by(look, aspect, 3.0 * directions.double())
    assert 0.7 < float(seen.abs().max()) < 1
    assert (float(seen[:, 1].mean()) < -0.3) == (aspect < 1), "negative is up"
    assert look.position[0] > 5 and abs(look.position[2]) < 1e-6, "from the animal's left"


def test_a_held_out_view_is_compared_as_it_is_scored() -> None:
    run = template_run()
    held = HeldOut(run)
    assert held.views() == [2, 3, 4, 5]
    frame = held.nearest(3, 0.0)
    assert frame is not None and frame.view == 3 and held.nearest(7, 0.0) is None
    assert frame.camera is not None
    own = over(run.reconstruction.at(frame.time), frame.camera)
    perfect = compare(run, replace(frame, rgb=own, mask=torch.ones_like(frame.mask)))
    assert perfect is not None and perfect.psnr > 90
    assert float(perfect.difference.max()) < 0.05, "black"
    off = compare(run, replace(frame, rgb=(own - BRIGHTEST).clamp_min(0), mask=torch.ones_like(frame.mask)))
    assert off is not None and 10 < off.psnr < 20 and float(off.difference[:, 0, 0].mean()) > 0.7
    moved = similarity(1.0, torch.eye(3).double(), torch.tensor((0.3, 0.0, 0.0)).double())
    placed = compare(replace(run, placement=Placement(moved)), frame)
    found = compare(run, frame)
    assert placed is not None and found is not None and placed.psnr < found.psnr
    grey = compare(replace(run, background=0.5), frame)
    assert grey is not None and float(grey.truth[:, 0, 0].mean()) == pytest.approx(0.5)


def test_what_cannot_be_shown_is_one_sentence() -> None:
    run = post_run()
    with pytest.raises(UserError, match="post: the reconstruction has no Gaussians to show"):
        set_stage(replace(run, reconstruction=EmptyReconstruction()))

    class Blind(Signpost):
        def camera(self, time: float) -> None:  # type: ignore[override]
            return None

    class Broken(Signpost):
        def at(self, time: float) -> Splats:
            return replace(super().at(time), means=torch.full((4, 3), math.nan))

    with pytest.raises(UserError, match="post: neither the data set nor the method knows a camera"):
        set_stage(replace(run, reconstruction=Blind({})))
    with pytest.raises(UserError, match="means at 0.0000 s hold a NaN"):
        set_stage(replace(run, reconstruction=Broken({})))


def test_the_worlds_up_is_the_data_sets() -> None:
    run = post_run()
    tilted = axis_angle_to_matrix(torch.tensor((0.3, 0.0, 0.0))).double() @ UP
    stage = set_stage(replace(run, truth=replace(NOTHING, up=tilted)))
    torch.testing.assert_close(
        (stage.world_to_stage[:3, :3] @ tilted)[[0, 2]], torch.zeros(2).double(), atol=1e-9, rtol=0
    )


def test_a_port_that_cannot_be_had_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = refusal(capsys, "view", "nowhere", "--port", port)
        assert (
            said == f"rewild4d-bench: --host 127.0.0.1 --port {port}: cannot be served there: Address already in use.\n"
        )
    assert "--port 70000: expected a number from 0 to 65535" in refusal(capsys, "view", "nowhere", "--port", 70000)
    assert "cannot be served there" in refusal(capsys, "view", "nowhere", "--host", "no.such.host.invalid")


def test_a_missing_run_or_package_is_one_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "expected the folder of at least one run, got none" in refusal(capsys, "view")
    assert "nowhere" in (said := refusal(capsys, "view", "nowhere", "--port", 0)) and len(said.splitlines()) == 1
    monkeypatch.setattr(view.importlib.util, "find_spec", lambda name: None)
    assert call("view", "nowhere") == 2
    assert capsys.readouterr().err == (
        "rewild4d-bench: view: expected the package viser, run: pip install -e '.[view]'.\n"
    )
