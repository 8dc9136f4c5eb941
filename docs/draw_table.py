"""Draw a table of the leaderboard as LaTeX sets it: its source and a picture of the compiled page, side by side.

    python docs/draw_table.py artemis --runs results/2026-11-23-artemis-standard

writes docs/tables/artemis.tex (what `rewild4d-bench table artemis --format latex` prints) and docs/tables/artemis.png.
All words behind the name go to `rewild4d-bench table`. Needs pdflatex with booktabs (Debian: texlive-latex-recommended)
and pdftoppm (poppler-utils).
"""

import math
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageChops

FOLDER = Path(__file__).resolve().parent / "tables"
DOCUMENT = r"""\documentclass{article}
\usepackage[paperwidth=%dpt,paperheight=60cm,margin=30pt]{geometry}
\usepackage{booktabs}
\pagestyle{empty}
\setlength{\belowcaptionskip}{6pt}
\makeatletter\setlength{\@fptop}{0pt}\setlength{\@fpsep}{24pt}\makeatother
\begin{document}
%s
\end{document}
"""
WIDTH = 600
"""Of the page in points; a wider table gets a wider page."""
DOTS_PER_INCH = 130
BORDER = 16


def main(words: list[str]) -> int:
    missing = [name for name in ("pdflatex", "pdftoppm") if shutil.which(name) is None]
    if missing or not words or words[0].startswith("-"):
        print(__doc__ if not missing else f"expected {' and '.join(missing)} on the PATH, found none.", file=sys.stderr)
        return 2
    command = ["table", words[0], "--format", "latex", *words[1:]]
    start = "from rewild4d.cli import main; main()"
    source = subprocess.run([sys.executable, "-c", start, *command], stdout=subprocess.PIPE, text=True, check=False)
    if source.returncode:
        return source.returncode
    FOLDER.mkdir(exist_ok=True)
    said = "% " + " ".join(["rewild4d-bench", *command]) + "\n"
    (FOLDER / f"{words[0]}.tex").write_text(said + source.stdout, encoding="utf-8")
    compile_picture(source.stdout, FOLDER / f"{words[0]}.png")
    print(FOLDER / f"{words[0]}.png")
    return 0


def compile_picture(source: str, path: Path) -> None:
    """Compile the source, cut the page to what is on it, write it as a PNG of few colours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        width = WIDTH + too_wide(source, WIDTH, folder)
        too_wide(source, width, folder)
        subprocess.run(
            ["pdftoppm", "-r", str(DOTS_PER_INCH), "-png", "-singlefile", "table.pdf", "table"], cwd=folder, check=True
        )
        with Image.open(folder / "table.png") as page:
            grey = page.convert("L")
    left, top, right, bottom = ImageChops.invert(grey).getbbox() or (0, 0, *grey.size)
    cut = grey.crop((left - BORDER, top - BORDER, right + BORDER, bottom + BORDER))
    cut.quantize(16).save(path, optimize=True)


def too_wide(source: str, width: int, folder: Path) -> int:
    """Compile to ``folder/table.pdf`` on a page of that width; by how many points it was too narrow."""
    (folder / "table.tex").write_text(DOCUMENT % (width, source), encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "table.tex"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        raise SystemExit("pdflatex: " + "\n".join(line for line in done.stdout.splitlines() if line[:1] == "!"))
    return max([0, *(math.ceil(float(over)) for over in re.findall(r"Overfull .hbox \(([0-9.]+)pt", done.stdout))])


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
