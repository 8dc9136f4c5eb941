"""Differences to a row, from records to what the command prints: signs, intervals and leads by hand."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import msgspec
import pytest
from calling import output, refusal
from records_for_tests import record

from rewild4d.evaluation.protocol import load_protocols
from rewild4d.leaderboard.records import write_record
from rewild4d.leaderboard.specs import load_specs
from rewild4d.metrics.score import Score
from rewild4d.running import planning

RIGS = ("horse/Walk", "wolf/Gallop", "cow/Eating", "fox/Run")
Scores = Mapping[str, float]
UNITS = {"psnr": ("dB", "higher"), "lpips_alex": ("1", "lower"), "chamfer_relative": ("1", "lower")}


class Records:
    """Writes runs of the rows of `sweep-random`, each rig a little harder than the one before."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0
        self.spec = planning.with_choice("sweep-random", load_specs()["sweep-random"], planning.Choice())

    def row(self, label: str, protocol: str, scores: Scores, marks: tuple[str, ...] = (), seeds: int = 1) -> None:
        """Runs of all rigs: rig i scores as told, less i dB, plus i / 100 where less is better."""
        line = next(line for line in self.spec.rows if line.label == label)
        entry = planning.row_entry("sweep-random", line, self.spec, ())
        for index, case in enumerate(RIGS):
            for seed in range(seeds):
                self.count += 1
                found = {
                    name: Score(value + (-index if name == "psnr" else index / 100), *UNITS[name], 1)
                    for name, value in scores.items()
                }
                made = record(
                    run_id=f"{self.count:016d}", method=entry.method, case=case, seed=seed, preset="standard",
                    config=msgspec.to_builtins(entry.config), scores=found, prior={"choice": "template"},
                    protocol={**msgspec.to_builtins(load_protocols()[protocol]), "digest": "d"}, marks=list(marks),
                )  # fmt: skip
                write_record(made, self.folder / str(self.count))


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Under sweep `Ours` leads in all; under random D-3DGS* is behind in PSNR and ahead in LPIPS."""
    records = Records(tmp_path)
    sweep, random = (planning.newest_protocol(f"artemis-{name}-256") for name in ("sweep", "random"))
    records.row("Ours", sweep, {"psnr": 25.0, "lpips_alex": 0.10, "chamfer_relative": 0.010})
    records.row("D-3DGS*", sweep, {"psnr": 22.5, "lpips_alex": 0.14, "chamfer_relative": 0.013})
    records.row("Ours", random, {"psnr": 24.0, "lpips_alex": 0.12, "chamfer_relative": 0.010})
    records.row("D-3DGS*", random, {"psnr": 23.0, "lpips_alex": 0.11, "chamfer_relative": 0.010})
    seen = ("has seen the test frames",)
    records.row("GART* (20 bones)", sweep, {"psnr": 30.0, "lpips_alex": 0.01, "chamfer_relative": 0.001}, seen)
    return tmp_path


def difference(text: str) -> str:
    """The second of the two tables."""
    return text[text.index("difference to Ours") :]


def test_every_sign_is_the_row_less_the_reference(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = difference(output(capsys, "table", "sweep-random", "--runs", str(runs), "--against", "ours"))
    line = next(line for line in text.splitlines() if line.startswith("| D-3DGS* |"))
    # Rigs differ by whole dB, methods by the same on each of them: every interval is a point.
    assert [cell.strip() for cell in line.split("|")[2:-1]] == [
        f"−{25.0 - 22.5:.2f} [−2.50, −2.50]", f"+{0.14 - 0.10:.3f} [+0.040, +0.040]",
        f"+{0.013 - 0.010:.4f} [+0.0030, +0.0030]",
        f"−{24.0 - 23.0:.2f} [−1.00, −1.00]", f"**−{0.12 - 0.11:.3f} [−0.010, −0.010]**", "+0.0000 [+0.0000, +0.0000]",
    ]  # fmt: skip
    assert "| method | sweep PSNR, dB ↑ | sweep LPIPS-alex ↓ | sweep CD / diagonal ↓ | random PSNR, dB ↑ |" in text


def test_a_lead_is_marked_in_every_format(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("table", "sweep-random", "--runs", str(runs), "--against", "ours", "--format")
    assert difference(output(capsys, *words, "latex")).count(r"\textbf{") == 1
    assert difference(output(capsys, *words, "html")).count("<b>−0.010 [−0.010, −0.010]</b>") == 1
    lines = output(capsys, *words, "csv").split("\n\n")[1]
    rows = list(csv.DictReader(io.StringIO(lines)))
    found = {
        (row["condition"], row["score"]): (float(row["value"]), row["rank"])
        for row in rows
        if row["method"] == "D-3DGS*"
    }
    assert {key: mark for key, (_, mark) in found.items() if mark} == {("random", "lpips_alex"): "best"}
    assert found["sweep", "psnr"][0] == pytest.approx(22.5 - 25.0)
    assert found["sweep", "chamfer_relative"][0] == pytest.approx(0.013 - 0.010)


def test_an_advantage_is_told_apart_and_marks_nothing(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = difference(output(capsys, "table", "sweep-random", "--runs", str(runs), "--against", "ours"))
    rows = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")][2:]
    assert rows == ["D-3DGS", "D-3DGS*", "GART (20 bones)", "GART* (20 bones) [2]"]
    line = next(line for line in text.splitlines() if line.startswith("| GART*"))
    assert line.startswith(f"| GART* (20 bones) [2] | +{30.0 - 25.0:.2f} [+5.00, +5.00] | −0.090 [")
    assert "**" not in line and "[2] has seen the test frames" in text


def test_one_condition_alone(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("table", "artemis", "--protocol", "artemis-random-256", "--runs", str(runs), "--against", "ours")
    text = difference(output(capsys, *words))
    line = next(line for line in text.splitlines() if line.startswith("| D-3DGS* |"))
    cells = [cell.strip() for cell in line.split("|")[2:-1]]
    titles = load_specs()["artemis"].scores
    assert cells[titles.index("psnr")] == "−1.00 [−1.00, −1.00]"
    assert cells[titles.index("lpips_alex")] == "**−0.010 [−0.010, −0.010]**"
    assert cells[titles.index("fscore_1")] == "n/a [2]"
    assert f"[2] not computed: {planning.newest_protocol('artemis-random-256')} does not measure it" in text


def test_an_interval_that_holds_0_is_no_lead(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Better on three rigs and worse on the fourth: a mean of +1 dB, and an interval from below 0."""
    records = Records(tmp_path)
    protocol = planning.newest_protocol("artemis-sweep-256")
    records.row("Ours", protocol, {"psnr": 20.0})
    records.row("D-3DGS*", protocol, {"psnr": 22.0})
    worse = next(path for path in tmp_path.iterdir() if '"d3dgs-star"' in (path / "record.json").read_text())
    text = (worse / "record.json").read_text()
    made = msgspec.json.decode(text, type=type(record()))
    value = made.scores["psnr"].value or 0.0
    lowered = msgspec.structs.replace(made, scores={"psnr": Score(value - 4.0, "dB", "higher", 1)})
    write_record(lowered, worse)
    shown = difference(output(capsys, "table", "sweep-random", "--runs", str(tmp_path), "--against", "ours"))
    line = next(line for line in shown.splitlines() if line.startswith("| D-3DGS* |"))
    first = line.split("|")[2].strip()
    # Of draws of four rigs 31.6 % are without the bad one and 5.1 % have it three times or more, 0.4 % four times.
    assert (-2.0 * 3 + 2.0) / 4 == -1.0 and 0.75**4 > 0.025 and 4 * 0.25**3 * 0.75 + 0.25**4 > 0.025 > 0.25**4
    assert first == f"+{(3 * 2.0 - 2.0) / 4:.2f} [−1.00, +2.00]"


def test_a_preset_or_a_case_that_is_not_there_is_said(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bogus = "unknown preset 'bogus'. Available: beyond, paper, paper-short, quick, standard."
    assert bogus in refusal(capsys, "table", "sweep-random", "--runs", str(runs), "--preset", "bogus")
    page = str(runs / "page")
    assert bogus in refusal(capsys, "leaderboard", "build", "--runs", str(runs), "--out", page, "--preset", "bogus")
    cases = f"unknown case 'horse/Wal'. Did you mean 'horse/Walk'? Available: {', '.join(sorted(RIGS))}."
    for name in ((), ("sweep-random",)):
        assert cases in refusal(capsys, "table", *name, "--runs", str(runs), "--case", "horse/Wal")
    shown = output(capsys, "table", "--runs", str(runs), "--case", "*o*/*a*")
    assert "| horse/Walk |" in shown and "| fox/Run |" not in shown and "| wolf/Gallop |" in shown
