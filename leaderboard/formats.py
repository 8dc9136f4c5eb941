"""Writers of tables: Markdown, LaTeX (booktabs), HTML and CSV.

Own code: ranks that mind the spread, notes by number and rows that compete with nobody have to be laid out first in any
case, and what pandas' Styler would then save are the lines that join cells, for another half second of every start.
"""

import csv
import html as escaping
import io
import re
from collections.abc import Callable, Iterator
from itertools import groupby

from rewild4d.leaderboard.layout import Cell, Column, Row, Table

EDGE = ' class="edge"'
ARROWS = {"higher": "↑", "lower": "↓", "": ""}


def markdown(table: Table) -> str:
    """GitHub's Markdown; underlining is what it has no sign for, so the second is in italics."""
    heads = [*table.stubs, *(_head(column, " ") for column in table.columns)]
    ruler = ["---"] * len(table.stubs) + [
        "---:" if column.better or column.score else "---:" for column in table.columns
    ]
    rows = [
        [*_first_with(row, table, " [{}]"), *(_markdown_cell(cell, table) for cell in row.cells)] for row in table.rows
    ]
    lines = ["| " + " | ".join(_no_bars(row)) + " |" for row in [heads, ruler, *rows]]
    notes = [f"[{number}] {note}" for number, note in enumerate(table.notes, 1)]
    caption = f"**{table.title}**" + (f" ({table.caption})" if table.caption else "")
    return "\n".join([caption, "", *lines, *(f"\n{line}" for line in [*notes, *table.remarks])])


def latex(table: Table) -> str:
    """A table float with booktabs rules; needs no package but booktabs."""
    groups = [(group, len(list(columns))) for group, columns in groupby(table.columns, key=lambda column: column.group)]
    heads = [*table.stubs, *(f"{column.title} {ARROWS[column.better]}".strip() for column in table.columns)]
    lines = [
        r"\begin{table}", r"\centering\small\setlength{\tabcolsep}{4pt}",
        rf"\caption{{{_tex(table.title)}. {_tex(table.caption)}}}",
        rf"\label{{tab:{table.name}}}", rf"\begin{{tabular}}{{{'l' * len(table.stubs)}{'r' * len(table.columns)}}}",
        r"\toprule", *_latex_groups(groups, len(table.stubs)), " & ".join(map(_tex, heads)) + r" \\",
    ]  # fmt: skip
    for _, rows in groupby(table.rows, key=lambda row: row.kind):
        lines.append(r"\midrule")
        for row in rows:
            stubs = [_tex(stub) for stub in row.stubs]
            stubs[0] = rf"\textbf{{{stubs[0]}}}" if row.summary else stubs[0]
            stubs[-1] += _tex_number(table.number(*row.notes))
            lines.append(" & ".join([*stubs, *(_latex_cell(cell, table) for cell in row.cells)]) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}"]
    notes = [f"{_tex_number(str(number))} {_tex(note)}" for number, note in enumerate(table.notes, 1)]
    lines += [rf"\par\smallskip\raggedright\footnotesize {line}" for line in [*notes, *map(_tex, table.remarks)]]
    return "\n".join([*lines, r"\end{table}"])


def html(table: Table) -> str:
    """A table element; cells carry their value in `data-value`, so that a page can sort by it."""
    groups = [(group, len(list(columns))) for group, columns in groupby(table.columns, key=lambda column: column.group)]
    edges = _edges(groups)
    columns = zip(edges, table.columns, strict=True)
    head = [*(f"<th>{_text(stub)}</th>" for stub in table.stubs), *(_html_head(*column) for column in columns)]
    lines = [
        f'<table id="{_text(table.name)}">',
        f"<caption><span><b>{_text(table.title)}.</b> {_text(table.caption)}</span></caption>",
        "<thead>",
    ]
    if any(group for group, _ in groups):
        over = "".join(f'<th{EDGE} colspan="{span}">{_text(group)}</th>' for group, span in groups)
        lines.append(f'<tr><th colspan="{len(table.stubs)}"></th>{over}</tr>')
    lines += [f'<tr class="heads">{"".join(head)}</tr>', "</thead>", "<tbody>"]
    for row in table.rows:
        stubs = [f"<td>{_text(stub)}</td>" for stub in row.stubs]
        number = table.number(*row.notes)
        flags = "".join(f' <small class="flag">{_text(flag.partition(":")[0])}</small>' for flag in row.flags)
        stubs[-1] = f"<td>{_text(row.stubs[-1])}{f'<sup>{number}</sup>' if number else ''}{flags}</td>"
        cells = [_html_cell(edge, cell, table) for edge, cell in zip(edges, row.cells, strict=True)]
        lines.append(f'<tr class="{row.kind}">{"".join(stubs + cells)}</tr>')
    lines += ["</tbody>", "</table>"]
    notes = [f"<sup>{number}</sup> {_text(note)}" for number, note in enumerate(table.notes, 1)]
    return "\n".join([*lines, *(f'<p class="note">{line}</p>' for line in [*notes, *map(_text, table.remarks)])])


def tidy_csv(table: Table) -> str:
    """One line a figure, for programs; low and high are the ends of a difference's interval."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    stubs = [stub or "row" for stub in table.stubs]
    writer.writerow([*stubs, "kind", "condition", "score", "better", "value", "spread", "low", "high", "rank", "note"])
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            value = cell.text if cell.value is None and not column.score else cell.value
            notes = "; ".join(note for note in (*row.notes, cell.note) if note)
            writer.writerow([*row.stubs, row.kind, column.group, column.score or column.title, column.better,
                             value, cell.deviation, *(cell.interval or (None, None)), cell.mark, notes])  # fmt: skip
    return out.getvalue().rstrip("\n")


FORMATS: dict[str, Callable[[Table], str]] = {"md": markdown, "latex": latex, "html": html, "csv": tidy_csv}


def _head(column: Column, between: str) -> str:
    words = [column.group, column.title, ARROWS[column.better]]
    return between.join(word for word in words if word)


def _first_with(row: Row, table: Table, pattern: str) -> list[str]:
    """The stubs, the first bold where the row sums up others, the numbers of the row's notes behind the last."""
    number = table.number(*row.notes)
    stubs = [f"**{row.stubs[0]}**" if row.summary else row.stubs[0], *row.stubs[1:]]
    return [*stubs[:-1], stubs[-1] + (pattern.format(number) if number else "")]


def _no_bars(cells: list[str]) -> Iterator[str]:
    return (cell.replace("|", "\\|").replace("\n", " ") for cell in cells)


def _markdown_cell(cell: Cell, table: Table) -> str:
    frame = {"best": "**{}**", "second": "_{}_", "": "{}"}[cell.mark]
    spread = f" ± {cell.spread}" if cell.spread else ""
    number = table.number(cell.note)
    return frame.format(cell.text) + spread + (f" [{number}]" if number else "")


def _latex_groups(groups: list[tuple[str, int]], stubs: int) -> list[str]:
    """The line of group titles, with a rule under each."""
    if not any(group for group, _ in groups):
        return []
    cells, rules, start = [" & " * (stubs - 1)], [], stubs + 1
    for group, span in groups:
        cells.append(rf"\multicolumn{{{span}}}{{c}}{{{_tex(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{start}-{start + span - 1}}}")
        start += span
    return [" & ".join(cells) + r" \\", " ".join(rules)]


def _latex_cell(cell: Cell, table: Table) -> str:
    frame = {"best": r"\textbf{%s}", "second": r"\underline{%s}", "": "%s"}[cell.mark]
    spread = rf" {{\scriptsize $\pm$ {cell.spread}}}" if cell.spread else ""
    return frame % _tex(cell.text) + spread + _tex_number(table.number(cell.note))


def _tex_number(number: str) -> str:
    return rf"\textsuperscript{{{number}}}" if number else ""


def _tex(text: str) -> str:
    signs = {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
        "−": "$-$", "·": r"$\cdot$", "⊕": r"$\oplus$", "<": "$<$", ">": "$>$",
    }  # fmt: skip
    escaped = "".join(signs.get(letter, letter) for letter in text)
    coded = re.sub("`([^`]*)`", r"\\texttt{\1}", escaped)
    return re.sub('"([^"]*)"', r"``\1''", coded)


def _edges(groups: list[tuple[str, int]]) -> list[str]:
    """Of each column, the attribute that draws a line before it where a group begins."""
    return [EDGE if group and place == 0 else "" for group, span in groups for place in range(span)]


def _html_head(edge: str, column: Column) -> str:
    return f'<th{edge} data-better="{column.better}">{_text(column.title)} {ARROWS[column.better]}</th>'


def _html_cell(edge: str, cell: Cell, table: Table) -> str:
    value = "" if cell.value is None else f' data-value="{cell.value:.9g}"'
    shown = {"best": "<b>{}</b>", "second": "<u>{}</u>", "": "{}"}[cell.mark].format(_text(cell.text))
    spread = f" <small>± {_text(cell.spread)}</small>" if cell.spread else ""
    number = table.number(cell.note)
    return f"<td{edge}{value}>{shown}{spread}{f'<sup>{number}</sup>' if number else ''}</td>"


def _text(text: str) -> str:
    return re.sub("`([^`]*)`", r"<code>\1</code>", escaping.escape(text))
