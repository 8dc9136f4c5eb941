"""Which runs are one row: variants of a method, priors, the latest of equal runs, data that is or is not the same."""

from records_for_tests import psnr, record, runs, texts

from rewild4d.leaderboard.records import RunRecord, Timing
from rewild4d.leaderboard.tables import protocol_tables, standings


def test_variants_of_a_method_are_rows_of_their_own() -> None:
    """An ablation in the same folder is no further seed of the whole method."""
    base = {"deform": {"enabled": True}, "steps": 5}
    found = [
        *runs({"a": [20.0, 22.0]}, config=base),
        *runs({"a": [10.0]}, config={"deform": {"enabled": False}, "steps": 5}),
        *runs({"a": [11.0]}, config={"deform": {"enabled": True}, "steps": 7}),
    ]
    (made,) = protocol_tables(found)
    assert {row.stubs[1]: row.cells[0].text for row in made.rows} == {
        "ours": "21.00", "ours [deform.enabled=false]": "10.00", "ours [steps=7]": "11.00",
    }  # fmt: skip
    (ranked,) = standings(found)
    assert texts(ranked)["ours"][2] == "best"


def test_presets_and_priors_tell_variants_apart() -> None:
    noisy = {"choice": "coarse:1", "config": {}}
    found = [
        record(),
        record(preset="standard"),
        record(prior=noisy),
        record(prior={"choice": "template", "config": {}}),
    ]
    (made,) = protocol_tables(found)
    labels = [row.stubs[1] for row in made.rows]
    assert len(set(labels)) == 4 and all("ours (" in label for label in labels)
    assert any('--prior="coarse:1"' in label for label in labels)


def test_a_prior_from_elsewhere_is_named_even_where_all_have_it() -> None:
    for choice, said in (("coarse:0", "coarse:0"), ("/home/her/dog.npz", "dog.npz")):
        (made,) = protocol_tables([record(prior={"choice": choice}), record(method="gart", prior={"choice": choice})])
        assert [row.stubs[1] for row in made.rows] == [f'{name} [--prior="{said}"]' for name in ("ours", "gart")]
    (made,) = protocol_tables([record(prior={"choice": "template"})])
    assert [row.stubs[1] for row in made.rows] == ["ours"]


def test_the_latest_of_equal_runs_counts() -> None:
    def at(day: int, value: float, code: str) -> RunRecord:
        timing = Timing(f"2026-01-{day:02d}T00:00:00+00:00", 1.0, 1.0, 1.0)
        return record(timing=timing, scores=psnr(value), code={"sources": code}, run_id=code)

    (made,) = protocol_tables([at(2, 21.0, "new"), at(1, 10.0, "old")])
    assert [row.cells[0].text for row in made.rows] == ["21.00"]
    assert made.rows[0].cells[1].text == "1"


def test_runs_on_data_that_has_changed_are_left_out_and_told() -> None:
    old = record(method="gart", data={"truth": "1"}, timing=Timing("2026-01-01", 1.0, 1.0, 1.0))
    new = record(data={"truth": "2"}, timing=Timing("2026-01-02", 1.0, 1.0, 1.0))
    (made,) = protocol_tables([old, new])
    assert [row.stubs[1] for row in made.rows] == ["ours"]
    assert made.remarks == ("p-v1, wolf/Run: 1 older records of other data left out.",)


def test_the_built_in_animals_are_the_same_data_wherever_they_were_rendered() -> None:
    def on(folder: str, pixels: str, method: str) -> RunRecord:
        return record(method=method, data={"root": folder, "clip": pixels, "truth": pixels})

    mine, theirs = on("/home/me/builtin-v1-0123456789ab", "1", "ours"), on("builtin-v1-ba9876543210", "2", "gart")
    (made,) = protocol_tables([mine, theirs])
    assert [row.stubs[1] for row in made.rows] == ["ours", "gart"]
    assert made.remarks == ("p-v1: wolf/Run rendered on several kinds of processor, equal up to rounding.",)
    assert not protocol_tables([mine, on("builtin-v1-ba9876543210", "1", "gart")])[0].remarks
    for other in ("builtin-v2-ba9876543210", "builtin-v1", "rigs"):
        (made,) = protocol_tables([mine, on(other, "2", "gart")])
        assert made.remarks == ("p-v1, wolf/Run: 1 older records of other data left out.",), other


def test_a_folder_of_one_recipe_is_the_same_data_wherever_it_was_rendered() -> None:
    def on(recipe: dict[str, str], pixels: str, method: str) -> RunRecord:
        return record(method=method, data={"root": "rigs", "clip": pixels, "truth": pixels, **recipe})

    mine = on({"recipe": "r1"}, "1", "ours")
    (made,) = protocol_tables([mine, on({"recipe": "r1"}, "2", "gart")])
    assert [row.stubs[1] for row in made.rows] == ["ours", "gart"]
    assert made.remarks == ("p-v1: wolf/Run rendered on several kinds of processor, equal up to rounding.",)
    assert not protocol_tables([mine, on({}, "1", "gart")])[0].remarks, "the same pixels, of a time without recipes"
    for left, right in (({"recipe": "r1"}, {"recipe": "r2"}), ({"recipe": "r1"}, {}), ({}, {})):
        (made,) = protocol_tables([on(left, "1", "ours"), on(right, "2", "gart")])
        assert made.remarks == ("p-v1, wolf/Run: 1 older records of other data left out.",), (left, right)
