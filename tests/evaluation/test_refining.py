"""GART* on a video: its fit sees no held-out frame; the evaluation then fits poses to them, and every table says so."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from films import PROTOCOL, panned, plan

from rewild4d.baselines.gart_config import GartConfig, GartStarConfig
from rewild4d.baselines.gart_reconstruction import SEEN, GartStarReconstruction
from rewild4d.baselines.gart_skeleton import prior_poses
from rewild4d.cameras.recropping import add_cameras
from rewild4d.cameras.rendering import render
from rewild4d.datasets.video.online import Online
from rewild4d.evaluation.refining import ready_to_score
from rewild4d.leaderboard.tables import markdown
from rewild4d.registry import load_method
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.running.rescoring import score_again
from rewild4d.transforms import transform_splats
from rewild4d.types import Case, Frame, Splats, Truth

pytestmark = pytest.mark.usefixtures("cache", "tiny_footage")

CPU = torch.device("cpu")
TINY: dict[str, Any] = {
    "image_size": 64, "iterations": 20, "canonical": {"samples": 400, "sh_degree": 0}, "resets": {"every": 0.0},
    "skinning": {"resolution": 8, "neighbours": 4, "sweeps": 1},
}  # fmt: skip
REFINE = {"refine": {"steps": 60}}


def quiet(step: int, total: int, values: object) -> None:
    """Log nothing."""


@pytest.fixture(scope="module")
def case() -> Case:
    torch.set_num_threads(1)
    return tiny_case()


@pytest.fixture(scope="module")
def star(case: Case) -> GartStarReconstruction:
    config = msgspec.convert(TINY | {"iterations": 0, "refine": {"steps": 0}}, GartStarConfig)
    clip = case.clip.only([0, 1, 3])
    made = load_method("gart-star").fit(clip, case.prior, config=config, seed=0, device=CPU, log=quiet, workdir=None)
    assert isinstance(made, GartStarReconstruction)
    made.config = msgspec.structs.replace(config, refine=msgspec.convert(REFINE["refine"], type(config.refine)))
    return made


def moved(star: GartStarReconstruction, time: float, case: Case) -> Frame:
    """An image of what the reconstruction has at a moment, lifted by a twentieth of its size."""
    camera = case.clip.frames[2].camera
    assert camera is not None
    splats = star.at(time)
    lift = torch.eye(4, dtype=torch.float64)
    lift[:3, 3] = 0.05 * (splats.means.amax(0) - splats.means.amin(0)).double()
    rgb, alpha = render(transform_splats(splats, lift), camera)
    return Frame(time, camera, rgb, alpha)


def error(splats: Splats, frame: Frame) -> float:
    assert frame.camera is not None
    return float((render(splats, frame.camera)[0] - frame.rgb).square().mean())


def test_a_pose_is_fitted_to_a_moment_in_between_and_to_no_other(star: GartStarReconstruction, case: Case) -> None:
    times = case.clip.times
    frame = moved(star, times[2], case)
    found = star.refined([frame], quiet)
    assert error(found.at(times[2]), frame) < 0.4 * error(star.at(times[2]), frame)
    for row in (0, 1, 3):
        assert torch.equal(found.at(times[row]).means, star.at(times[row]).means)
    assert (found.marks, star.marks) == ((SEEN,), ())
    assert len(star.poses.turns) == 3 and len(found.poses.turns) == 4
    assert torch.equal(star.refined([frame], quiet).at(times[2]).means, found.at(times[2]).means)


def test_moments_behind_the_last_frame_begin_with_its_pose(star: GartStarReconstruction, case: Case) -> None:
    last, later = case.clip.times[3], case.clip.times[3] + 0.1
    frame = moved(star, later, case)
    empty = replace(frame, time=later + 0.1, mask=torch.zeros_like(frame.mask))
    known = replace(frame, time=last)
    found = star.refined([frame, empty, known], quiet)
    assert found.root.times.tolist() == [*star.root.times.tolist(), later]
    assert error(found.at(later), frame) < 0.4 * error(star.at(later), frame)
    assert torch.equal(found.at(last).means, star.at(last).means)


def test_a_table_with_one_frame_more_is_the_same_in_between(case: Case) -> None:
    table = prior_poses(case.prior, [0, 1, 2, 3])
    with torch.no_grad():
        table.turns.normal_(0, 0.1, generator=torch.Generator().manual_seed(0))
        table.shifts.normal_(0, 0.1, generator=torch.Generator().manual_seed(1))
    longer = table.with_frame(2, 1.25)
    torch.testing.assert_close(longer(2), table.between(1.25))
    torch.testing.assert_close(longer(3), table(2))
    torch.testing.assert_close(longer.between(2.5), table.between(1.625), atol=1e-5, rtol=0)


def test_held_out_views_are_never_given(star: GartStarReconstruction, case: Case) -> None:
    """Where the data set knows cameras, what is held out are other views; nobody is asked to fit those."""
    scored, _, truth = ready_to_score(star, case.clip, case.truth, case.clip, quiet)
    assert scored is star and len(truth.held_out) == len(case.truth.held_out)
    clip = replace(case.clip, frames=tuple(replace(frame, camera=None) for frame in case.clip.frames))
    nothing = ready_to_score(star, clip, Truth((), None, ""), clip, quiet)
    assert nothing[0] is star


class Silent(GartStarReconstruction):
    """Keeps quiet about what it saw."""

    def refined(self, frames: Any, log: Any) -> GartStarReconstruction:
        return self


def test_who_looks_must_say_so(star: GartStarReconstruction, case: Case) -> None:
    silent = Silent(star.gaussians, star.weights, star.poses, star.config, star.root)
    held = Truth((replace(case.clip.frames[2], camera=None),), None, "")
    with pytest.raises(ValueError, match=r"Silent\.refined: expected marks that say so, got none\."):
        ready_to_score(silent, case.clip, held, case.clip, quiet)


def test_a_run_says_that_the_row_has_seen_the_test_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = plan(Online(panned(tmp_path / "clip"), fps=10), "clip", tmp_path / "runs")
    settings = (("gart", GartConfig, TINY), ("gart-star", GartStarConfig, TINY | REFINE))
    entries = [runner.Entry(name, "quick", msgspec.convert(given, kind), (0,)) for name, kind, given in settings]
    plain, star = runner.execute(replace(made, entries=tuple(entries)))
    assert (plain.status, star.status) == ("ok", "ok"), (plain.error, star.error)
    assert plain.marks == [] and star.marks == ["poses fitted once more to each input image", SEEN]
    assert SEEN in markdown([plain, star])
    folder = next((tmp_path / "runs").rglob("gart-star-*"))
    # What the fit left is of the shown frames alone; scored again it is refined again.
    saved = load_method("gart-star").load(folder / "reconstruction", CPU)
    assert isinstance(saved, GartStarReconstruction) and len(saved.poses.turns) == 10
    monkeypatch.setattr("rewild4d.running.rescoring.find_protocol", lambda *_: PROTOCOL)
    again = score_again(folder, tmp_path / "clip")
    assert again.scores == star.scores and again.marks == star.marks
    monkeypatch.setattr("rewild4d.running.scoring.ready_to_score", lambda *given: (given[0], *add_cameras(*given[:4])))
    unrefined = score_again(folder, tmp_path / "clip")
    assert SEEN not in unrefined.marks
    seen, unseen = again.scores["psnr"].value, unrefined.scores["psnr"].value
    assert seen is not None and unseen is not None and seen > unseen
