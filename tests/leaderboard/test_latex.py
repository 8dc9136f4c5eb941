"""The LaTeX form compiles, odd names and all, and the docs' pictures are of what the command prints."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from records_for_tests import psnr, record

from rewild4d.leaderboard.formats import latex
from rewild4d.leaderboard.specs import Reported, ReportedRow
from rewild4d.leaderboard.tables import Entrant, Frame, difference_table, named_table

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = r"\documentclass{article}\usepackage{booktabs}\begin{document}%s\end{document}"
no_tex = pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here: LaTeX is not compiled")


@no_tex
def test_every_sign_compiles(tmp_path: Path) -> None:
    odd = 'a|b_c & 100 % <x> #1 {\\y} $z$ ~^ ± ↑ ↓ − · ⊕ "q" `code_1`'
    frame = Frame("t_1", odd, odd, ("one & all", "two_2"), ("psnr",), (odd,))
    runs = [(record(case=case, scores=psnr(value)),) for case, value in (("a", 20.0), ("b", 21.0))]
    marked = (record(case="a", scores=psnr(9.0), marks=[odd]),)
    rows = [Entrant(odd, (runs[0], runs[1])), Entrant("Ours", (runs[0], ())), Entrant("seen", (marked, ()), "", (odd,))]
    cells = {"one & all/psnr": -1.0, "two_2/psnr": None}
    reported = Reported(source=odd, note=odd, rows=(ReportedRow(label=odd, cells=cells),))
    source = latex(named_table(frame, rows, reported)) + "\n\n" + latex(difference_table(frame, rows, "ours"))
    (tmp_path / "t.tex").write_text(DOCUMENT % source)
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"],
        cwd=tmp_path, capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    assert done.returncode == 0, re.findall("^!.*", done.stdout, re.MULTILINE)
    assert "Output written on t.pdf" in done.stdout and "Missing character" not in done.stdout


def test_the_source_in_the_docs_is_what_its_command_prints() -> None:
    for path in sorted((ROOT / "docs" / "tables").glob("*.tex")):
        first, _, source = path.read_text().partition("\n")
        assert path.with_suffix(".png").is_file()
        words = first.removeprefix("% rewild4d-bench ").split()
        printed = subprocess.check_output(
            [sys.executable, "-c", "from rewild4d.cli import main; main()", *words], cwd=ROOT, text=True
        )
        assert printed == source, f"{path.name}: draw it again: python docs/draw_table.py {path.stem} ..."
