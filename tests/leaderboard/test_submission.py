"""Bundles of runs: what is inside, what is found in a changed one, and the board with an added one."""

import json
import shutil
import stat
import zipfile
from pathlib import Path
from typing import Any

import pytest
from bundles import PROTOCOL, WHO, Change, TwoCases, changed, in_record, run_folder, tiny_runs
from calling import call, output, refusal
from PIL import Image
from records_for_tests import psnr as psnr_of
from records_for_tests import record

from rewild4d.commands.spot_checks import differences
from rewild4d.leaderboard.records import FILE, find_records
from rewild4d.leaderboard.submission import SUBMISSION, lacking
from rewild4d.metrics.score import Score

pytestmark = pytest.mark.usefixtures("one_thread")

ROW = 'ours [--prior="prior.npz"]'
OURS = f"{PROTOCOL}/tiny__walk/ours-quick-seed0-"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, one_thread: None) -> Path:
    return tiny_runs(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def bundle(runs: Path) -> Path:
    """A bundle with predictions."""
    out = runs.parent / "bundle.zip"
    assert call("leaderboard", "submit", runs, "--out", out, *WHO, "--predictions") == 0
    return out


@pytest.fixture
def tiny_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """The data set is the one that the runs were made on."""
    monkeypatch.setattr("rewild4d.running.rescoring.load_dataset", lambda _: TwoCases)


def findings(capsys: pytest.CaptureFixture[str], path: Path, *words: object) -> list[str]:
    """What `verify` finds, without the name of the bundle."""
    said = refusal(capsys, "leaderboard", "verify", path, *words)
    start = f"rewild4d-bench: {path}: "
    return [line.removeprefix(start) for line in said.splitlines() if line.startswith(start)]


def test_a_bundle_is_verified_and_says_what_was_not(bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = output(capsys, "leaderboard", "verify", bundle).splitlines()
    assert "2 runs, 2 of them with predictions" in said[0] and "SHA-256" in said[0]
    assert {line.partition(": ")[0] for line in said[1:]} == {"verified", "not verified"}
    for line in (
        "verified: 2 records, in the layout of schema 1",
        "verified: given by Jane Doe on 2026-11-28 under CC BY 4.0",
        "verified: settings of 1 protocol, names of 1 method: as they are here",
        "verified: 3 pictures and films: can be decoded, of open data",
        "verified: every method has all cases that the submission names",
        "not verified: scores: none was computed again (--data names the data for it)",
        "not verified: that the pictures show these runs: look at them",
    ):
        assert line in said


def test_a_bundle_holds_records_small_pictures_and_predictions(bundle: Path, runs: Path) -> None:
    archive = zipfile.ZipFile(bundle)
    names = {Path(name).name for name in archive.namelist() if name.startswith(OURS)}
    assert names == {FILE, "comparison.webp", "orbit.mp4", "ours.pt", "config.json"}
    assert not any(str(runs.parent).encode() in archive.read(name) for name in archive.namelist())
    assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    said = json.loads(archive.read(SUBMISSION))
    (run,) = (run for run in said["runs"] if run["folder"].startswith(OURS))
    record = json.loads(archive.read(f"{run['folder']}/{FILE}"))
    assert run["digests"] == {
        "code": record["code"]["sources"], "protocol": record["protocol"]["digest"], "clip": record["data"]["clip"],
        "truth": record["data"]["truth"], **{f"network {name}": sha for name, sha in record["networks"].items()},
    }  # fmt: skip


def test_the_same_runs_give_the_same_bytes(bundle: Path, runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs, tmp_path / "elsewhere")
    (tmp_path / "about.toml").write_text('name = "Jane Doe"\nlicence = "CC BY 4.0"\ntitle = "T"\ndate = "2026-11-28"\n')
    words = ("--about", tmp_path / "about.toml", "--title", "Two walks", "--predictions")
    assert call("leaderboard", "submit", tmp_path / "elsewhere", "--out", tmp_path / "again.zip", *words) == 0
    assert (tmp_path / "again.zip").read_bytes() == bundle.read_bytes()


def test_predictions_are_scored_again(bundle: Path, tiny_data: None, capsys: pytest.CaptureFixture[str]) -> None:
    said = output(capsys, "leaderboard", "verify", bundle, "--data", bundle.parent, "--sample", "1")
    assert said.count(" scores came out again, within 0.01 dB, 0.1 % of other scores") == 1
    assert "verified: every method has all cases of the data here" in said
    assert "not verified: scores of 1 run: no predictions inside, failed, or not in the sample" in said


def test_forged_scores_are_not_those_of_the_predictions(
    bundle: Path, tmp_path: Path, tiny_data: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Means and items fit together, and all digests are right."""

    def better(scores: dict[str, Any]) -> dict[str, Any]:
        psnr = scores["psnr"]
        raised = {"value": psnr["value"] + 1, "per_item": [item + 1 for item in psnr["per_item"]]}
        return scores | {"psnr": psnr | raised}

    def forge(folder: Path) -> None:
        in_record(scores=better)(folder)
        for saved in folder.rglob("reconstruction"):
            if saved.parent != run_folder(folder):
                shutil.rmtree(saved)

    forged = changed(bundle, tmp_path / "forged.zip", forge, redone=True)
    assert call("leaderboard", "verify", forged) == 0, "nothing else can tell"
    capsys.readouterr()
    (finding,) = findings(capsys, forged, "--data", bundle.parent)
    assert finding.startswith(OURS) and ": psnr: its record says " in finding
    assert finding.endswith("expected at most 0.01 between them.")


def test_a_verified_bundle_is_on_the_board(bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results, page = tmp_path / "results", tmp_path / "page"
    assert "added: " in output(capsys, "leaderboard", "add", bundle, "--results", results)
    kept = find_records(results / "bundle")
    assert [record.method for _, record in kept] == ["ours", "ours"]
    assert not list(results.rglob("reconstruction")) and (results / "bundle" / SUBMISSION).is_file()
    output(capsys, "leaderboard", "build", "--runs", results / "bundle", "--out", page)
    text = (page / "index.html").read_text()
    assert "Two walks (submitted by Jane Doe, 2026-11-28, CC BY 4.0; as submitted, none reproduced)" in text
    for place, one in kept:
        assert one.run_id in text
        assert (page / "runs" / one.run_id / "comparison.webp").read_bytes() == (place / "comparison.webp").read_bytes()


def test_a_bad_bundle_is_not_added(bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = changed(bundle, tmp_path / "bad.zip", in_record(seed=-1))
    assert "its SHA-256 is another" in refusal(capsys, "leaderboard", "add", bad, "--results", tmp_path / "results")
    assert not list((tmp_path / "results").iterdir())


def other_picture(folder: Path) -> None:
    Image.new("RGB", (8, 8), "red").save(run_folder(folder) / "comparison.webp")


def test_a_change_is_found_by_its_digest(bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def score(scores: dict[str, Any]) -> dict[str, Any]:
        return scores | {"ssim": scores["ssim"] | {"value": 0.99}}

    found = findings(capsys, changed(bundle, tmp_path / "a.zip", in_record(scores=score)))
    assert any(f"{FILE}' is not the file that was submitted: its SHA-256 is another." in line for line in found)
    (finding,) = findings(capsys, changed(bundle, tmp_path / "b.zip", other_picture))
    assert finding.endswith("/comparison.webp' is not the file that was submitted: its SHA-256 is another.")
    lost = changed(bundle, tmp_path / "c.zip", lambda folder: (run_folder(folder) / "orbit.mp4").unlink())
    (finding,) = findings(capsys, lost)
    assert finding.endswith(f"/orbit.mp4' is missing: {SUBMISSION} names it.")


def stray(folder: Path) -> None:
    (run_folder(folder) / "notes.txt").write_text("a note")


def no_run(folder: Path) -> None:
    shutil.rmtree(run_folder(folder))


def no_image(folder: Path) -> None:
    (run_folder(folder) / "comparison.webp").write_bytes(b"RIFF")


def more_than_an_image(folder: Path) -> None:
    path = run_folder(folder) / "comparison.webp"
    image = Image.open(path)
    image.load()
    image.save(path, exif=b"Exif\0\0and a text")


def path_inside(folder: Path) -> None:
    path = run_folder(folder) / "reconstruction" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "file": "/home/jane/animals/a.ply"}))


def who(**fields: str) -> Change:
    def change(folder: Path) -> None:
        said = json.loads((folder / SUBMISSION).read_text())
        (folder / SUBMISSION).write_text(json.dumps({**said, "about": {**said["about"], **fields}}))

    return change


def protocol(**fields: Any) -> Change:
    return in_record(protocol=lambda given: given | fields)


def psnr(**fields: Any) -> Change:
    return in_record(scores=lambda scores: scores | {"psnr": scores["psnr"] | fields})


def data(**fields: str) -> Change:
    return in_record(data=lambda given: given | fields)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (psnr(value=50.0), "psnr: the mean of its 3 values is "),
        (psnr(value=101.0, per_item=[101.0] * 3), "psnr: expected values from 0 to 100, got 101."),
        (psnr(value=None), "psnr: no value, and no note that says why."),
        (psnr(floor=1.0), " is better than what a perfect result would get, 1."),
        (in_record(scores={}), "expected the scores of its protocol and no others; of one alone: "),
        (in_record(seed=-1), "expected a seed from 0 to 2^63 - 1, got -1."),
        (in_record(method="our"), "unknown method 'our'. Did you mean 'ours'?"),
        (protocol(name="artemis-sweep-128-v9"), "unknown protocol 'artemis-sweep-128-v9'. Did you mean "),
        (protocol(background=0.0), f"expected the settings of protocol '{PROTOCOL}' as they are here, got others."),
        (in_record(dataset="davis"), "is for the data set 'artemis', not for 'davis'."),
        (in_record(networks={"lpips_alex": "0" * 64}), "expected the weights of lpips_alex that are known here, got"),
        (in_record(prior=lambda given: given | {"choice": "rig"}), "expected the mark 'upper bound: its prior"),
        (data(root="/home/jane/animals"), "expected no path of a machine, got '/home/jane/animals'."),
        (data(licence="CC BY-NC 4.0"), "expected no pictures of data that may not be passed on ('CC BY-NC 4.0')."),
        (path_inside, "reconstruction/config.json': expected no path of a machine, got '/home/jane/animals/a.ply'."),
        (who(licence="CC BY-NC 4.0"), "licence: expected one that allows to pass things on"),
        (who(date="yesterday"), "date: expected a date as 2026-01-31, got 'yesterday'."),
        (who(title="Other"), "collection.json: expected the title that submission.json has."),
        (stray, "notes.txt' is a stray file: it belongs to no run."),
        (no_run, f"{PROTOCOL}, {ROW}, seed 0: 1 of 2 cases; missing: tiny/walk."),
        (no_image, "comparison.webp: expected a picture, got a damaged one"),
        (more_than_an_image, "comparison.webp: expected an image and nothing else, got more."),
        (in_record(extra=1), "record.json: expected a run record of schema 1, but Object contains unknown field"),
    ],
)  # fmt: skip
def test_a_forgery_with_right_digests_is_found(
    change: Change, sentence: str, bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = findings(capsys, changed(bundle, tmp_path / "forged.zip", change, redone=True))
    assert any(sentence in line for line in found), found
    assert not any(str(tmp_path) in line for line in found), "files are named as the bundle names them"


def test_a_record_that_is_missing_is_named(bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = findings(capsys, changed(bundle, tmp_path / "a.zip", no_run))
    assert any(line.startswith(f"'{OURS}") and line.endswith("names that run.") for line in found)


def test_what_comes_out_again_may_differ_in_its_last_digits() -> None:
    said = record(scores={**psnr_of(20.0), "iou": Score(0.5, "1", "higher", 1, [0.5])})

    def again(decibels: float, iou: float) -> list[str]:
        return differences(said, record(scores={**psnr_of(decibels), "iou": Score(iou, "1", "higher", 1, [iou])}))

    assert again(20.0 + 0.009, 0.5 + 0.0004) == []
    assert again(20.0 - 0.011, 0.5) == [
        "psnr: its record says 20, but its predictions score 19.989; expected at most 0.01 between them."
    ]
    assert again(20.0, 0.5 * (1 + 0.002)) == [
        "iou: its record says 0.5, but its predictions score 0.501; expected at most 0.0005 between them."
    ]
    there = record(scores={**said.scores, "strangeness": Score(7.0, "px", "", 1)})
    assert differences(there, said) == [], "its package is not here"
    marked = record(scores=said.scores, marks=["upper bound: it saw more"])
    assert differences(said, marked) == ["expected the mark 'upper bound: it saw more', got none."]


def test_seeds_and_cases_that_lack_are_counted() -> None:
    there = [("a", 0), ("b", 0), ("c", 0), ("a", 1), ("a", 2)]
    runs = [record(case=case, seed=seed, run_id=f"{case}{seed}") for case, seed in there]
    floor = record(case="a", method="empty")
    assert lacking([*runs, floor], {"p-v1": ["a", "b", "c", "d"]}) == [
        "p-v1, ours, seed 0: 3 of 4 cases; missing: d.",
        "p-v1, ours, seeds 1, 2: 1 of 4 cases; missing: b, c, d.",
    ]
    assert lacking(runs[:3], {}) == [] and lacking([floor], {"p-v1": ["a", "b"]}) == []


def test_who_lacks_cases_may_say_why(
    bundle: Path, runs: Path, tmp_path: Path, tiny_data: None, capsys: pytest.CaptureFixture[str]
) -> None:
    one, out = runs / PROTOCOL / "tiny__walk", tmp_path / "one.zip"
    sentence = f"{PROTOCOL}, {ROW}, seed 0: 1 of 2 cases; missing: tiny/trot"
    assert f"{out}: {sentence}." in refusal(capsys, "leaderboard", "submit", one, "--out", out, *WHO)
    assert not out.exists()
    output(capsys, "leaderboard", "submit", one, "--out", out, *WHO, "--partial", "it is about walking")
    said = output(capsys, "leaderboard", "verify", out)
    assert f"not verified: {sentence} (said: it is about walking)" in said


def test_a_licence_of_the_data_keeps_pictures_out(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    for path in (tmp_path / "runs").rglob(FILE):
        path.write_text(path.read_text().replace('"licence": "CC0 1.0"', '"licence": "CC BY-NC 4.0"'))
    output(capsys, "leaderboard", "submit", tmp_path / "runs", "--out", tmp_path / "a.zip", *WHO)
    names = zipfile.ZipFile(tmp_path / "a.zip").namelist()
    assert {Path(name).suffix for name in names} == {".json"}
    assert call("leaderboard", "verify", tmp_path / "a.zip") == 0


def test_what_a_person_gets_wrong_is_one_sentence(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "about.toml").write_text('nmae = "Jane"\n')
    good = ("leaderboard", "submit", runs, "--out", tmp_path / "a.zip")
    for words, sentence in (
        (good, "--name: expected a text, got none."),
        ((*good, *WHO, "--licence", "all rights reserved"), "--licence: expected one that allows to pass things on"),
        ((*good, *WHO, "--contact", "/home/jane"), "--contact: expected no path of a machine, got '/home/jane'."),
        (
            (*good, "--about", tmp_path / "about.toml"),
            "expected only name, licence, date, title, contact, url, partial",
        ),
        ((*good[:-1], tmp_path / "a.tar", *WHO), "a.tar: expected the name of a .zip file."),
        (("leaderboard", "submit", tmp_path / "no", *good[3:], *WHO), "no: expected a folder of runs, but there is no"),
        (("leaderboard", "submit", tmp_path, *good[3:], *WHO), "expected run records, found none."),
        (("leaderboard", "submit", *good[3:], *WHO), "expected the folder of at least one run, got none."),
        (
            ("leaderboard", "verify", tmp_path / "no.zip"),
            "no.zip: expected a bundle as `leaderboard submit` writes it, ",
        ),
        (
            ("leaderboard", "verify", tmp_path / "about.toml"),
            "but it is cut off, goes on behind its end, or is another file.",
        ),
    ):
        assert sentence in refusal(capsys, *words)
    assert [path.name for path in tmp_path.iterdir()] == ["about.toml"]


def test_predictions_with_a_path_or_a_link_are_not_submitted(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    words = ("leaderboard", "submit", tmp_path / "runs", "--out", tmp_path / "a.zip", *WHO, "--predictions")
    path = run_folder(tmp_path / "runs") / "reconstruction" / "config.json"
    whole = path.read_text()
    path.write_text(json.dumps({"file": "/home/jane doe/a.ply"}))
    assert "got '/home/jane doe/a.ply'; leave --predictions out" in refusal(capsys, *words)
    path.unlink()
    (tmp_path / "secret").write_text(whole)
    path.symlink_to(tmp_path / "secret")
    assert "config.json: expected a file inside" in refusal(capsys, *words)
    assert not (tmp_path / "a.zip").exists()
    assert stat.S_ISLNK(path.lstat().st_mode)
