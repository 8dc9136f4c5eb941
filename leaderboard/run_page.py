"""What a page says of a run: its scores, and where it comes from; and what stands in the head of every page."""

import base64
import hashlib
from collections.abc import Iterator
from importlib import resources
from typing import Any

from markupsafe import Markup

from rewild4d.leaderboard.cells import cell
from rewild4d.leaderboard.curves import curve, moments
from rewild4d.leaderboard.formats import ARROWS
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.tables import columns_of
from rewild4d.leaderboard.variants import flat, scores_of


def template(name: str) -> str:
    """Return the text of a file in `templates`."""
    return (resources.files("rewild4d.leaderboard") / "templates" / name).read_text(encoding="utf-8")


def page_head(policy: str, style: str, script: str) -> dict[str, Any]:
    """Return what `page.html` asks for: style, script, and the policy that lets a browser use these two alone.

    Args:
        policy: a Content-Security-Policy with places for the digests, "{style}" and "{script}".
        style: CSS.
        script: JavaScript; "" for none.
    """
    texts = {"style": style, "script": script}
    digests = {name: base64.b64encode(hashlib.sha256(text.encode()).digest()) for name, text in texts.items()}
    filled = policy.format(**{name: f"'sha256-{value.decode()}'" for name, value in digests.items()})
    return {"policy": filled, **{name: Markup(text) for name, text in texts.items()}}


def score_rows(record: RunRecord) -> Iterator[dict[str, Any]]:
    """Yield each score for `run.html`, with a curve where it has values at several moments."""
    names = [name for name in scores_of([record]) if name in record.scores]
    for column in columns_of([record], names):
        score = record.scores[column.score]
        points = moments(score, record.items)
        made = cell([record], [record.case], column.score)
        yield {
            "title": f"{column.title.partition(',')[0]} {ARROWS[column.better]}", "score": score,
            "text": made.text, "note": score.note if score.value is not None else made.note,
            "curve": Markup(curve(column.title, points)) if len(points) > 1 else "",
        }  # fmt: skip


def provenance_rows(record: RunRecord) -> list[tuple[str, list[tuple[str, str]]]]:
    """List every part of the record that is no score as names and values."""
    parts = {
        "Settings of the method": record.config, "Data": record.data, "Prior": record.prior,
        "Protocol": record.protocol, "What the numbers lean on": record.coverage,
        "What the method says of itself, and how it fits its input": record.diagnostics,
        "Networks of the metrics": record.networks,
        "Metrics of other packages": record.metrics, "Code": record.code, "Machine": record.machine,
        "Time": {"started": record.timing.started, "fit, s": record.timing.fit_seconds,
                 "evaluation, s": record.timing.evaluate_seconds, "peak memory, MiB": record.timing.peak_memory_mib},
    }  # fmt: skip
    return [
        (title, [(name, ", ".join(map(str, value)) if isinstance(value, list) else str(value))
                 for name, value in flat(part).items()])
        for title, part in parts.items() if part
    ]  # fmt: skip
