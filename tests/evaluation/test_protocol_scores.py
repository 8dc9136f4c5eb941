"""What a protocol asks for beyond pixels: shapes, novel views as sets, learned metrics; what it says without them."""

import json
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from extractors import LinearNetwork, LinearVideoNetwork, SquaredError

from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyConfig
from rewild4d.cameras.input_view import world_up
from rewild4d.contracts import Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation import measuring, novel_views
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.networks import Networks
from rewild4d.evaluation.protocol import NovelViews, Protocol, find_protocol, load_protocols
from rewild4d.metrics.names import KINDS, SETS
from rewild4d.metrics.score import Score
from rewild4d.metrics.sets import FILE, distances, read_features
from rewild4d.running.conformance import tiny_case
from rewild4d.transforms import look_at
from rewild4d.types import Camera, Case, Clip, Splats

CPU = torch.device("cpu")
FETCH = "weights missing, run: rewild4d-bench weights fetch"
RESULTS = Path(__file__).parents[2] / "results"


@pytest.fixture(scope="module")
def case() -> Case:
    made = tiny_case()
    points = made.prior.vertices.double()

    def sample(time: float, count: int, seed: int) -> torch.Tensor:
        """Vertices of the posed prior, which is the truth of this case."""
        frame = int((made.prior.times - time).abs().argmin())
        blended = torch.einsum("nj,jab->nab", made.prior.weights.double(), made.prior.transforms[frame].double())
        moved = (blended[:, :3, :3] @ points[:, :, None])[..., 0] + blended[:, :3, 3]
        world = made.prior.object_to_world[frame]
        moved = moved @ world[:3, :3].T + world[:3, 3]
        drawn = torch.randperm(len(moved), generator=torch.Generator().manual_seed(seed))[:count]
        return moved[drawn]

    world = made.prior.object_to_world[0]
    scale = float(world[:3, 0].norm())
    return replace(made, truth=replace(made.truth, sample=sample, diagonal=5 * scale, up=world[:3, 1] / scale))


@pytest.fixture(scope="module")
def exact(case: Case) -> Reconstruction:
    return PriorOnly().fit(
        case.clip, case.prior, config=PriorOnlyConfig(gaussians=3000), seed=0, device=CPU, log=quiet, workdir=None
    )


def quiet(*_: object) -> None:
    """No progress."""


def asking(*scores: str) -> Protocol:
    base = find_protocol("artemis", "artemis-sweep-128-v4")
    return msgspec.structs.replace(base, scores=scores, points=700, novel=NovelViews(frames=2, clip=16, stride=8))


def test_a_protocol_is_never_changed_once_it_was_used() -> None:
    digests = {}
    for path in RESULTS.rglob("record.json"):
        used = json.loads(path.read_text())["protocol"]
        digests[used["name"]] = used["digest"]
    assert digests
    assert {name: load_protocols()[name].digest for name in digests} == digests


def test_the_default_is_the_newest_of_the_defaults() -> None:
    assert find_protocol("artemis", None).name == "artemis-sweep-256-v4"


@pytest.mark.parametrize(
    ("change", "text"),
    [({"scores": ["psnr", "beauty"]}, "unknown score 'beauty'"),
     ({"points": None}, "scores of the shape need 'points'"),
     ({"scores": ["kid_v"], "novel": None}, "scores of novel views need a table 'novel'")],
)  # fmt: skip
def test_a_protocol_that_cannot_be_scored_is_refused(change: dict[str, object], text: str) -> None:
    given = msgspec.to_builtins(find_protocol("artemis", None)) | change
    with pytest.raises(msgspec.ValidationError, match=text):
        msgspec.convert(given, Protocol)


def test_the_exact_shape_is_at_the_floor_and_carries_its_alignment(case: Case, exact: Reconstruction) -> None:
    wanted = asking("chamfer_relative", "fscore_5", "chamfer_relative_unaligned", "fscore_5_30k")
    found = evaluate(exact, case.clip, case.truth, wanted, quiet, CPU)
    assert list(found.scores) == list(wanted.scores) and found.items == []
    distance, agreement, plain, dense = (found.scores[name] for name in wanted.scores)
    floor = distance.floor or 0
    assert floor / 2 < (distance.value or 0) < 2 * floor
    assert (distance.unit, distance.better, distance.count) == ("1", "lower", len(case.clip.frames))
    assert (agreement.value or 0) > 0.9 and agreement.better == "higher"
    assert plain.value == pytest.approx(distance.value, rel=0.2)
    assert "truth of 1418 points" in dense.note and (dense.value or 0) >= (agreement.value or 0)
    assert [(one["fit"], one["points"]) for one in found.alignments] == [("sequence", 700), ("sequence", 30_000)]
    assert [one["scale"] for one in found.alignments] == pytest.approx([1, 1], abs=0.01)


def test_the_drawn_surface_of_the_exact_shape_is_scored_beside_its_centres(case: Case, exact: Reconstruction) -> None:
    wanted = asking("chamfer_relative", "chamfer_relative_drawn", "fscore_5_drawn")
    found = evaluate(exact, case.clip, case.truth, wanted, quiet, CPU)
    centres, drawn, agreement = (found.scores[name] for name in wanted.scores)
    floor = drawn.floor or 0
    assert floor / 2 < (drawn.value or 0) < 2 * floor and drawn.value != centres.value
    assert (agreement.value or 0) > 0.9
    assert drawn.note.startswith(
        "points of the surface that Gaussians draw in 32 views of 256 pixels; prediction of 700"
    )
    assert [one["sampling"].split()[0] for one in found.alignments] == ["centres", "points"]


def test_without_geometry_the_score_says_so(case: Case, exact: Reconstruction) -> None:
    found = evaluate(exact, case.clip, replace(case.truth, sample=None), asking("fscore_1"), quiet, CPU)
    assert found.scores["fscore_1"].value is None
    assert found.scores["fscore_1"].note == "not computed: the data set has no geometry"


def test_learned_metrics_use_the_networks_and_record_them(
    case: Case, exact: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    networks = Networks({"lpips_alex": SquaredError()}, LinearNetwork(), LinearVideoNetwork())
    monkeypatch.setattr(measuring, "load_networks", lambda families, device: networks)
    names = ("psnr", "lpips_alex", "kid_v", "fvd_f", "kvd_diag")
    found = evaluate(exact, case.clip, case.truth, asking(*names), quiet, CPU)
    per_image = [10 ** (-(value or 0) / 10) for value in found.scores["psnr"].per_item]
    assert found.scores["lpips_alex"].per_item == pytest.approx(per_image, rel=1e-5)
    assert found.networks == {"lpips_alex": "1" * 64, "linear": "0" * 64, "linear-video": "0" * 64}
    kid, fvd = found.scores["kid_v"], found.scores["fvd_f"]
    assert kid.count == 2 * 16 and kid.note.startswith(f"n = 32, m = {len(case.clip.frames)}")
    assert fvd.value is None and "at least 2 samples a side are needed, got 16 and 1" in fvd.note


def test_what_is_kept_beside_a_record_gives_its_distances_again(
    case: Case, exact: Reconstruction, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    networks = Networks({}, LinearNetwork(), LinearVideoNetwork())
    monkeypatch.setattr(measuring, "load_networks", lambda families, device: networks)
    wanted = asking(*SETS)
    assert wanted.novel is not None
    wanted = msgspec.structs.replace(wanted, novel=msgspec.structs.replace(wanted.novel, clip=9, stride=1))
    found = evaluate(exact, case.clip, case.truth, wanted, quiet, CPU)
    fields = found.keep(tmp_path)
    assert "sets" not in fields and fields["scores"] == found.scores
    back = read_features(tmp_path / FILE, fields["features"])
    assert [one for kind in KINDS if kind in back for one in distances(back[kind])] == found.distances
    none = evaluate(exact, case.clip, case.truth, asking("psnr"), quiet, CPU).keep(tmp_path / "none")
    assert none["features"] == "" and not (tmp_path / "none").exists()


def test_without_weights_every_learned_score_tells_the_command(
    case: Case, exact: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = dict.fromkeys(("lpips-alex", "kid", "fvd"), FETCH)
    monkeypatch.setattr(measuring, "load_networks", lambda families, device: Networks(missing=missing))
    names = ("psnr", "lpips_alex", *SETS)
    found = evaluate(exact, case.clip, case.truth, asking(*names), quiet, CPU)
    assert found.scores["psnr"].value is not None and found.networks == {}
    assert {found.scores[name].note for name in names[1:]} == {f"not computed: {FETCH}"}


@pytest.mark.parametrize(
    ("frames", "first_and_last"),
    [(24, [(0, 15), (8, 23)]), (16, [(0, 15)]), (20, [(0, 15), (4, 19)]), (15, [(0, 14)]), (1, [(0, 0)])],
)
def test_clips_cover_the_video(frames: int, first_and_last: list[tuple[int, int]]) -> None:
    windows = novel_views._windows(frames, NovelViews(clip=16, stride=8))
    assert [(window[0], window[-1]) for window in windows] == first_and_last
    assert {len(window) for window in windows} == {16}


class Ball:
    """One red Gaussian that does not move: it looks the same from everywhere."""

    def at(self, time: float) -> Splats:
        one = torch.ones(1)
        return Splats(torch.zeros(1, 3), torch.tensor(((1.0, 0, 0, 0),)), torch.full((1, 3), 0.5), 0.9 * one,
                      torch.tensor((((1.0, 0, 0),),)))  # fmt: skip

    def camera(self, time: float) -> None:
        return None

    def save(self, folder: Path) -> None:
        raise NotImplementedError


def test_the_orbit_closes_around_the_animal_at_the_input_distance(case: Case) -> None:
    inputs = [frame.camera for frame in case.clip.frames if frame.camera is not None]
    up = world_up(case.clip, inputs, case.truth.up)
    cameras = novel_views._cameras(inputs, torch.zeros(3, dtype=torch.float64), up)
    given = torch.stack([camera.center for camera in inputs])
    centers = torch.stack([camera.center for camera in cameras])
    assert len(cameras) == 16
    torch.testing.assert_close(centers.norm(dim=1), given.norm(dim=1).median().expand(16))
    steps = (centers - centers.roll(1, 0)).norm(dim=1)
    assert float(steps.max() - steps.min()) < 1e-9
    # A regular polygon: its side is 2 r sin(pi / 16).
    radius = (centers - centers.mean(0)).norm(dim=1)[0]
    assert float(steps[0]) == pytest.approx(2 * float(radius) * math.sin(math.pi / 16))


@pytest.mark.parametrize("degrees", [0, 20, 40, 90])
def test_the_orbit_of_a_still_camera_keeps_its_elevation(case: Case, degrees: int) -> None:
    up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    high = math.radians(degrees)
    eye = 5 * torch.tensor((0.0, math.sin(high), math.cos(high)), dtype=torch.float64)
    intrinsics = torch.tensor(((300.0, 0, 10), (0, 300, 90), (0, 0, 1)), dtype=torch.float64)  # of a crop
    middle = torch.zeros(3, dtype=torch.float64)
    above = up if degrees < 90 else torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64)
    camera = Camera(look_at(eye, middle, above), intrinsics, 128, 128)
    views = novel_views._cameras([novel_views._centred(camera)], middle, world_up(case.clip, [camera], up))
    elevations = [math.degrees(math.asin(float(view.center[1]) / 5)) for view in views]
    assert elevations == pytest.approx([min(degrees, 80)] * 16)
    for view in views:
        torch.testing.assert_close(view.project(middle[None])[0][0], torch.tensor((64.0, 64.0)).double())


def test_a_ball_against_itself_is_at_distance_zero(case: Case) -> None:
    still = novel_views._Orbit(Ball(), case.clip, 1.0, NovelViews(), None)
    frames = []
    for i, frame in enumerate(case.clip.frames):
        image = still.image(i, i)
        frames.append(replace(frame, rgb=image, mask=torch.ones_like(image[:1])))
    clip: Clip = replace(case.clip, frames=tuple(frames))
    (found,), sets = novel_views.novel_view_distances(
        Ball(), clip, NovelViews(frames=4), names=("kid_v",), background=1.0,
        images=LinearNetwork(), videos=None, log=quiet,
    )  # fmt: skip
    assert found.value == pytest.approx(0, abs=1e-6) and found.n == 16 * min(4, len(frames))
    assert [(one.kind, len(one.prediction.values), len(one.truth.values)) for one in sets] == [
        ("kid_v", found.n, len(frames))
    ]


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
def test_a_nan_at_a_moment_that_is_not_held_out_is_one_sentence(case: Case, name: str) -> None:
    class Broken(Ball):
        def at(self, time: float) -> Splats:
            values = getattr(super().at(time), name).clone()
            values[0] = torch.nan
            return replace(super().at(time), **{name: values})

    with pytest.raises(UserError, match=f"^the reconstruction's {name} at 0.0000 s hold a NaN or an infinite value.$"):
        novel_views.novel_view_distances(
            Broken(), case.clip, NovelViews(frames=2), names=("kid_v",), background=1.0,
            images=LinearNetwork(), videos=None, log=quiet,
        )  # fmt: skip


def test_scores_of_sets_say_how_many_they_are_over() -> None:
    assert novel_views.as_scores([], ["kid_v"], {})["kid_v"] == Score(
        None, "1", "lower", 0, [], "not computed: no network"
    )
