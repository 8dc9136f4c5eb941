"""Writers of tables: Markdown, LaTeX (booktabs), HTML and CSV.

pandas writes the CSV. Its Styler has no place for rules between kinds of rows, numbered notes and sort values, and
`DataFrame.to_markdown` needs another package, so that the three formats for people are joined here.
"""

import html as escaping
import re
from collections.abc import Callable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

from rewild4d.leaderboard.layout import Cell, Row, Table

if TYPE_CHECKING:
    import pandas as pd

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
"""Ends of lines, which end a table, and what a terminal takes for commands."""
_UNNAMED = re.compile(r"[^A-Za-z0-9:._-]+")
"""What no label of LaTeX has."""
EDGE = ' class="edge"'
ARROWS = {"higher": "↑", "lower": "↓", "": ""}
TEX_SIGNS = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
    "−": "$-$", "—": "---", "·": r"$\cdot$", "⊕": r"$\oplus$", "<": "$<$", ">": "$>$",
})  # fmt: skip


def markdown(table: Table) -> str:
    """Write GitHub's Markdown; it has no underline, so the second best is in italics."""
    heads = [*table.stubs, *(" ".join(filter(None, (c.group, c.title, ARROWS[c.better]))) for c in table.columns)]
    heads = [plain(head) for head in heads]
    ruler = ["---"] * len(table.stubs) + ["---:"] * len(table.columns)
    rows = [heads, ruler, *([*stubs, *cells] for _, stubs, cells in _MARKDOWN.rows(table))]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    caption = f"**{plain(table.title)}**" + (f" ({plain(table.caption)})" if table.caption else "")
    return "\n".join([caption, "", *lines, *(f"\n{line}" for line in _MARKDOWN.notes(table))])


def latex(table: Table) -> str:
    """Write a table float with booktabs rules; needs no package but booktabs."""
    heads = [*table.stubs, *(f"{column.title} {ARROWS[column.better]}".strip() for column in table.columns)]
    lines = [
        r"\begin{table}", r"\centering\small\setlength{\tabcolsep}{4pt}",
        rf"\caption{{{_tex(table.title)}. {_tex(table.caption)}}}",
        rf"\label{{tab:{_UNNAMED.sub('-', table.name)}}}",
        rf"\begin{{tabular}}{{{'l' * len(table.stubs)}{'r' * len(table.columns)}}}",
        r"\toprule", *_latex_groups(table), " & ".join(map(_tex, heads)) + r" \\",
    ]  # fmt: skip
    # Rules stand between cases, and in a table without cases between kinds of rows.
    cases = len(table.stubs) > 1
    for _, rows in groupby(_LATEX.rows(table), key=lambda found: found[0].stubs[0] if cases else found[0].kind):
        lines += [r"\midrule", *(" & ".join([*stubs, *cells]) + r" \\" for _, stubs, cells in rows)]
    notes = [rf"\par\smallskip\raggedright\footnotesize {line}" for line in _LATEX.notes(table)]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", *notes, r"\end{table}"])


def html(table: Table) -> str:
    """Write a table element; cells carry their value in `data-value`, so that a page can sort by it."""
    edges = [EDGE if title and place == 0 else "" for title, span in table.groups for place in range(span)]
    head = [f"<th>{_text(stub)}</th>" for stub in table.stubs]
    head += [
        f'<th{edge} data-better="{column.better}">{_text(column.title)} {ARROWS[column.better]}</th>'
        for edge, column in zip(edges, table.columns, strict=True)
    ]
    lines = [
        f'<table id="{_text(table.name)}">',
        f"<caption><span><b>{_text(table.title)}.</b> {_text(table.caption)}</span></caption>",
        "<thead>",
    ]
    if any(title for title, _ in table.groups):
        over = "".join(f'<th{EDGE} colspan="{span}">{_text(title)}</th>' for title, span in table.groups)
        lines.append(f'<tr><th colspan="{len(table.stubs)}"></th>{over}</tr>')
    lines += [f'<tr class="heads">{"".join(head)}</tr>', "</thead>", "<tbody>"]
    for row, stubs, cells in _HTML.rows(table):
        stubs[-1] += "".join(f' <small class="flag">{_text(flag.partition(":")[0])}</small>' for flag in row.flags)
        values = ["" if cell.value is None else f' data-value="{cell.value:.9g}"' for cell in row.cells]
        shown = [f"<td>{stub}</td>" for stub in stubs]
        shown += [f"<td{edge}{value}>{cell}</td>" for edge, value, cell in zip(edges, values, cells, strict=True)]
        lines.append(f'<tr class="{row.kind}">{"".join(shown)}</tr>')
    return "\n".join([*lines, "</tbody>", "</table>", *(f'<p class="note">{line}</p>' for line in _HTML.notes(table))])


def tidy_frame(table: Table) -> "pd.DataFrame":
    """Make a data frame with a row a figure; low and high are the ends of a difference's interval."""
    import pandas as pd

    heads = [*(stub or "row" for stub in table.stubs), "kind", "condition", "score", "better"]
    rows = [
        [*row.stubs, row.kind, column.group, column.score or column.title, column.better,
         cell.text if cell.value is None and not column.score else cell.value, cell.deviation,
         *(cell.interval or (None, None)), cell.mark, "; ".join(filter(None, (*row.notes, cell.note)))]
        for row in table.rows for column, cell in zip(table.columns, row.cells, strict=True)
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=[*heads, "value", "spread", "low", "high", "rank", "note"])


def tidy_csv(table: Table) -> str:
    """Write one line a figure, for programs; see `tidy_frame`."""
    return tidy_frame(table).to_csv(index=False, lineterminator="\n").rstrip("\n")


FORMATS: dict[str, Callable[[Table], str]] = {"md": markdown, "latex": latex, "html": html, "csv": tidy_csv}


class _Style(NamedTuple):
    """Patterns of a format, one %s each: around a figure, behind it, a note's number, around the title of a mean."""

    best: str
    second: str
    spread: str
    number: str
    before_number: str
    summary: str
    text: Callable[[str], str]

    def rows(self, table: Table) -> Iterator[tuple[Row, list[str], list[str]]]:
        """Yield each row with its stubs and its cells as they are printed."""
        for row in table.rows:
            stubs = [self.text(stub) for stub in row.stubs]
            stubs[0] = self.summary % stubs[0] if row.summary else stubs[0]
            stubs[-1] += self._numbers(table.number(*row.notes))
            yield row, stubs, [self._cell(cell, table) for cell in row.cells]

    def notes(self, table: Table) -> list[str]:
        """List the numbered notes, then the remarks."""
        numbered = [f"{self.number % number} {self.text(note)}" for number, note in enumerate(table.notes, 1)]
        return [*numbered, *map(self.text, table.remarks)]

    def _cell(self, cell: Cell, table: Table) -> str:
        figure = {"best": self.best, "second": self.second, "": "%s"}[cell.mark] % self.text(cell.text)
        return figure + (self.spread % cell.spread if cell.spread else "") + self._numbers(table.number(cell.note))

    def _numbers(self, numbers: str) -> str:
        return self.before_number + self.number % numbers if numbers else ""


def _latex_groups(table: Table) -> list[str]:
    """Write the line of group titles, with a rule under each."""
    if not any(title for title, _ in table.groups):
        return []
    cells, rules, start = [" & " * (len(table.stubs) - 1)], [], len(table.stubs) + 1
    for title, span in table.groups:
        cells.append(rf"\multicolumn{{{span}}}{{c}}{{{_tex(title)}}}")
        if title:
            rules.append(rf"\cmidrule(lr){{{start}-{start + span - 1}}}")
        start += span
    return [" & ".join(cells) + r" \\", " ".join(rules)]


def plain(text: str) -> str:
    """Escape what Markdown would take for markup: HTML, entities, links, a code span without end. Code spans stay."""
    text = _CONTROL.sub(" ", text)
    links = re.search(r"\][(\[:]", text) is not None
    parts = [text] if "``" in text else re.split("(`[^`]+`)", text)
    for place, part in enumerate(parts[::2]):
        part = re.sub(r"\\(?=[!-/:-@\[-`{-~]|$)", r"\\\\", part)
        part = re.sub(r"&(?=#?\w+;)", "&amp;", part).replace("<", "&lt;").replace("`", "\\`")
        parts[2 * place] = part.replace("[", "\\[") if links else part
    return "".join(parts)


def _tex(text: str) -> str:
    coded = re.sub("`([^`]*)`", r"\\texttt{\1}", _CONTROL.sub(" ", text).translate(TEX_SIGNS))
    return re.sub('"([^"]*)"', r"``\1''", coded)


def _text(text: str) -> str:
    return re.sub("`([^`]*)`", r"<code>\1</code>", escaping.escape(text))


_MARKDOWN = _Style("**%s**", "_%s_", " ± %s", "[%s]", " ", "**%s**", plain)
_LATEX = _Style(
    r"\textbf{%s}", r"\underline{%s}", r" {\scriptsize $\pm$ %s}", r"\textsuperscript{%s}", "", r"\textbf{%s}", _tex
)
_HTML = _Style("<b>%s</b>", "<u>%s</u>", " <small>± %s</small>", "<sup>%s</sup>", "", "%s", _text)
