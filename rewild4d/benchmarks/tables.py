"""Format a result as Markdown tables; ratios are computed from its rows."""

import math
from collections.abc import Sequence

from rewild4d.benchmarks.results import BOTH, FLOOR, FORWARD, OURS, Result, Row

KERNELS = "step, preset "
"""Prefix of quantities that are timed with fused kernels switched off."""


def markdown(result: Result) -> str:
    """Format a result: where it was measured, and its tables."""
    tables = {"rasterizer": _raster_tables, "step": _step_tables}[result.benchmark](result.rows)
    timed = [row for row in result.rows if row.unit == "ms" and row.value is not None]
    notes = list(dict.fromkeys(f"{row.subject}: {row.note}." for row in timed if row.note))
    return "\n\n".join([_header(result), *tables, *notes])


def _header(result: Result) -> str:
    machine = result.machine
    names = ("python", "torch", "numpy", "numba", "triton")
    versions = {name: machine[name] for name in names if name in machine} | result.peers
    processor = ", ".join(machine[name] for name in ("gpu", "processor") if name in machine) or "an unknown processor"
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    return (
        f"**bench {result.benchmark}** on {processor}, "
        f"{machine.get('system', '')}, {_plural(result.threads, 'thread')}; {listed}; "
        f"rewild4d {result.code['version']} ({result.code['sources']}); {result.started}"
    )


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _raster_tables(rows: Sequence[Row]) -> list[str]:
    """Tabulate the scenes with ours and the lower bound, then the peers, then the probes."""
    scenes = dict.fromkeys(_scene_of(row) for row in rows if row.quantity == FORWARD)
    peers = [name for name in dict.fromkeys(row.subject for row in rows if row.quantity == FORWARD)
             if name not in (OURS, FLOOR)]  # fmt: skip
    ours = _table(
        ["Gaussians", "image", "useful blends", "forward, ms", "forward+backward, ms", "bound forward, ms",
         "bound forward+backward, ms", "GFLOP/s", "forward / bound", "forward+backward / bound"],
        [
            [*_scene_cells(scene), *(
                _number(_find(rows, subject, quantity, scene))
                for subject, quantity in (("scene", "useful blends"), (OURS, FORWARD), (OURS, BOTH), (FLOOR, FORWARD),
                                          (FLOOR, BOTH), (FLOOR, "multiply-adds"))
            ), *(_ratio(_find(rows, OURS, quantity, scene), _find(rows, FLOOR, quantity, scene))
                 for quantity in (FORWARD, BOTH))]
            for scene in scenes
        ],
    )  # fmt: skip
    against = _table(
        ["Gaussians", "image", "peer", "forward, ms", "forward+backward, ms", "forward / ours",
         "forward+backward / ours", "PSNR against ours, dB"],
        [[*_scene_cells(scene), peer, *_against(rows, peer, scene)] for scene in scenes for peer in peers],
    )  # fmt: skip
    alone = [row for row in rows if row.subject == OURS and row.quantity not in (FORWARD, BOTH)]
    return [ours, *([against] if peers else []), *([_list(alone)] if alone else [])]


def _against(rows: Sequence[Row], peer: str, scene: tuple[int | None, int | None]) -> list[str]:
    """Return the cells of a peer: times, ratios to ours, PSNR; or the reason why it is not timed."""
    forward, both = (_find(rows, peer, quantity, scene) for quantity in (FORWARD, BOTH))
    parity = _number(_find(rows, peer, "PSNR against rewild4d", scene))
    if forward is not None and forward.value is None:
        return [forward.note, "", "", "", parity]
    ratios = _ratio(forward, _find(rows, OURS, FORWARD, scene)), _ratio(both, _find(rows, OURS, BOTH, scene))
    return [_number(forward), _number(both), *ratios, parity]


def _step_tables(rows: Sequence[Row]) -> list[str]:
    """Tabulate times of steps and frames, and the operators of each image side."""
    timed = [row for row in rows if row.unit == "ms" and not row.quantity.startswith(KERNELS)]
    times = _table(
        ["what", "whose", "Gaussians", "image", "ms", "least, ms", "quartiles apart, ms", "a second"],
        [
            [row.quantity, row.subject, *_scene_cells(_scene_of(row)), _number(row), _text(row.minimum),
             _text(row.spread), _text(1000 / row.value if row.value else None)]
            for row in timed
        ],
    )  # fmt: skip
    shares = [row for row in rows if row.quantity == "share of a step"]
    tables = []
    for size in dict.fromkeys(row.size for row in shares):
        chosen = [row for row in shares if row.size == size]
        lines = [[row.subject, f"{100 * (row.value or 0):.1f} %", row.note] for row in chosen]
        tables.append(_table([f"operator, at {size}²", "own time", "how often"], lines))
    memory = [row for row in rows if row.quantity == "peak memory"]
    switched = [row for row in rows if row.quantity.startswith(KERNELS)]
    tables += [_kernel_table(group) for name in dict.fromkeys(row.quantity for row in switched)
               if (group := [row for row in switched if row.quantity == name])]  # fmt: skip
    return [times, *tables, *([_list(memory)] if memory else [])]


def _kernel_table(rows: Sequence[Row]) -> str:
    """Tabulate steps of one preset with each fused kernel switched off alone."""
    base = rows[0].value or math.nan
    lines = [
        [row.subject, *_scene_cells(_scene_of(row)), _number(row), f"{(row.value or math.nan) - base:+.2f}",
         f"{(row.value or math.nan) / base:.2f} x"]
        for row in rows
    ]  # fmt: skip
    return _table([rows[0].quantity, "Gaussians", "image", "ms", "more than with all, ms", "of all kernels"], lines)


def _list(rows: Sequence[Row]) -> str:
    """Tabulate single numbers."""
    return _table(
        ["what", "Gaussians", "image", "value", "note"],
        [[row.quantity, *_scene_cells(_scene_of(row)), _with_unit(row), row.note] for row in rows],
    )


def _scene_of(row: Row) -> tuple[int | None, int | None]:
    return row.gaussians, row.size


def _scene_cells(scene: tuple[int | None, int | None]) -> list[str]:
    count, size = scene
    return ["" if count is None else f"{count:,}", "" if size is None else f"{size}²"]


def _find(rows: Sequence[Row], subject: str, quantity: str, scene: tuple[int | None, int | None]) -> Row | None:
    wanted = (subject, quantity, scene)
    return next((row for row in rows if (row.subject, row.quantity, _scene_of(row)) == wanted), None)


def _ratio(row: Row | None, base: Row | None) -> str:
    if row is None or base is None or row.value is None or not base.value:
        return ""
    return f"{_text(row.value / base.value)} x"


def _with_unit(row: Row) -> str:
    return _number(row) + ("" if row.unit == "1" else f" {row.unit}")


def _number(row: Row | None) -> str:
    if row is None:
        return ""
    if row.unit == "1" and row.value is not None and row.value == round(row.value):
        return f"{row.value:,.0f}"  # a count
    return _text(row.value)


def _text(value: float | None) -> str:
    """Format three significant digits, or all integer digits."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:#.3g}".rstrip(".") if value else "0"


def _table(head: list[str], lines: list[list[str]]) -> str:
    """Format a table; columns that hold a number are right-aligned."""
    columns = zip(*lines, strict=True) if lines else [()] * len(head)
    rule = ["---:" if any(cell[:1].isdigit() for cell in column) else "---" for column in columns]
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, rule, *lines])
