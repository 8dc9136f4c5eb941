"""Build hooks of the site: collect the package for mkdocstrings, and turn percent scripts into pages with outputs."""

import ast
import base64
import contextlib
import io
import re
import shutil
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
COLLECTED = ROOT / "build" / "docs" / "rewild4d"
CELL = re.compile(r"^# %%(.*)$", re.MULTILINE)


def on_startup(command: str, dirty: bool) -> None:
    """Copy the package and the folders that install below it, before mkdocstrings looks for `rewild4d.metrics`."""
    shutil.rmtree(COLLECTED, ignore_errors=True)
    sources = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "rewild4d", COLLECTED, ignore=sources)
    for name in ("baselines", "datasets", "leaderboard", "metrics"):
        shutil.copytree(ROOT / name, COLLECTED / name, ignore=sources)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for every script of docs/notebooks."""
    for script in sorted((ROOT / "docs" / "notebooks").glob("*.py")):
        text = page(script.read_text(encoding="utf-8"), f"docs/notebooks/{script.name}")
        files.append(File.generated(config, f"notebooks/{script.stem}.md", content=text))
    return files


def page(script: str, name: str) -> str:
    """Write a percent script as Markdown, each code cell with its output; the cells run in the repository's root."""
    title, parts, scope = "", [f"*This page is `{name}`, run when the site was built.*"], {"__name__": "__main__"}
    with contextlib.chdir(ROOT):
        for kind, body in cells(script):
            text = re.sub(r"^# ?", "", body, flags=re.MULTILINE) if kind == "markdown" else f"```python\n{body}\n```"
            if not title:
                title, _, text = text.partition("\n")
            parts += [text.strip(), *(run(body, scope) if kind == "code" else [])]
    return "\n\n".join([title, *parts]) + "\n"


def cells(script: str) -> list[tuple[str, str]]:
    """Split a percent script into ("markdown" or "code", body) pairs."""
    heads = list(CELL.finditer(script))
    ends = [head.start() for head in heads[1:]] + [len(script)]
    pairs = [(head[1], script[head.end() : end].strip()) for head, end in zip(heads, ends, strict=True)]
    return [("markdown" if "[markdown]" in title else "code", body) for title, body in pairs if body]


def run(body: str, scope: dict[str, Any]) -> list[str]:
    """Run one cell as a notebook does and return what it prints and shows, as Markdown."""
    tree = ast.parse(body)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "<cell>", "exec"), scope)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), scope)
    shown = [f"```text\n{printed.getvalue().rstrip()}\n```"] if printed.getvalue().strip() else []
    return shown if value is None else [*shown, show(value)]


def show(value: Any) -> str:
    """Write a value as a notebook shows it: a picture, a table, or its text."""
    if hasattr(value, "savefig"):
        picture = io.BytesIO()
        value.savefig(picture, format="png", dpi=80)
        return f"![output](data:image/png;base64,{base64.b64encode(picture.getvalue()).decode()})"
    if hasattr(value, "to_html"):
        return re.sub(r'\n\s*| class="dataframe"| style="[^"]*"', "", value.to_html(border=0))
    return f"```text\n{value!r}\n```"
