"""Sets of features: kept exactly, pooled over cases, and computed once where the input is the same."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from extractors import LinearNetwork, LinearVideoNetwork
from records_for_tests import PROTOCOL, record

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.cameras.rendering import render
from rewild4d.commands.table import main as table
from rewild4d.errors import UserError
from rewild4d.evaluation import novel_views
from rewild4d.evaluation.protocol import NovelViews
from rewild4d.leaderboard.pooled import pooled_table, pooled_tables
from rewild4d.leaderboard.records import RunRecord, write_record
from rewild4d.leaderboard.tables import Entrant, Frame
from rewild4d.metrics import names
from rewild4d.metrics.caching import CachedNetwork, cached_features
from rewild4d.metrics.distribution import frechet, kid, mmd2_unbiased
from rewild4d.metrics.samples import Conditions, Features, image_features
from rewild4d.metrics.score import Score
from rewild4d.metrics.sets import FILE, Compared, distances, pool, read_features, write_features
from rewild4d.metrics.video import video_features
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

pytestmark = pytest.mark.usefixtures("cache")

SCORES = ("kid_v", "fvd_f", "kvd_f")
SETS = {**PROTOCOL, "scores": ["psnr", *SCORES], "floors": ["empty"]}
WHITE = Conditions("grey 1", "full frame", 24.0)


def features(rows: int, seed: int, network: str = "linear", frames: int | None = None, width: int = 6) -> Features:
    values = torch.randn(rows, width, generator=torch.Generator().manual_seed(seed)).double()
    return Features(values, torch.zeros(rows, dtype=torch.int64), network, "d", "area", frames)


def sets(seed: int, frames: int = 16) -> list[Compared]:
    """What a run on one case leaves: images and clips."""
    return [
        Compared("kid_v", features(12, seed), features(7, seed + 50), WHITE),
        Compared("fvd_f", features(9, seed + 1, "clips", frames), features(5, seed + 51, "clips", frames), WHITE),
    ]


def run(folder: Path, case: str, seed: int, **changes: Any) -> tuple[Path, RunRecord]:
    """A run with features beside its record."""
    made = sets(1000 * len(case) + 100 * seed + len(str(changes.get("method", ""))))
    digest = write_features(made, folder / FILE)
    found = [one for compared in made for one in distances(compared)]
    scores = {name: Score(one.value, "1", "lower", one.n) for name, one in zip(SCORES, found, strict=True)}
    fields: dict[str, Any] = {"case": case, "seed": seed, "protocol": SETS, "scores": scores, "features": digest}
    made_record = record(**{**fields, **changes})
    write_record(made_record, folder)
    return folder, made_record


def test_features_come_back_to_the_last_bit(tmp_path: Path) -> None:
    made = sets(3)
    digest = write_features(made, tmp_path / FILE)
    back = read_features(tmp_path / FILE, digest)
    for one in made:
        other = back[one.kind]
        assert (other.kind, other.conditions) == (one.kind, one.conditions)
        for side in ("prediction", "truth"):
            was, now = getattr(one, side), getattr(other, side)
            assert torch.equal(was.values, now.values) and torch.equal(was.groups, now.groups)
            assert replace(was, values=0, groups=0) == replace(now, values=0, groups=0)
        assert distances(one) == distances(other)
    assert write_features(sets(3), tmp_path / "again.npz") == digest != write_features(sets(4), tmp_path / "x.npz")


def test_a_file_of_features_that_is_not_the_records_is_refused(tmp_path: Path) -> None:
    write_features(sets(3), tmp_path / FILE)
    with pytest.raises(UserError, match="expected the features that its record was scored with, but it holds others"):
        read_features(tmp_path / FILE, "0" * 64)
    with pytest.raises(UserError, match="expected the features of a run, but there is no such file"):
        read_features(tmp_path / "none.npz")
    whole = (tmp_path / FILE).read_bytes()
    for damaged in (b"", b"text", whole[:200], whole[: len(whole) // 2]):
        (tmp_path / FILE).write_bytes(damaged)
        with pytest.raises(UserError, match=r"features of a run \(.npz\), but it cannot be read"):
            read_features(tmp_path / FILE)


def test_pooling_is_the_distance_over_all_rows() -> None:
    parts = [sets(seed)[1] for seed in range(6)]
    x, y = (torch.cat([getattr(part, side).values for part in parts]) for side in ("prediction", "truth"))
    fvd, kvd = distances(pool(parts))
    assert (fvd.n, fvd.m, fvd.frames, fvd.sequences) == (6 * 9, 6 * 5, 16, 6)
    whole = (Features(rows, torch.zeros(len(rows), dtype=torch.int64), "clips", "d", "area", 16) for rows in (x, y))
    assert fvd.value == pytest.approx(frechet(*whole, name="FVD-F", conditions=WHITE).value)
    assert kvd.value == pytest.approx(mmd2_unbiased(x, y))
    assert kvd.interval is not None and kvd.interval[0] < (kvd.value or 0) < kvd.interval[1]
    assert distances(pool(parts[:1])) == distances(parts[0])


def test_sets_that_differ_are_not_pooled() -> None:
    one, other = sets(1)[1], sets(2, frames=12)[1]
    with pytest.raises(ValueError, match="got 2 different lengths of clips"):
        pool([one, other])
    with pytest.raises(ValueError, match="got 2 different kinds"):
        pool(sets(1))
    with pytest.raises(ValueError, match="got 2 different networks"):
        pool([one, replace(one, truth=replace(one.truth, digest="e"))])
    with pytest.raises(ValueError, match="got 2 different backgrounds or crops"):
        pool([one, replace(one, conditions=Conditions("grey 0", "full frame"))])


def test_the_table_pools_all_cases_of_a_method(tmp_path: Path) -> None:
    cases = [f"{'w' * i}olf" for i in range(5)]
    found = [run(tmp_path / case, case, 0) for case in cases]
    found += [run(tmp_path / f"{case}-gart", case, 0, method="gart") for case in cases]
    (made,) = pooled_tables(found)
    parts = [read_features(tmp_path / case / FILE)["kid_v"] for case in cases]
    expected = distances(pool(parts))[0]
    cell = made.rows[0].cells[0]
    assert [row.stubs[0] for row in made.rows] == ["ours", "gart"] and cell.value == expected.value
    assert cell.interval == expected.interval is not None and "[" in cell.text
    assert cell.note.startswith(f"KID-16V: 5 cases pooled, n = {5 * 12}, m = {5 * 7}")
    assert f"n = {5 * 9}, m = {5 * 5}, T = 16" in made.rows[0].cells[1].note
    assert {row.cells[1].mark for row in made.rows} == {"best", "second"}
    assert [column.score for column in made.columns] == list(SCORES)


def test_cases_too_short_for_a_distance_of_their_own_are_pooled(tmp_path: Path) -> None:
    """A clip of sixteen frames is one window: sixteen renders against one, of which no distance can be computed."""
    found, parts = [], []
    for index in range(8):
        folder = tmp_path / str(index)
        ones = [features(rows, 90 * index + rows, "clips", 16) for rows in (16, 1)]
        parts.append(Compared("fvd_f", *ones, WHITE))
        scores = novel_views.as_scores(distances(parts[-1]), ("fvd_f", "kvd_f"), {})
        reason = "not computed: at least 2 samples a side are needed, got 16 and 1"
        assert {(score.value, score.note) for score in scores.values()} == {(None, reason)}
        digest = write_features(parts[-1:], folder / FILE)
        protocol = {**PROTOCOL, "scores": ["fvd_f", "kvd_f"]}
        found.append((folder, record(case=str(index), protocol=protocol, scores=scores, features=digest)))
    cells = pooled_tables(found)[0].rows[0].cells
    expected = distances(pool([read_features(folder / FILE)["fvd_f"] for folder, _ in found]))
    assert [cell.value for cell in cells] == [one.value for one in expected] and all(cell.value for cell in cells)
    assert cells[0].note == f"FVD-F: 8 cases pooled, n = {8 * 16}, m = {8 * 1}, T = 16"
    (alone,) = pooled_tables(found[:1])[0].rows
    assert [(cell.text, cell.note) for cell in alone.cells] == [("n/a", reason)] * 2


def test_seeds_are_pooled_on_their_own(tmp_path: Path) -> None:
    found = [run(tmp_path / f"{case}{seed}", case, seed) for case in ("a", "bb") for seed in (0, 1)]
    values = []
    for seed in (0, 1):
        parts = [read_features(tmp_path / f"{case}{seed}" / FILE)["kid_v"] for case in ("a", "bb")]
        values.append(kid(pool(parts).prediction, pool(parts).truth).value or 0)
    cell = pooled_tables(found)[0].rows[0].cells[0]
    assert cell.value == pytest.approx(sum(values) / 2) and cell.deviation == pytest.approx(
        abs(values[0] - values[1]) / 2**0.5
    )


def test_a_case_without_features_keeps_the_method_from_being_pooled(tmp_path: Path) -> None:
    def note(second: tuple[Path, RunRecord]) -> str:
        cell = pooled_tables([run(tmp_path / "a", "a", 0), second])[0].rows[0].cells[1]
        assert (cell.text, cell.value) == ("n/a", None)
        return cell.note

    whole = run(tmp_path / "bb", "bb", 0)
    assert note(run(tmp_path / "old", "bb", 0, features="")) == (
        "not computed: bb: no features are kept beside its record; `rewild4d-bench evaluate` makes them"
    )
    missing = {"fvd_f": Score(None, "1", "lower", 0, [], "not computed: weights missing, run: x")}
    bare = run(tmp_path / "w", "bb", 0, scores=missing, features="")
    assert note(bare) == "not computed: bb: weights missing, run: x"
    images = write_features(sets(9)[:1], tmp_path / "w" / FILE)
    for scores, reason in ((missing, "weights missing, run: x"), ({}, "its features are not of FVD-F")):
        kept_images = msgspec.structs.replace(bare[1], scores=scores, features=images)
        assert note((tmp_path / "w", kept_images)) == f"not computed: bb: {reason}"
    failed = run(tmp_path / "f", "bb", 0, status="failed", error="it broke", scores={})
    assert note(failed) == "not computed: bb, ours: failed: it broke"
    assert note(run(tmp_path / "s", "bb", 1)).startswith("not computed: no result with seed 0 for bb")
    write_features(sets(9, frames=12), whole[0] / FILE)
    assert "but it holds others" in note(whole)
    (whole[0] / FILE).unlink()
    assert "there is no such file" in note(whole)


def test_the_command_prints_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for case in ("a", "bb"):
        run(tmp_path / case, case, 0)
    assert table(["--runs", str(tmp_path)]) == 0
    assert "`table --pooled` computes them over all cases at once" in capsys.readouterr().out
    assert table(["--runs", str(tmp_path), "--pooled"]) == 0
    printed = capsys.readouterr().out
    assert "P: all cases pooled" in printed and "2 cases: a, bb" in printed
    assert "FVD-F: 2 cases pooled, n = 18, m = 10, T = 16" in printed
    with pytest.raises(UserError, match="--pooled: expected no --against with it"):
        table(["artemis", "--pooled", "--against", "ours", "--runs", str(tmp_path)])
    with pytest.raises(UserError, match="table 'input-view': expected scores of sets to pool"):
        table(["input-view", "--pooled", "--runs", str(tmp_path)])


def test_a_named_table_is_pooled_under_each_condition(tmp_path: Path) -> None:
    one, other = run(tmp_path / "a", "a", 0), run(tmp_path / "bb", "bb", 0)
    frame = Frame("t", "T", "", ("x", "y"), ("psnr", "kid_v"))
    rows = [Entrant("ours", ((one[1], other[1]), (other[1],))), Entrant("new", ((), ()), "not written yet")]
    made = pooled_table(frame, rows, [one, other])
    values = [cell.value for cell in made.rows[0].cells]
    assert values == [
        distances(pool([read_features(folder / FILE)["kid_v"] for folder in folders]))[0].value
        for folders in ((tmp_path / "a", tmp_path / "bb"), (tmp_path / "bb",))
    ]
    assert [column.group for column in made.columns] == ["x", "y"]
    assert [(cell.text, cell.note) for cell in made.rows[1].cells] == [("n/a", "not written yet")] * 2


def test_a_copy_of_a_record_has_its_features(tmp_path: Path) -> None:
    """Rows of named tables are records without some of their marks."""
    found = [run(tmp_path / case, case, 0) for case in ("a", "bb")]
    copies = tuple(msgspec.structs.replace(one, marks=["other"]) for _, one in found)
    frame = Frame("t", "T", "", ("",), ("kid_v",))
    made = pooled_table(frame, [Entrant("ours", (copies,))], found)
    parts = [read_features(folder / FILE)["kid_v"] for folder, _ in found]
    assert made.rows[0].cells[0].value == distances(pool(parts))[0].value is not None
    assert made.remarks[0] == "Pooled over 2 cases: a, bb."


class Counting:
    """A network and how often it was asked."""

    def __init__(self, network: Any) -> None:
        self.network, self.calls = network, 0
        self.name, self.digest, self.resize = network.name, network.digest, network.resize
        self.minimum_frames = getattr(network, "minimum_frames", 1)

    def __call__(self, batch: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return self.network(batch)


def test_the_same_input_is_computed_once() -> None:
    counting = Counting(LinearNetwork())
    images = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    network = CachedNetwork(counting)
    assert torch.equal(network(images), counting.network(images)) and torch.equal(
        network(images), network(images.clone())
    )
    assert counting.calls == 1
    changed = images.clone()
    changed[2, 1, 4, 4] += 1e-6
    assert torch.equal(network(changed), counting.network(changed)) and counting.calls == 2
    network(images)
    assert counting.calls == 3
    images += 1e-3  # a caller may fill the same memory again
    assert torch.equal(network(images), counting.network(images)) and counting.calls == 4


def test_a_reference_is_computed_once_a_machine_and_kept_exactly(cache: Path) -> None:
    images = list(torch.rand(5, 3, 8, 8, generator=torch.Generator().manual_seed(0)))
    counting = Counting(LinearNetwork())

    def reference(shown: list[torch.Tensor], *choice: object) -> Features:
        return cached_features(counting, shown, lambda network: image_features([shown], network), *choice)

    first, again = reference(images), reference(images)
    assert counting.calls == 1 and torch.equal(first.values, again.values) and torch.equal(first.groups, again.groups)
    assert replace(first, values=0, groups=0) == replace(again, values=0, groups=0)
    reference(images, "another window")
    reference([image + 1e-6 for image in images])
    assert counting.calls == 3
    counting.digest = "f" * 64
    reference(images)
    assert counting.calls == 4
    for path in cache.rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    assert torch.equal(reference(images).values, first.values) and counting.calls == 5


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def test_nothing_is_scored_as_before_and_costs_one_call_a_set(case: Case) -> None:
    """The empty reconstruction against a plain computation of the same sets, without memory of any kind."""
    settings, reference = NovelViews(frames=3, clip=12, stride=2), [frame.over(1.0) for frame in case.clip.frames]
    images, videos = Counting(LinearNetwork()), Counting(LinearVideoNetwork())

    def score() -> list[Any]:
        return novel_views.novel_view_distances(
            EmptyReconstruction(), case.clip, settings, names=names.SETS, background=1.0,
            images=images, videos=videos, log=lambda *_: None,
        )[0]  # fmt: skip

    found = {one.name.split(" [")[0]: one for one in score()}
    windows = novel_views._windows(len(reference), settings)
    white = torch.ones_like(reference[0])
    clips = [[white] * 12] * (16 * len(windows))
    x = video_features([clips], LinearVideoNetwork())
    y = video_features([[[reference[i] for i in window] for window in windows]], LinearVideoNetwork())
    assert found["KVD-F"].value == found["KVD-Diag"].value == kid(x, y).value
    assert found["FVD-F"].value == frechet(x, y, name="", conditions=WHITE).value
    still = image_features([[white] * (16 * len(novel_views.evenly_spaced(len(reference), 3)))], LinearNetwork())
    assert found["KID-V"].value == kid(still, image_features([reference], LinearNetwork())).value
    calls = images.calls, videos.calls
    assert videos.calls == 2 + len(windows) and score() and videos.calls == calls[1] + 2
    orbit = novel_views._Orbit(EmptyReconstruction(), case.clip, 1.0, NovelViews(), None)
    color, alpha = render(EmptyReconstruction().at(0.0), orbit.cameras[3])
    assert torch.equal(orbit.image(3, 0), (color + (1 - alpha) * 1.0).clamp(0, 1))
