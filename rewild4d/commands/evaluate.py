"""`evaluate`: score a saved reconstruction again, by the protocol it was fitted for."""

import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import torch
import tyro

from rewild4d.commands.shared import reader_of
from rewild4d.config import parse_flags
from rewild4d.errors import UserError
from rewild4d.evaluation.coverage import coverage
from rewild4d.evaluation.measuring import evaluate
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.evaluation.refining import ready_to_score
from rewild4d.leaderboard.records import FILE, RunRecord, Timing, read_record, to_json, write_record
from rewild4d.leaderboard.tables import markdown
from rewild4d.machine import code_of, machine, peak_memory_mib, pick_device
from rewild4d.progress import Progress
from rewild4d.rasterizer import pick_rasterizer
from rewild4d.registry import load_method
from rewild4d.running import provenance
from rewild4d.running.runner import STAMP, fit_seconds
from rewild4d.running.workers import share_cores, this_process
from rewild4d.visualize.original_view import original_frames
from rewild4d.visualize.run_pictures import save_pictures

DESCRIPTION = """Score saved reconstructions again, with the protocol that they were fitted for (another one could hold
out what the method has seen), draw their pictures again and write their records anew."""


@dataclass(frozen=True)
class Options:
    """Flags of `evaluate`.

    Attributes:
        runs: folders of single runs, each with a record.json and a reconstruction.
        data: where the data is now, if it was moved since.
        device: auto, cpu or cuda.
        rasterizer: what renders: auto, numba (CPU), triton or gsplat (CUDA), or reference (small scenes only).
        json: print the records as a JSON array, and nothing else, to standard output.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    data: Path | None = None
    device: str = "auto"
    rasterizer: str = "auto"
    json: bool = False


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench evaluate", description=DESCRIPTION)
    if not options.runs:
        raise UserError("evaluate: expected the folder of at least one run, got none.")
    records = [score_again(folder, options) for folder in options.runs]
    print("[" + ",\n".join(map(to_json, records)) + "]" if options.json else markdown(records))
    return 0


def score_again(folder: Path, options: Options) -> RunRecord:
    """Load a run's reconstruction, score it and rewrite its record.

    Raises:
        UserError: no record, no reconstruction, or data that has changed since the fit.
    """
    device = pick_device(options.device)
    rasterizer = pick_rasterizer(options.rasterizer, device)
    with this_process(share_cores(1, 1, device), rasterizer):  # as a run scores: torch's threads decide last digits
        return _scored(folder, options.data, device, rasterizer)


def _scored(folder: Path, data: Path | None, device: torch.device, rasterizer: str) -> RunRecord:
    record = read_record(folder / FILE)
    saved = folder / "reconstruction"
    if not saved.is_dir():
        raise UserError(f"{saved}: expected a saved reconstruction, but there is no such folder.")
    protocol = find_protocol(record.dataset, record.protocol["name"])
    spent = fit_seconds(folder) if (folder / STAMP).is_file() else record.timing.fit_seconds
    reader = reader_of(folder, record, data)
    clip, truth = reader.load(record.case, protocol.selection)
    for name, now in (("clip", clip.digest), ("truth", truth.digest)):
        if now != record.data.get(name):
            place = data or record.data["root"]
            raise UserError(f"{place}: the {name} of {record.case} is not the one that {folder} was fitted to.")
    reconstruction = load_method(record.method).load(saved, device)
    begin = time.perf_counter()
    shown = provenance.shown_of(clip, record.prior)
    progress = Progress(f"{record.case}: refine on held-out frames")
    reconstruction, clip, truth = ready_to_score(reconstruction, clip, truth, shown, progress)
    progress.close()
    progress = Progress(f"{record.case}: evaluate")
    found = evaluate(reconstruction, clip, truth, protocol, progress, device)
    progress.close()
    seconds = time.perf_counter() - begin
    whole = original_frames(reader, clip, protocol.selection)
    pictures = save_pictures(reconstruction, clip, truth, folder, whole)
    described = {"digest": protocol.digest, **msgspec.to_builtins(protocol)}
    renewed = msgspec.structs.replace(
        record, status="ok", error="", **found.keep(folder), coverage=coverage(clip, truth), pictures=pictures,
        diagnostics=provenance.diagnostics(reconstruction, shown, protocol.background), protocol=described,
        marks=provenance.marks(record.method, record.prior.get("choice", ""), reconstruction),
        code=code_of(record.method), machine=machine(device, rasterizer), timing=_timing(record, spent, seconds),
    )  # fmt: skip
    return read_record(write_record(renewed, folder))


def _timing(record: RunRecord, spent: float, seconds: float) -> Timing:
    """When it was fitted, how long that took, which a failed record does not say, and how long scoring took now."""
    memory = max(record.timing.peak_memory_mib, round(peak_memory_mib(), 1))
    return Timing(record.timing.started, round(spent, 2), round(seconds, 2), memory)
