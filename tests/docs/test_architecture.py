"""Rooms import from the lines below their own in docs/architecture.md, and from nothing above."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
LINES = re.findall(r"^ {4}(\w+(?:, \w+)*)$", TEXT.partition("## Direction of imports")[2], re.MULTILINE)
FLOOR = {room: len(LINES) - number for number, line in enumerate(LINES) for room in line.split(", ")}
TOP = ("baselines", "datasets", "leaderboard", "metrics")


def room_of(module: str) -> str:
    """The room of a module, "rewild4d.metrics.image" -> "metrics"; a module at the root is of the ground."""
    name = module.split(".")[1]
    return "commands" if name in ("cli", "__main__") else name if name in FLOOR else "ground"


def imported(path: Path) -> set[str]:
    """Rooms that a source imports from, also inside functions."""
    found = [node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.ImportFrom)]
    modules = [node.module for node in found if node.module and node.module.startswith("rewild4d.")]
    return {room_of(module) for module in modules}


@pytest.mark.parametrize("folder", ["rewild4d", *TOP])
def test_imports_go_down(folder: str) -> None:
    for path in sorted((ROOT / folder).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        room = room_of(".".join(("rewild4d", *parts) if folder in TOP else parts))
        above = {other for other in imported(path) if other != room and FLOOR[other] >= max(2, FLOOR[room])}
        assert not above, f"{path.relative_to(ROOT)} ({room}) imports {', '.join(sorted(above))}"
    assert set(TOP) < set(FLOOR)


def test_the_ground_is_small() -> None:
    modules = [
        path.name for path in (ROOT / "rewild4d").glob("*.py") if path.name not in ("__init__.py", "__main__.py")
    ]
    assert len(modules) <= 12, "a new module belongs into a room"
