"""`export`: write a saved reconstruction as files for other programs."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rewild4d.commands.shared import require_writable
from rewild4d.config import parse_flags
from rewild4d.errors import UserError
from rewild4d.io import KINDS

DESCRIPTION = """Write a run's reconstruction as files for other programs: Gaussians of every frame (ply), an animated
skinned mesh (glb), cameras (OpenCV axes, JSON) and films (mp4). Of a video, all frames that show the animal are
written, held-out ones too."""


@dataclass(frozen=True)
class Options:
    """Flags of `export`.

    Attributes:
        run: folder of one run, with a record.json and a reconstruction.
        out: folder for the files.
        what: some of ply, glb, cameras and mp4, with commas.
        data: folder of the data, where it has moved since the fit.
        device: auto, cpu or cuda.
        rasterizer: what renders the films: auto, numba (CPU), triton or gsplat (CUDA), or reference.
    """

    run: tyro.conf.Positional[Path]
    out: Path
    what: str = ",".join(KINDS)
    data: Path | None = None
    device: str = "auto"
    rasterizer: str = "auto"


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench export", description=DESCRIPTION)
    from rewild4d.io.export import export, parse_kinds, why_not
    from rewild4d.machine import pick_device
    from rewild4d.rasterizer import pick_rasterizer, set_default
    from rewild4d.running.opening import open_run

    kinds = parse_kinds(options.what)
    device = pick_device(options.device)
    set_default(pick_rasterizer(options.rasterizer, device))
    opened = open_run(options.run, options.data, device)
    reconstruction, clip = opened.reconstruction, opened.clip
    reasons = {kind: why_not(reconstruction, kind, clip) for kind in kinds}
    if all(reasons.values()):
        raise UserError(f"{options.run}: nothing can be written: {'; '.join(f'{k}: {r}' for k, r in reasons.items())}.")
    require_writable(options.out)
    for path in export(reconstruction, clip, kinds, options.out):
        print(path)
    for kind, reason in reasons.items():
        if reason:
            print(f"{kind}: not written: {reason}", file=sys.stderr)
    return 0
