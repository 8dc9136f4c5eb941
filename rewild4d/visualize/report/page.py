"""Write the page of a run: one HTML file that needs no server, no network and nothing beside it."""

import base64
import json
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from rewild4d.errors import UserError
from rewild4d.files import regular_inside, write_text
from rewild4d.leaderboard.media import MOST_BYTES, PICTURES, open_picture
from rewild4d.leaderboard.privacy import without_paths
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.run_page import page_head, provenance_rows, score_rows
from rewild4d.leaderboard.run_page import template as leaderboard_template
from rewild4d.leaderboard.site import CAPTIONS
from rewild4d.registry import method_info
from rewild4d.visualize.report.scene import Scene, jpeg

PICTURE_SIDE = 1280
"""Longest side of pictures in the page, pixels."""
PICTURE_QUALITY = 82
"""Of their JPEG."""
STILL = "default-src 'none'; img-src data:; style-src {style}; base-uri 'none'; form-action 'none'"
"""Content-Security-Policy of a page without player: its own style, and pictures that it holds itself."""
PLAYING = (
    "default-src 'none'; img-src data:; style-src {style}; script-src {script} 'wasm-unsafe-eval'; worker-src blob:; "
    "base-uri 'none'; form-action 'none'"
)
"""With one: its script, which compiles its own WebAssembly and sorts in a worker of its own making. No connection."""


def write_report(record: RunRecord, folder: Path, out: Path, scene: Scene | None, why: str = "") -> list[str]:
    """Write the page of a run atomically.

    Args:
        record: of the run; absolute paths in it are cut to their last part.
        folder: of the run, with its pictures.
        out: the HTML file.
        scene: what the player shows; None: there is no player.
        why: a sentence that says why not.

    Returns:
        A sentence for each picture that was left out.

    Raises:
        UserError: the file cannot be written.
    """
    record = without_paths(record)
    left: list[str] = []
    pictures = list(_pictures(record, folder, left))
    style = leaderboard_template("style.css") + _text("templates/report.css")
    script = _text("player/player.min.js") if scene else ""
    pages = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.FunctionLoader(_own_template), jinja2.FunctionLoader(leaderboard_template)]),
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    text = pages.get_template("report.html").render(
        title=f"{record.method} on {record.case}", record=record, facts=_facts(record, scene), why=why,
        player=_player(scene) if scene else None, scores=list(score_rows(record)), pictures=pictures,
        provenance=provenance_rows(record), licences=_text("player/licences.txt"),
        **page_head(PLAYING if scene else STILL, style, script),
    )  # fmt: skip
    write_text(out, text)
    return left


def _text(name: str) -> str:
    return (resources.files("rewild4d.visualize.report") / name).read_text(encoding="utf-8")


def _own_template(name: str) -> str | None:
    return _text(f"templates/{name}") if name == "report.html" else None


def _player(scene: Scene) -> dict[str, Any]:
    """Return what the template puts into the player's data blocks; no text in JSON can end such a block."""
    facts = json.dumps(scene.facts, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    size = 2 * scene.facts["radius"]
    return {
        "scene": Markup(facts), "splats": Markup(_text_of(scene.splats)), "seen": scene.collected.seen,
        "cameras": any(scene.facts["cameras"]), "error": f"{100 * scene.collected.position_error / size:.2g}",
    }  # fmt: skip


def _text_of(data: bytes) -> str:
    """Write bytes in base 85, a sixteenth shorter than in base 64, without the "<" that could end a data block."""
    return base64.b85encode(data).decode().replace("<", ",")


def _facts(record: RunRecord, scene: Scene | None) -> list[tuple[str, str]]:
    """List what a reader asks first as names and values; what the record does not say is left out."""
    prior, quality = record.prior, record.prior.get("quality")
    found = []
    try:
        info = method_info(record.method)
        found.append(("method", f"{info.title} ({info.paper})" if info.paper else info.title))
    except UserError:  # a method that is not installed here
        found.append(("method", record.method))
    found.append(("protocol", str(record.protocol["title"])))
    if scene:
        collected = scene.collected
        shown, invisible = round(collected.total - collected.invisible), round(collected.invisible)
        more = f"; {invisible:,} more are invisible (opacity below 1/255) and left out" if invisible else ""
        found.append(("Gaussians shown", f"{shown:,}{more}"))
        found.append(("moments shown", str(len(scene.facts["times"]))))
    found.append(("prior", str(prior.get("provenance") or prior.get("name", "none"))))
    if isinstance(quality, dict) and isinstance(iou := quality.get("mask_iou"), int | float):
        found.append(("prior's mask IoU", f"{iou:.3f}"))
    if isinstance(rows := prior.get("left_out"), list):
        found.append(("frames not shown to the method", f"{len(rows)}: the prior does not know their cameras"))
    if record.timing.fit_seconds:
        memory = f", {record.timing.peak_memory_mib:,.0f} MiB" if record.timing.peak_memory_mib else ""
        found.append(("fit", f"{record.timing.fit_seconds:,.0f} s{memory}, started {record.timing.started}"))
    said = record.machine
    versions = [f"{name} {said[name]}" for name in ("python", "torch", "rasterizer") if said.get(name)]
    machine = [said[name] for name in ("gpu", "processor", "system") if said.get(name)]
    found.append(("machine", ", ".join([*machine, *versions]) or "not said"))
    found.append(("data", ", ".join(filter(None, (record.dataset, record.data.get("licence"))))))
    return found


def _pictures(record: RunRecord, folder: Path, left: list[str]) -> Iterator[dict[str, str]]:
    """Yield caption and base64 of the pictures that lie beside the record; ``left`` takes what was left out and why."""
    order = list(CAPTIONS)
    names = [name for name in dict.fromkeys(record.pictures) if Path(name).suffix.lower() in PICTURES]
    for name in sorted(names, key=lambda name: order.index(stem) if (stem := Path(name).stem) in order else len(order)):
        path = folder / Path(name).name
        if not path.exists():
            continue
        try:
            regular_inside(path, folder)
            if (size := path.stat().st_size) > MOST_BYTES:
                raise UserError(f"{path}: expected at most {MOST_BYTES >> 20} MiB, got {size / 2**20:.0f} MiB.")
            image = open_picture(path, PICTURES[path.suffix.lower()], path)
        except UserError as error:
            left.append(str(error))
            continue
        caption = CAPTIONS.get(path.stem, path.name)
        yield {"caption": caption, "data": jpeg(image, PICTURE_SIDE, PICTURE_QUALITY)}
