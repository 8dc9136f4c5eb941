"""From a table's file to runs and rows: what is planned, what is missing, what matches, what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from calling import output, refusal
from one_case import OneCase
from records_for_tests import PROTOCOL, psnr, record, spec

from rewild4d import cli
from rewild4d.baselines.prior_only import PriorOnly, PriorOnlyConfig
from rewild4d.commands import run_table, table
from rewild4d.config import load_preset
from rewild4d.contracts import Selection
from rewild4d.errors import UserError
from rewild4d.leaderboard.records import FILE, RunRecord, write_record
from rewild4d.leaderboard.specs import Condition, Line, Spec, load_reported, load_specs
from rewild4d.leaderboard.tables import kind_of
from rewild4d.ours.config import Config
from rewild4d.priors.config import QUICK, STANDARD
from rewild4d.priors.io import save_prior
from rewild4d.registry import load_method
from rewild4d.running import planning
from rewild4d.running.conformance import tiny_case
from rewild4d.running.provenance import FROM_TRUTH


def test_every_table_that_ships_can_be_planned() -> None:
    specs = load_specs()
    assert set(specs) == {
        "ablation", "artemis", "input-view", "novel-view", "prior-mismatch", "protocols", "sweep-random",
        "reproduction", "reproduction-films", "reproduction-fixed", "reproduction-prior", "tuning",
        "unseen", "aim", "cop3d", "equine-motion", "equine-looks",
    }  # fmt: skip
    for name, found in specs.items():
        for preset in ("quick", "standard", "paper", "paper-short"):
            full = planning.with_choice(name, found, planning.Choice(preset=preset))
            for row in full.rows:
                planning.row_entry(name, row, full, (0,))
        if found.paper:
            printed = load_reported(found.paper)
            ours = printed.source.startswith("Progressive Pose-Guided 4D Animal Reconstruction")
            assert printed.status == ("printed" if ours else "unconfirmed"), "others are known from notes alone"


def test_the_ablations_are_the_papers_and_two_more() -> None:
    found = load_specs()["ablation"]
    labels = [row.label for row in found.rows]
    assert labels == [
        "w/o Deform", "w/o Shape Prior", "w/o Part Anchors", "w/ Symm. Enc.", "w/o Symm. Enc.", "Poses tied",
        "Fixed Skinning", "w/o compact", "w/o smooth", "w/o Isolation", "Ours",
    ]  # fmt: skip
    made = {row.label: planning.row_entry("ablation", row, found, ()).config for row in found.rows}
    whole: Any = made["Ours"]
    assert whole == load_preset("ours", Config, "standard")
    assert made["w/o Deform"] == msgspec.structs.replace(
        whole, deform=msgspec.structs.replace(whole.deform, enabled=False)
    )
    # One of the two codes is the preset's, so that row is the whole method again: run once.
    assert made["w/o Symm. Enc."] == whole
    assert len({msgspec.json.encode(config) for config in made.values()}) == len(labels) - 1
    assert len(planning.entries("ablation", found, (0,))) == len(labels) - 1
    paper = planning.with_choice("ablation", found, planning.Choice(preset="paper"))
    papers = {row.label: planning.row_entry("ablation", row, paper, ()).config for row in paper.rows}
    assert papers["w/ Symm. Enc."] == papers["Ours"] == load_preset("ours", Config, "paper")
    assert len(planning.entries("ablation", paper, (0,))) == len(labels) - 1


def test_a_protocol_without_a_version_is_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    known = dict.fromkeys(["a-v2", "a-v10", "a-b-v11", "a-v9"])
    monkeypatch.setattr(planning, "load_protocols", lambda: known)
    assert planning.newest_protocol("a") == "a-v10"
    assert planning.newest_protocol("a-v9") == "a-v9"
    assert planning.newest_protocol("c") == "c"


def test_comparisons_have_a_row_of_every_method() -> None:
    """The noise of a prior says nothing of a method that takes none."""
    specs = load_specs()
    rows = {name: [(row.label, row.method) for row in specs[name].rows] for name in specs}
    assert rows["protocols"] == rows["sweep-random"] == rows["artemis"]
    asked = [(label, method) for label, method in rows["artemis"] if load_method(method).info.uses_prior]
    assert rows["prior-mismatch"] == asked and len(asked) == len(rows["artemis"]) - 1
    assert "D-3DGS does not see the prior" in specs["prior-mismatch"].description


def test_conditions_of_one_protocol_are_one_plan() -> None:
    found = spec([], conditions=(
        Condition(protocol="p", cases=("*@side",)), Condition(protocol="p", cases=("*@frontal",)),
        Condition(protocol="q"), Condition(protocol="q", cases=("x",)), Condition(protocol="p", prior="coarse:1"),
    ))  # fmt: skip
    assert planning.cases_of_conditions(found) == {
        ("p", "template"): ("*@side", "*@frontal"), ("q", "template"): (), ("p", "coarse:1"): (),
    }  # fmt: skip


def test_rows_take_the_records_with_their_settings() -> None:
    """An ablation's record is not the whole method's; records from before a setting have its default."""
    rows = [
        Line(label="Ours", method="ours"),
        Line(label="w/o", method="ours", settings={"deform": {"enabled": False}}),
    ]
    found = spec(rows, conditions=(Condition(protocol="p-v1"),))
    whole = msgspec.to_builtins(load_preset("ours", Config, "quick"))
    older = {**whole, "deform": {name: value for name, value in whole["deform"].items() if name != "anchors"}}
    without = {**whole, "deform": {**whole["deform"], "enabled": False}}
    records = [
        record(config=older, case="a"), record(config=without, case="b"), record(config={"gone": 1}, case="c"),
        record(config=whole, case="d", prior={"choice": "coarse:1", "config": msgspec.to_builtins(QUICK)}),
        record(config=whole, case="e", prior={"choice": "template", "config": msgspec.to_builtins(STANDARD)}),
        record(method="empty", case="a"), record(method="empty", case="z"),
    ]  # fmt: skip
    records = [msgspec.structs.replace(r, prior=r.prior or {"name": "template"}) for r in records]
    entrants, _ = planning.entrants("t", found, records)
    cases = {entrant.label: [r.case for r in entrant.records[0]] for entrant in entrants}
    assert cases == {"Ours": ["a"], "w/o": ["b"], "empty": ["a"]}


def test_runs_whose_prior_saw_keypoints_are_other_runs() -> None:
    """DAVIS's tables are those of masks alone, APTv2's those of its keypoints: what `run --table` makes."""
    whole = msgspec.to_builtins(load_preset("ours", Config, "quick"))
    for dataset, wanted in (("davis", ["a", "b"]), ("aptv2", ["c"])):
        found = spec([Line(label="Ours", method="ours")], conditions=(Condition(protocol="p-v1"),))
        found = msgspec.structs.replace(found, dataset=dataset)
        records = [
            record(config=whole, dataset=dataset, case=case, prior={"name": "template"} | said)
            for case, said in (("a", {}), ("b", {"keypoints": "none"}), ("c", {"keypoints": "all"}))
        ]
        (entrant,), _ = planning.entrants("t", found, records)
        assert [one.case for one in entrant.records[0]] == wanted


def test_a_condition_with_a_prior_from_the_truth_ranks_its_rows() -> None:
    """All rows of a condition start from its prior, so that it was made from the truth sets none of them apart."""
    conditions = (Condition(protocol="p-v1", prior="coarse:0"), Condition(protocol="p-v1"))
    found = spec([Line(label="Ours", method="ours"), Line(label="Other", method="d3dgs")], conditions=conditions)
    records = [
        record(method=method, config=msgspec.to_builtins(load_preset(method, load_method(method).Config, "quick")),
               prior={"choice": prior}, marks=[*seen, *([FROM_TRUTH] if prior == "coarse:0" else [])])
        for method, seen in (("ours", []), ("d3dgs", ["upper bound: it has seen more"]))
        for prior in ("coarse:0", "template")
    ]  # fmt: skip
    entrants, _ = planning.entrants("t", found, records)
    assert [[len(under) for under in entrant.records] for entrant in entrants] == [[1, 1], [1, 1]]
    assert [kind_of(entrant) for entrant in entrants] == ["method", "unranked"]


def test_a_row_that_cannot_be_planned_is_a_sentence() -> None:
    found = spec([Line(label="New", method="nwe"), Line(label="Odd", method="ours", settings={"deform": {"widht": 3}})])
    with pytest.raises(UserError, match=r"table 't', row 'New': unknown method 'nwe'. Available: "):
        planning.entries("t", found, (0,))
    with pytest.raises(UserError, match=r"row 'Odd': the settings do not fit 'ours': Object contains unknown field"):
        planning.row_entry("t", found.rows[1], found, (0,))
    (new, odd), _ = planning.entrants("t", found, [])
    assert new.absent.startswith("table 't', row 'New': unknown method") and "widht" in odd.absent


def test_a_protocol_can_be_chosen_only_for_a_single_condition() -> None:
    many = load_specs()["protocols"]
    with pytest.raises(UserError, match="--protocol: the table 'protocols' compares 5 conditions of its own"):
        planning.with_choice("protocols", many, planning.Choice(protocol="artemis-sweep-128-v1"))
    one = planning.with_choice("artemis", load_specs()["artemis"], planning.Choice(protocol="artemis-random-128"))
    assert one.conditions[0].protocol.startswith("artemis-random-128-v")


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Spec:
    """A table of two cheap rows on one tiny case, in the place of those that ship."""
    case = tiny_case()
    save_prior(case.prior, tmp_path / "prior.npz")
    rows = [Line(label="Coarse", method="prior-only", settings={"gaussians": 300}),
            Line(label="Fine", method="prior-only", settings={"gaussians": 3000})]  # fmt: skip
    found = spec(rows, seeds=(0, 1), conditions=(
        Condition(protocol="artemis-sweep-128", prior=str(tmp_path / "prior.npz")),
    ))  # fmt: skip
    monkeypatch.setattr(run_table, "find_spec", lambda _: found)
    monkeypatch.setattr(table, "find_spec", lambda _: found)
    monkeypatch.setattr(run_table, "open_dataset", lambda *_: (tmp_path, OneCase(case)))
    own = run_table.find_protocol
    monkeypatch.setattr(
        run_table, "find_protocol", lambda *given: msgspec.structs.replace(own(*given), floors=("empty",))
    )
    return found


def test_a_case_of_one_condition_is_planned_there_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cases of a fixed camera have names of their own."""

    class Reader:
        def cases(self, selection: Selection) -> list[str]:
            return ["cat/sit@side", "wolf/run@side"] if selection.cameras == "fixed" else ["cat/sit", "wolf/run"]

    plans = []
    monkeypatch.setattr(run_table, "open_dataset", lambda *_: (tmp_path, Reader()))
    monkeypatch.setattr(run_table, "_print_plan", lambda plan, _: plans.append(plan))
    wanted = ("run", "--table", "unseen", "--out", str(tmp_path / "runs"), "--plan", "--case")
    output(capsys, *wanted, "wolf/run", "cat/*@side")
    kinds = [(plan.protocol.name.split("-")[1], plan.cases) for plan in plans]
    assert kinds == [("sweep", ("wolf/run",)), ("random", ("wolf/run",)), ("fixed", ("cat/sit@side",))]
    assert "unknown case 'wolf/walk'. Did you mean 'wolf/run'?" in refusal(capsys, *wanted, "wolf/walk", "cat/sit")


def test_a_table_is_run_printed_and_only_completed(
    demo: Spec, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = str(tmp_path / "runs")
    wanted = ("run", "--table", "demo", "--out", out, "--jobs", "1")
    planned = output(capsys, *wanted, "--plan").splitlines()
    assert [line.split()[:2] for line in planned] == [
        ["missing", label] for label in ("empty", "Coarse", "Coarse", "Fine", "Fine")
    ], "empty once, two rows with two seeds each"
    shown = output(capsys, *wanted)
    assert len(list(Path(out).rglob(FILE))) == 5
    assert shown == output(capsys, "table", "demo", "--runs", out), "the folder's records give the same table"
    assert all(f"| {label} |" in shown for label in ("Coarse", "Fine", "empty"))

    fitted: list[tuple[PriorOnlyConfig, int]] = []
    fit = PriorOnly.fit

    def spy(self: PriorOnly, *given: Any, **named: Any) -> Any:
        fitted.append((named["config"], named["seed"]))
        return fit(self, *given, **named)

    monkeypatch.setattr(PriorOnly, "fit", spy)
    assert output(capsys, *wanted) == shown
    assert fitted == []
    gone = next(folder.parent for folder in Path(out).rglob(FILE) if "prior-only-default-seed1" in str(folder))
    lost = msgspec.json.decode((gone / FILE).read_bytes(), type=RunRecord)
    for path in sorted(gone.rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    assert sorted(line.split()[0] for line in output(capsys, *wanted, "--plan").splitlines()) == ["done"] * 4 + [
        "missing"
    ]
    assert output(capsys, *wanted) == shown
    assert fitted == [(PriorOnlyConfig(gaussians=lost.config["gaussians"]), 1)]
    (gone / FILE).unlink()
    times = {path: path.stat().st_mtime_ns for path in Path(out).rglob(FILE)}
    assert output(capsys, *wanted) == shown
    assert len(fitted) == 1, "what was fitted is scored again, not fitted again"
    assert {path: path.stat().st_mtime_ns for path in Path(out).rglob(FILE) if path.parent != gone} == times
    assert (gone / FILE).is_file()


def test_a_named_table_tells_its_gaps(demo: Spec, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = msgspec.to_builtins(PriorOnlyConfig(gaussians=300))
    name = planning.newest_protocol("artemis-sweep-128")
    prior = {"choice": demo.conditions[0].prior, "config": msgspec.to_builtins(QUICK)}
    made = record(method="prior-only", config=config, prior=prior, protocol={**PROTOCOL, "name": name})
    write_record(replace_scores(made), tmp_path / "runs" / "one")
    shown = output(capsys, "table", "demo", "--runs", str(tmp_path / "runs"))
    assert "| Coarse | 21.50 | n/a [1] |" in shown
    assert "[1] not computed: artemis-sweep-128-v" in shown
    assert "Without records: Fine; `rewild4d-bench run --table demo --preset quick` makes what is missing." in shown
    one = output(capsys, "table", "demo", "--runs", str(tmp_path / "runs"), "--against", "fine", "--format", "csv")
    assert one.count("no record yet") == 2 + 2, "the row's own cells, and those of the row that is compared with it"


def replace_scores(made: RunRecord) -> RunRecord:
    return msgspec.structs.replace(made, scores=psnr(21.5))


def test_parts_of_a_case_are_run_side_by_side(demo: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With several jobs every (row, seed) is a piece of its own: fits first, the records in the plan's order."""
    from rewild4d.running import runner

    asked: list[tuple[str, int, int]] = []

    class InOrder:
        """Stands in for the processes."""

        def __init__(self, jobs: int, *_: object) -> None:
            assert jobs == 3

        def __enter__(self) -> "InOrder":
            return self

        def __exit__(self, *_: object) -> None:
            return None

        def map(self, function: Any, pieces: Any, lost: Any) -> list[Any]:
            if function is runner.prepare:
                return []
            asked.extend((entry.method, getattr(entry.config, "gaussians", 0), seed) for _, _, entry, seed in pieces)
            return [function(*piece) for piece in pieces]

    monkeypatch.setattr(runner, "Workers", InOrder)
    options = run_table.Options(table="demo", out=tmp_path / "runs", jobs=3)
    full = planning.with_choice("demo", demo, planning.Choice())
    (plan,) = run_table.make_plans(options, full)
    records = runner.execute(plan)
    floor, fits = ("empty", 0, 0), [("prior-only", count, seed) for count in (300, 3000) for seed in (0, 1)]
    assert asked == [*fits, floor]
    assert [(r.method, r.seed) for r in records] == [(method, seed) for method, _, seed in (floor, *fits)]
    alone = runner.execute(replace(plan, jobs=1, out=tmp_path / "alone"))
    assert [r.scores for r in alone] == [r.scores for r in records]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["run", "--table", "ablatoin"], "unknown table 'ablatoin'. Did you mean 'ablation'?"),
        (["run", "--table", "input-view"], "the data set 'davis' has no built-in data"),
        (["run", "--table", "ablation", "--preset", "quik"], "unknown preset 'quik'. Did you mean 'quick'?"),
        (["run", "--table", "ablation", "--gaussians", "3"], "unknown option '--gaussians'"),
        (["run", "--table", "ablation", "--jobs", "-1"], "--jobs: expected a number of at least 0, got -1"),
        (["run", "--table", "ablation", "--protocol", "artemis-swep-128-v1"], "Did you mean 'artemis-sweep-128-v1'?"),
        (["table", "ablatoin"], "unknown table 'ablatoin'. Did you mean 'ablation'?"),
        (["table", "artemis", "--protocol", "nope"], "unknown protocol 'nope'. Available: "),
        (["table", "artemis", "--protocol", "artemis-swep-256"], "Did you mean 'artemis-sweep-256-v"),
        (["table", "ablation", "--format", "pdf"], "unknown format 'pdf'. Available: csv, html, latex, md"),
        (["table", "--against", "ours"], "--against: expected the name of a table too"),
        (["table", "ablation", "artemis"], "table: expected the name of one table, got ablation artemis"),
    ],
)
def test_bad_input_is_one_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "") and len(err.strip().splitlines()) == 1
    assert sentence in err
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
