"""Collected records: small, without paths, complete enough for the tables and the page; licences and budgets kept."""

import json
import re
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import msgspec
import numpy as np
import pytest
from calling import call
from records_for_tests import PROTOCOL, psnr, record

from rewild4d.errors import UserError
from rewild4d.leaderboard import collect as module
from rewild4d.leaderboard.collect import MARKER, collect, per_moment, rounded, title_of
from rewild4d.leaderboard.curves import moments
from rewild4d.leaderboard.privacy import last_part, without_paths
from rewild4d.leaderboard.records import FILE, RunRecord, find_records, write_record
from rewild4d.metrics.score import Score

OPEN = {"licence": "CC0 1.0 (made by rewild4d)", "root": "/home/jane doe/animals/zoo"}
LIMIT = 15_000_000
ITEMS = [f"view {view} at {time:.4f} s" for time in (0.0, 0.5) for view in (1, 2)]


def kept_records(folder: Path) -> list[RunRecord]:
    return [record for _, record in find_records(folder / "kept")]


def keep(folder: Path, seed: int, drawn: bool = True, **changes: Any) -> RunRecord:
    """A run of four images as the runner leaves it, with large pictures and things that nobody should commit."""
    scores = {"psnr": Score(20.123456789, "dB", "higher", 4, [10.12345, 20.0, None, 30.0])}
    fields: dict[str, Any] = {
        "run_id": f"{seed:016d}", "seed": seed, "scores": scores, "items": ITEMS, "data": OPEN,
        "pictures": ["comparison.png", "input.mp4", "orbit.mp4", "canonical.png"],
    }  # fmt: skip
    made = record(**{**fields, **changes})
    write_record(made, folder)
    for name in ("log.jsonl", "fit.json", "input.mp4", "reconstruction/splats.pt"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x" * 1000)
    if drawn:
        noise = np.random.default_rng(seed).integers(0, 255, (40, 128, 3), np.uint8)
        imageio.imwrite(folder / "comparison.png", noise.repeat(16, 0).repeat(16, 1))
        noisy = [np.random.default_rng(i).integers(0, 255, (48, 64, 3), np.uint8) for i in range(30)]
        imageio.mimwrite(folder / "orbit.mp4", noisy, fps=10, codec="libx264", ffmpeg_log_level="error")  # type: ignore[call-arg]
    return made


def files(folder: Path) -> dict[str, list[str]]:
    """Folder of each run -> its files."""
    return {path.parent.name: sorted(each.name for each in path.parent.iterdir()) for path in folder.rglob(FILE)}


def test_only_what_a_page_needs_is_kept(tmp_path: Path) -> None:
    for seed in (1, 2):
        keep(tmp_path / "runs" / str(seed), seed)
    made = collect(find_records(tmp_path / "runs"), tmp_path / "kept", title="Wolves", limit=LIMIT)
    assert files(tmp_path / "kept") == {
        "ours-quick-seed1-00000000": ["comparison.webp", "orbit.mp4", FILE], "ours-quick-seed2-00000000": [FILE],
    }  # fmt: skip
    assert (made.runs, made.pictured, made.remarks) == (2, 1, [])
    assert made.size == sum(path.stat().st_size for path in (tmp_path / "kept").rglob("*") if path.is_file())
    first, second = kept_records(tmp_path)
    assert (first.pictures, second.pictures) == (["comparison.webp", "orbit.mp4"], [])
    picture = imageio.imread(next((tmp_path / "kept").rglob("comparison.webp")))
    assert picture.shape == (round(640 * 960 / 2048), 960, 3)
    assert title_of(tmp_path / "kept") == "Wolves" and title_of(tmp_path / "runs") == "runs"
    about = json.loads((tmp_path / "kept" / MARKER).read_text())
    assert (about["runs"], about["with_pictures"]) == (2, 1)


def test_a_damaged_collection_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep(tmp_path / "runs" / "1", 1, drawn=False)
    for text, reason in (
        ("{", "Input data was truncated"), ("{}", "Object missing required field `title`"), ("[]", "Expected `object`"),
        ('{"title": 5}', "Expected `str`, got `int`"),
    ):  # fmt: skip
        (tmp_path / "runs" / MARKER).write_text(text)
        with pytest.raises(UserError, match=f"collection.json: expected the title of a collection, but {reason}"):
            title_of(tmp_path / "runs")
    assert call("leaderboard", "build", "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "page")) == 2
    assert "expected the title of a collection" in capsys.readouterr().err and not (tmp_path / "page").exists()


def test_means_stay_and_items_are_shortened(tmp_path: Path) -> None:
    for seed in (1, 2):
        keep(tmp_path / "runs" / str(seed), seed, drawn=False)
    collect(find_records(tmp_path / "runs"), tmp_path / "kept", title="", limit=LIMIT)
    first, second = (made.scores["psnr"] for made in kept_records(tmp_path))
    assert (first.value, first.count, first.per_item) == (20.123456789, 4, [10.12, 20.0, None, 30.0])
    assert (second.value, second.count, second.per_item) == (20.123456789, 4, [round((10.12345 + 20) / 2, 2), 30.0])


def test_a_curve_over_time_is_the_same_after_averaging() -> None:
    scores = {
        "psnr": Score(0.0, "dB", "higher", 4, [1.0, 3.0, None, 5.0]),
        "cd": Score(0.0, "1", "lower", 2, [7.0, 8.0]),
    }
    whole = record(items=ITEMS, scores=scores)
    small = per_moment(whole)
    assert small.items == ["mean of 2 views at 0.0000 s", "mean of 2 views at 0.5000 s"]
    assert moments(small.scores["psnr"], small.items) == [(0.0, [(1.0 + 3.0) / 2]), (0.5, [5.0])]
    assert small.scores["cd"] == scores["cd"]
    assert moments(small.scores["cd"], small.items) == moments(scores["cd"], ITEMS) == [(0.0, [7.0]), (0.5, [8.0])]
    one_view = record(items=ITEMS[::2], scores={"psnr": Score(0.0, "dB", "higher", 2, [1.0, 2.0])})
    assert per_moment(one_view) == one_view and per_moment(record()) == record()
    assert rounded(record(scores=psnr(0.000123456))).scores["psnr"].per_item == [0.0001235]


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("/tmp/rw", "rw"),
        ("/home/jane doe/my animals/zoo", "zoo"),
        ("/home/jane", "~"),
        ("~jane/zoo", "zoo"),
        (r"C:\Users\jane\zoo", "zoo"),
        ("/home/jane/x.png: expected a mask, got 'a/b'.", "x.png: expected a mask, got 'a/b'."),
        ("python /home/jane/theirs.py {clip} {out}", "python theirs.py {clip} {out}"),
        ("/usr/bin/python /home/jane/theirs.py {clip}", "python theirs.py {clip}"),
        ('{"masks": "/home/jane/masks"}', '{"masks": "masks"}'),
        ("masks of the input from /home/jane/m; 2 are empty", "masks of the input from m; 2 are empty"),
        ("file:///home/jane/secret/x.ply", "x.ply"),
        ("file:///home/jane", "~"),
        ("see file:///home/jane, then", "see ~, then"),
        ("PYTHONPATH=/home/jane/a:/home/jane/b python x.py", "PYTHONPATH=a:b python x.py"),
        ("ssh host:/home/jane/x", "ssh host:x"),
        ("cc -I/home/jane/inc -o/home/jane/out x.c", "cc -Iinc -oout x.c"),
        ("-I/home/jane/inc", "-Iinc"),
        (r"\\server\share\jane\x", "x"),
        (r"read \\server\share\jane\x twice", "read x twice"),
        ("//nas/jane/data", "data"),
        ("see https://a.org/home/b/c, /home/jane/d", "see https://a.org/home/b/c, d"),
        ("the -x/y plane", "the -x/y plane"),
        ("wolf/Run, 1/2 of it, https://a.org/b/c", "wolf/Run, 1/2 of it, https://a.org/b/c"),
        (
            "CC BY-NC 4.0 (DAVIS, Perazzi et al. 2016): attribute",
            "CC BY-NC 4.0 (DAVIS, Perazzi et al. 2016): attribute",
        ),
    ],
)
def test_paths_are_cut_to_their_last_part(text: str, left: str) -> None:
    made = without_paths(record(error=text, config={"deep": [{"er": text}]}))
    assert (made.error, made.config) == (left, {"deep": [{"er": left}]})


def test_a_home_folder_is_a_user_name() -> None:
    assert [last_part(path) for path in ("/Users/jane/", "/root", "/home/jane/x/", "/x.npz")] == [
        "~",
        "~",
        "x",
        "x.npz",
    ]


@pytest.mark.parametrize(
    ("licence", "pictures", "shown"),
    [
        ("CC0 1.0 Universal", "open", True),
        ("CC BY 4.0", "open", True),
        ("MIT License", "open", True),
        ("CC BY-NC 4.0 (DAVIS)", "open", False),
        ("no licence file with the data; do not redistribute", "open", False),
        ("no licence file with the data; do not redistribute", "all", True),
        ("CC0 1.0", "none", False),
    ],
)
def test_pictures_of_data_that_may_not_be_passed_on(tmp_path: Path, licence: str, pictures: str, shown: bool) -> None:
    for seed in (1, 2):
        keep(tmp_path / "runs" / str(seed), seed, data={"licence": licence})
    made = collect(find_records(tmp_path / "runs"), tmp_path / "kept", title="", pictures=pictures, limit=LIMIT)
    assert made.pictured == shown
    wanted = [] if shown or pictures == "none" else [
        f"wolf/Run: no pictures, because of its licence ('{licence}'); --pictures all keeps them."
    ]  # fmt: skip
    assert made.remarks == wanted


def test_budgets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(tmp_path / "runs" / "1", 1)
    found = find_records(tmp_path / "runs")
    sentence = r"kept: expected at most 0.0 MB in all, got 0.\d MB of 1 runs; raise --limit-mb, or leave pictures out"
    with pytest.raises(UserError, match=sentence):
        collect(found, tmp_path / "kept", title="", limit=2000)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"], "nothing half-written"
    monkeypatch.setattr(module, "RUN_BYTES", 2000)
    made = collect(found, tmp_path / "kept", title="", limit=LIMIT)
    assert [re.sub(r".*: (\S+) left.*", r"\1", remark) for remark in made.remarks] == ["orbit.mp4", "comparison.webp"]
    assert files(tmp_path / "kept") == {"ours-quick-seed1-00000000": [FILE]}


def test_a_collection_is_replaced_and_anything_else_is_not(tmp_path: Path) -> None:
    keep(tmp_path / "runs" / "1", 1)
    kept = tmp_path / "kept"
    collect(find_records(tmp_path / "runs"), kept, title="", limit=LIMIT)
    before = {path.name: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    collect(find_records(kept), kept, title="", limit=LIMIT)
    assert {path.name: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before
    (kept / MARKER).unlink()
    with pytest.raises(UserError, match="kept: expected an empty folder or an earlier collection, but it holds some"):
        collect(find_records(tmp_path / "runs"), kept, title="", limit=LIMIT)


def test_the_latest_of_equal_runs_is_kept_and_a_failure_too(tmp_path: Path) -> None:
    keep(tmp_path / "runs" / "new", 1, drawn=False)
    old = keep(tmp_path / "runs" / "old", 1, drawn=False, run_id="f" * 16)
    older = msgspec.structs.replace(old.timing, started="2025-01-01T00:00:00+00:00")
    write_record(msgspec.structs.replace(old, timing=older), tmp_path / "runs" / "old")
    keep(tmp_path / "runs" / "bad", 2, False, status="failed", error="/home/jane/a.ply: cut", scores={}, pictures=[])
    collect(find_records(tmp_path / "runs"), tmp_path / "kept", title="", limit=LIMIT)
    kept = kept_records(tmp_path)
    assert [(made.seed, made.run_id, made.error) for made in kept] == [
        (1, f"{1:016d}", ""),
        (2, f"{2:016d}", "a.ply: cut"),
    ]


def test_a_record_names_no_place_outside_of_the_folder(tmp_path: Path) -> None:
    protocol = {**PROTOCOL, "name": "../../p"}
    keep(tmp_path / "runs" / "1", 1, False, case="../../../x", method="a/../../b", protocol=protocol)
    collect(find_records(tmp_path / "runs"), tmp_path / "in" / "kept", title="", limit=LIMIT)
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "in"}
    assert [path.name for path in (tmp_path / "in").iterdir()] == ["kept"]
    assert len(list((tmp_path / "in" / "kept").rglob(FILE))) == 1


def test_from_runs_to_the_page_from_the_collection_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (1, 2):
        keep(tmp_path / "runs" / str(seed), seed)
    kept, page = tmp_path / "kept", tmp_path / "page"
    assert (
        call("leaderboard", "collect", "--runs", str(tmp_path / "runs"), "--out", str(kept), "--title", "Wolves") == 0
    )
    assert re.fullmatch(r"2 runs, 1 of them with pictures, 0\.\d MB: .*kept\n", capsys.readouterr().out)
    assert call("table", "--runs", str(tmp_path / "runs")) == 0
    before = capsys.readouterr().out
    assert "20.12" in before
    assert call("table", "--runs", str(kept)) == 0
    assert capsys.readouterr().out == before
    (tmp_path / "runs").rename(tmp_path / "gone")
    assert call("leaderboard", "build", "--runs", str(kept), "--out", str(page)) == 0
    shown = (page / "runs" / f"{1:016d}" / "index.html").read_text()
    for name in ("comparison.webp", "orbit.mp4"):
        assert f'src="{name}"' in shown and (page / "runs" / f"{1:016d}" / name).stat().st_size > 0
    assert "a view that was held out" in shown and "One turn around" in shown and "<svg" in shown
    for path in [*kept.rglob("*"), *page.rglob("*")]:
        assert not path.is_file() or b"jane" not in path.read_bytes(), path


def test_the_commands_sentences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("leaderboard", "collect", "--runs", str(tmp_path / "no"), "--out", str(tmp_path / "kept")) == 2
    assert "no: expected a folder of runs, but there is no such folder" in capsys.readouterr().err
    (tmp_path / "none").mkdir()
    assert call("leaderboard", "collect", "--runs", str(tmp_path / "none"), "--out", str(tmp_path / "kept")) == 2
    assert "expected run records, found none" in capsys.readouterr().err
    assert call("leaderboard", "colect") == 2
    assert "unknown leaderboard command 'colect'. Did you mean 'collect'?" in capsys.readouterr().err
    assert not (tmp_path / "kept").exists()
