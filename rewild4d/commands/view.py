"""`view`: look at saved reconstructions in the browser."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from rewild4d.config import parse_flags
from rewild4d.errors import UserError

if TYPE_CHECKING:
    from rewild4d.running.opening import OpenedRun
    from rewild4d.visualize.viewer.staging import Run

DESCRIPTION = """Look at runs in the browser: the animal from any side at any time, the film's camera, the shape without
its deformation or at rest, its parts, held-out views beside our renders. Several runs stand side by side. Ctrl-C ends
it. Whoever can reach the address can look and steer, without a password: it is served to this machine alone unless
--host says otherwise."""


@dataclass(frozen=True)
class Options:
    """Flags of `view`.

    Attributes:
        runs: folders of single runs, each with a record.json and a reconstruction; the first one's times are shown.
        data: folder of the data, where it has moved since the fit.
        host: address on which the page is served; 0.0.0.0 serves everybody who can reach this machine.
        port: of the address; 0 for any that is free.
        device: auto, cpu or cuda.
        rasterizer: what renders held-out views and films: auto, numba (CPU), triton or gsplat (CUDA), or reference.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    data: Path | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    device: str = "auto"
    rasterizer: str = "auto"


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench view", description=DESCRIPTION)
    if not options.runs:
        raise UserError("view: expected the folder of at least one run, got none.")
    if importlib.util.find_spec("viser") is None:
        raise UserError("view: expected the package viser, run: pip install -e '.[view]'.")
    from rewild4d.machine import pick_device
    from rewild4d.rasterizer import pick_rasterizer, set_default
    from rewild4d.running.opening import open_run
    from rewild4d.visualize.viewer.page import Page
    from rewild4d.visualize.viewer.serving import close_server, open_server
    from rewild4d.visualize.viewer.staging import set_stage

    device = pick_device(options.device)
    set_default(pick_rasterizer(options.rasterizer, device))
    server = open_server(options.host, options.port)
    try:
        opened = [open_run(folder, options.data, device) for folder in options.runs]
        page = Page(server, [set_stage(run) for run in _runs(opened)])
        megabytes = sum(actor.moments.nbytes for actor in page.actors) / 1e6
        print(f"{len(page.times)} moments, {megabytes:.2f} MB each once it was shown", file=sys.stderr)
        print(f"http://{options.host}:{server.get_port()}  (Ctrl-C ends it)", flush=True)
        page.serve()
    except KeyboardInterrupt:
        return 0
    finally:
        close_server(server)
    return 0


def _runs(opened: Sequence[OpenedRun]) -> list[Run]:
    """Return what is shown of each run, by the shortest names that tell them apart."""
    from rewild4d.evaluation.placing import scale_of
    from rewild4d.evaluation.protocol import find_protocol
    from rewild4d.visualize.viewer.staging import Run

    records = [run.record for run in opened]
    short = [f"{record.method} {record.preset}" for record in records]
    longer = [f"{name} {record.case}" for name, record in zip(short, records, strict=True)]
    names = next(
        (names for names in (short, longer) if len({*names}) == len(names)), [run.folder.name for run in opened]
    )
    protocols = [find_protocol(record.dataset, record.protocol["name"]) for record in records]
    return [
        Run(name, run.reconstruction, run.clip, run.truth, protocol.background, scale_of(run.record.alignments))
        for name, run, protocol in zip(names, opened, protocols, strict=True)
    ]
