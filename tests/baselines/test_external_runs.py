"""Programs of others as runs: the written clip, failures and marks in records, settings, resuming."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from artemis_animals import write_animal
from external_program import CPU, UPPER, a_plan, bodies, fit, settings

from rewild4d import cli
from rewild4d.baselines.external import External, ExternalConfig
from rewild4d.baselines.external_folder import crop_box, program_digest, write_clip
from rewild4d.errors import UserError
from rewild4d.leaderboard.tables import standings
from rewild4d.priors.io import load_prior
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

pytestmark = pytest.mark.usefixtures("coarse_grid")


FAILURES = {
    "crash": r"ended with status 3; its last words: 'CUDA out of memory' \(log: .*program.log\)",
    "nothing": r"out: expected files frame_\*.ply or frame_\*.obj, found none",
    "half": r"expected 3 files frame_\*.ply or frame_\*.obj, one a frame, found 2; the first that is missing is 1",
    "nan": r"frame_0001.ply: expected finite x to z, got a NaN or an infinite value in vertex 5",
    "empty": r"frame_0000.ply: expected Gaussians, got none",
    "cut": r"frame_0000.ply: expected 4000 rows of 'vertex', but the file ends before",
    "huge": r"frame_0000.ply: expected scales \(.*\) of at most 1e\+06, got 1.65e\+38 in vertex 0",
}


@pytest.mark.parametrize("what", FAILURES)
def test_a_failure_is_one_sentence_and_a_failed_record(case: Case, tmp_path: Path, what: str) -> None:
    (record,) = runner.execute(a_plan(case, tmp_path, settings(tmp_path, what, bodies(case))))
    assert record.status == "failed" and record.scores == {}
    assert re.search(FAILURES[what], record.error), record.error
    assert "\n" not in record.error


def test_an_answer_with_gaps_is_not_spread_over_the_clip(case: Case, tmp_path: Path) -> None:
    config = settings(tmp_path, "half", bodies(case), profile="gvfdiffusion", placed="yes")
    (record,) = runner.execute(a_plan(case, tmp_path, config))
    assert record.status == "failed" and record.error.endswith("found 2; the first that is missing is 1.")


def test_a_record_carries_the_mark_and_the_table_does_not_rank_it(case: Case, tmp_path: Path) -> None:
    for index, body in enumerate(bodies(case)):
        (tmp_path / "theirs").mkdir(exist_ok=True)
        lines = [f"v {x} {y} {z}" for x, y, z in body["vertices"]]
        lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in body["faces"]]
        (tmp_path / "theirs" / f"frame_{index:04d}.obj").write_text("\n".join(lines))
    folder = str(tmp_path / "theirs")
    entries = [ExternalConfig(folder=folder, points=1000, program="theirs"),
               ExternalConfig(folder=folder, points=1000, program="rotated", placed="no", up="y")]  # fmt: skip
    plan = a_plan(case, tmp_path, *entries)
    as_is, rotated = runner.execute(plan)
    assert (as_is.status, as_is.marks) == ("ok", []) and as_is.diagnostics["program"] == "theirs"
    assert rotated.marks == [UPPER]
    (table,) = standings([as_is, rotated])
    assert {row.kind for row in table.rows} == {"method", "unranked"}
    assert table.notes == tuple(rotated.marks)
    # Another file in the folder is another run; the same ones are the same run.
    first = plan.entries[0]
    assert runner.list_jobs(replace(plan, entries=(first,)))[0].run_id == as_is.run_id
    (tmp_path / "theirs" / "frame_0000.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert runner.list_jobs(replace(plan, entries=(first,)))[0].run_id != as_is.run_id


def test_a_program_is_scored_on_footage_whose_cameras_nobody_knows(tmp_path: Path) -> None:
    """The frame between the two that it got is held out, and rendered from a camera between theirs."""
    case = tiny_case(frames=3, views=120)
    first, middle, last = (replace(frame, camera=None) for frame in case.clip.frames)
    footage = replace(
        case,
        clip=replace(case.clip, frames=(first, last)),
        truth=replace(case.truth, held_out=[replace(middle, view="input")]),
    )
    content = bodies(case)
    (record,) = runner.execute(a_plan(footage, tmp_path, settings(tmp_path, "plain", [content[0], content[2]])))
    assert record.status == "ok", record.error
    assert record.scores["psnr"].count == 1 and (record.scores["psnr"].value or 0) > 20


def program(path: Path, *, of: str, edge: str = "1") -> ExternalConfig:
    """A script that writes three triangles with two edges of some length and notes that it ran."""
    path.write_text(
        f"import sys\nfrom pathlib import Path\nopen('{path.parent}/runs.txt', 'a').write('{of} ')\n"
        f"for i in range(3):\n    (Path(sys.argv[2]) / f'frame_{{i:04d}}.obj').write_text("
        f"'v 0 0 0\\nv {edge} 0 0\\nv 0 {edge} 0\\nf 1 2 3\\n')\n"
    )
    return ExternalConfig(command=f"{sys.executable} {path} {{clip}} {{out}}", points=200, timeout=60.0)


def test_a_mended_program_is_run_again(case: Case, tmp_path: Path) -> None:
    """Its output was bad, so the same settings start it anew, whether or not its file is named."""
    (tmp_path / "work").mkdir()
    config = program(tmp_path / "a.py", of="bad", edge="nan")
    with pytest.raises(UserError, match="expected finite coordinates"):
        fit(case, config, tmp_path / "work")
    program(tmp_path / "a.py", of="good")
    assert len(fit(case, config, tmp_path / "work").at(0.0)) == 200
    fit(case, config, tmp_path / "work")
    assert (tmp_path / "runs.txt").read_text() == "bad good "


def test_an_edited_program_is_another_run(case: Case, tmp_path: Path) -> None:
    plan = a_plan(case, tmp_path, program(tmp_path / "a.py", of="first"))
    (first,) = runner.execute(plan)
    assert runner.execute(plan) == [first]
    program(tmp_path / "a.py", of="second", edge="2")
    (second,) = runner.execute(plan)
    assert (tmp_path / "runs.txt").read_text() == "first second "
    assert first.run_id != second.run_id and {first.status, second.status} == {"ok"}


def test_the_files_that_a_command_names(tmp_path: Path) -> None:
    for name in ("run.py", "a.json", "tiny__walk.toml", "x y.sh"):
        (tmp_path / name).write_text(name)
    words = [f"python {tmp_path}/run.py", f"--config={tmp_path}/a.json", f"bash -c '{tmp_path}/{{case}}.toml --fast'",
             f"'{tmp_path}/x y.sh'"]  # fmt: skip
    command = " ".join([*words, "{clip} {out}"])
    found = [program_digest(command, "tiny__walk")]
    for name in ("run.py", "a.json", "tiny__walk.toml", "x y.sh"):
        (tmp_path / name).write_text("edited")
        found.append(program_digest(command, "tiny__walk"))
    assert len(set(found)) == 1 + 4
    assert program_digest("theirs {clip} {out}", "tiny__walk") == program_digest("'theirs {clip}", "tiny__walk") == ""


FOLDERS = "--command: expected {clip} and {out} for the two folders among its words"
NAMES = "--command: expected words with {clip}, {out}, {case} or {seed}"
WHOLE = "--command: expected whole words and braces"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"command": ""}, "external: expected either --command (a program to run) or --folder (its results)"),
        ({"folder": "x"}, "external: expected either --command (a program to run) or --folder (its results)"),
        ({"profile": "dreammesh"}, "unknown profile 'dreammesh'. Did you mean 'dreammesh4d'?"),
        ({"command": "prog {clip}"}, FOLDERS),
        ({"command": "prog {{clip}} {out}"}, FOLDERS),
        *(
            ({"command": f"prog {{clip}} {{out}} {word}"}, f"{NAMES}, got 'prog {{clip}} {{out}} {word}'")
            for word in ("{what}", "{}", "{clip.x}", "{clip[a]}", "{clip[0]}", "{clip!r}", "{clip:999999999999}")
        ),
        ({"command": "prog {clip} '{out}"}, f"{WHOLE}, got 'prog {{clip}} '{{out}}': No closing quotation"),
        ({"command": "prog {clip} {out"}, f"{WHOLE}, got 'prog {{clip}} {{out': expected '}}' before end of string"),
        ({"command": "/no/such/program {clip} {out}"}, "that can be started, but '/no/such/program': No such file"),
        (
            {"command": "", "folder": "/no/such/{case}"},
            "/no/such/tiny__walk: expected the folder of a program's results",
        ),
    ],
)
def test_bad_settings_are_one_sentence(case: Case, tmp_path: Path, changes: dict[str, str], sentence: str) -> None:
    with pytest.raises(UserError, match=re.escape(sentence)):
        fit(case, settings(tmp_path, "plain", [], **changes))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "external: expected either --command"),
        (["--command", "prog {clip}"], FOLDERS),
        (["--command", "/no/such/program {clip} {out}"], "that can be started, but '/no/such/program': No such file"),
        (["--folder", "/no/such/{case}"], "expected the folder of a program's results, but there is no such folder"),
        (["--folder", "/tmp", "--profile", "dreammesh"], "unknown profile 'dreammesh'. Did you mean 'dreammesh4d'?"),
    ],
)
def test_settings_that_suit_no_case_end_a_run_before_it_begins(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], sentence: str
) -> None:
    data = write_animal(tmp_path / "cat")
    run = ["run", "--method", "external", "--dataset", "artemis", "--data", str(data), "--out", str(tmp_path / "runs")]
    with pytest.raises(SystemExit) as stop:
        cli.main([*run, *words])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and sentence in err and len(err.strip().splitlines()) == 1
    assert not list((tmp_path / "runs").rglob("*.*"))


def test_a_program_that_does_not_end_is_ended(case: Case, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected an end within 1 s, but it was still running"):
        fit(case, settings(tmp_path, "hang", [], timeout=1.0))


def test_an_empty_mask_is_said_before_the_program_runs(case: Case, tmp_path: Path) -> None:
    frames = (replace(case.clip.frames[0], mask=torch.zeros_like(case.clip.frames[0].mask)), *case.clip.frames[1:])
    other = replace(case, clip=replace(case.clip, frames=frames))
    with pytest.raises(UserError, match="expected an animal in every frame, but a mask is empty"):
        fit(other, settings(tmp_path, "crash", []))


def test_a_program_that_has_run_to_its_end_is_not_run_again(case: Case, tmp_path: Path) -> None:
    config = settings(tmp_path, "plain", bodies(case))
    (tmp_path / "work").mkdir()
    once = fit(case, config, tmp_path / "work")
    (tmp_path / "plain.json").write_text("damaged")
    again = fit(case, config, tmp_path / "work")
    assert torch.equal(once.at(0.0).means, again.at(0.0).means)
    with pytest.raises(UserError, match="ended with status 1"):
        fit(replace(case, clip=replace(case.clip, digest="other")), config, tmp_path / "work")


def test_saved_and_loaded_it_gives_the_same_gaussians(case: Case, tmp_path: Path) -> None:
    found = fit(case, settings(tmp_path, "sh1", bodies(case)))
    found.save(tmp_path)
    loaded = External().load(tmp_path, CPU)
    assert (loaded.times, loaded.marks, loaded.notes) == (found.times, found.marks, found.notes)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(loaded.at(0.1), name), getattr(found.at(0.1), name))
    first, second = case.clip.frames[0].camera, case.clip.frames[1].camera
    assert first is not None and second is not None
    # Between two frames the camera lies between theirs, and after the last frame it stays.
    for time, expected in ((0.0, first), (0.1, second), (17.0, case.clip.frames[2].camera)):
        assert expected is not None
        assert torch.equal(loaded.camera(time).world_to_camera, expected.world_to_camera)  # type: ignore[union-attr]
    between = loaded.camera(0.05)
    assert between is not None and between.width == 96
    torch.testing.assert_close(between.intrinsics, (first.intrinsics + second.intrinsics) / 2)


def test_the_written_clip_is_the_clip(case: Case, tmp_path: Path) -> None:
    import cv2

    write_clip(tmp_path, case.clip, case.prior, crops=True)
    about = json.loads((tmp_path / "clip.json").read_text())
    assert (about["name"], about["fps"], len(about["frames"])) == ("tiny/walk", 10.0, 3)
    frame, told = case.clip.frames[2], about["frames"][2]
    assert frame.camera is not None
    assert told["time"] == frame.time
    assert told["camera"]["world_to_camera"] == frame.camera.world_to_camera.tolist()
    white = cv2.imread(str(tmp_path / told["frame"]))[..., ::-1] / 255
    assert np.abs(white - frame.over(1.0).permute(1, 2, 0).numpy()).max() < 1 / 255
    rgba = cv2.imread(str(tmp_path / told["rgba"]), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]] / 255
    assert np.abs(rgba[..., :3] * rgba[..., 3:] - frame.rgb.permute(1, 2, 0).numpy()).max() < 2.5 / 255
    assert torch.equal(load_prior(tmp_path / "prior.npz").transforms, case.prior.transforms)
    left, top, side = crop_box(frame.mask)
    assert (tmp_path / "crops" / "0002_box.txt").read_text().split() == [
        "2", f"{left:g}", f"{top:g}", f"{side:g}", f"{side:g}", "96", "64", "1",
    ]  # fmt: skip
    crop = cv2.imread(str(tmp_path / "crops" / "0002_mask.png"), 0)
    assert crop.shape == (256, 256)
    share = float(frame.mask.sum()) / side**2
    assert crop.mean() / 255 == pytest.approx(share, abs=0.02)
