"""`report`: write one HTML page of a run, with a player of its Gaussians."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rewild4d.commands.shared import require_writable_file
from rewild4d.config import parse_flags
from rewild4d.errors import UserError

DESCRIPTION = """Write one HTML file of a run that opens from disk, on a phone too, without server and network: a player
of the moving Gaussians beside the film, scores, settings and pictures. A run without Gaussians has no player."""


@dataclass(frozen=True)
class Options:
    """Flags of `report`.

    Attributes:
        run: folder of one run, with a record.json.
        out: the HTML file; RUN/report.html by default.
        moments: at most so many moments of the film are shown, evenly spaced.
        data: folder of the data, where it has moved since the fit.
        device: auto, cpu or cuda.
    """

    run: tyro.conf.Positional[Path]
    out: Path | None = None
    moments: int = 120
    data: Path | None = None
    device: str = "auto"


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench report", description=DESCRIPTION)
    if options.moments < 1:
        raise UserError(f"--moments: expected a number of at least 1, got {options.moments}.")
    from rewild4d.leaderboard.records import FILE, read_record
    from rewild4d.machine import pick_device
    from rewild4d.running.opening import open_run
    from rewild4d.visualize.report.page import write_report
    from rewild4d.visualize.report.scene import make_scene

    record = read_record(options.run / FILE)
    out = options.out or options.run / "report.html"
    require_writable_file(out)
    scene, why = None, ""
    if not (options.run / "reconstruction").is_dir():
        why = "no reconstruction was saved." if record.status == "ok" else "the run failed before there was one."
    else:
        opened = open_run(options.run, options.data, pick_device(options.device))
        scene = make_scene(opened.reconstruction, opened.clip, opened.truth.up, options.moments)
        why = "" if scene else "the reconstruction has no visible Gaussians."
    for sentence in write_report(record, options.run, out, scene, why):
        print(f"left out: {sentence}", file=sys.stderr)
    if not scene:
        print(f"no player: {why}", file=sys.stderr)
    print(out)
    return 0
