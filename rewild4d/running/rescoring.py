"""Read saved runs: their data, and new scores by the protocol that they were fitted for."""

from pathlib import Path
from typing import Any

import msgspec
import torch

from rewild4d.contracts import DatasetReader
from rewild4d.errors import UserError
from rewild4d.evaluation.coverage import coverage
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.foreign.texts import parse_json
from rewild4d.leaderboard.records import FILE, RunRecord, Timing, read_record, write_record
from rewild4d.machine import code_of, machine, peak_memory_mib, pick_device
from rewild4d.rasterizer import pick_rasterizer
from rewild4d.registry import load_dataset, load_method
from rewild4d.running import provenance
from rewild4d.running.clock import STAMP, fit_seconds
from rewild4d.running.scoring import score
from rewild4d.running.workers import share_cores, this_process


def reader_of(run: Path, record: RunRecord, data: Path | None) -> DatasetReader:
    """Return the reader of the data that a run was fitted to.

    Args:
        run: folder of the run.
        record: of the run.
        data: present folder of the data; None: the record's.

    Raises:
        UserError: the record lacks folder or settings of its data, or the folder is gone.
    """
    reader, root = load_dataset(record.dataset), data or record.data.get("root")
    if not root:
        raise UserError(f"{run}: expected a record that names the folder of its data; --data names one.")
    said = record.data.get("settings", "{}")
    settings = parse_json(said, run, "the record's data.settings to be a JSON object", dict[str, Any])
    if unknown := sorted(set(settings) - {*getattr(reader, "options", ())}):
        raise UserError(f"{run}: expected settings that data set {record.dataset} has, got {', '.join(unknown)}.")
    return reader(Path(root), **settings)


def score_again(folder: Path, data: Path | None = None, device: str = "auto", rasterizer: str = "auto") -> RunRecord:
    """Load a run's reconstruction, score it and rewrite its record.

    Args:
        folder: of the run, with a record.json and a reconstruction.
        data: present folder of the run's data; None: the record's.
        device: auto, cpu or cuda.
        rasterizer: one of `rewild4d.rasterizer.BACKENDS`.

    Raises:
        UserError: no record, no reconstruction, or data that has changed since the fit.
    """
    computing = pick_device(device)
    renderer = pick_rasterizer(rasterizer, computing)
    with this_process(share_cores(1, 1, computing), renderer):  # as a run scores: torch's threads decide last digits
        return _scored(folder, data, computing, renderer)


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
            root = data or record.data["root"]
            raise UserError(f"{root}: the {name} of {record.case} is not the one that {folder} was fitted to.")
    reconstruction = load_method(record.method).load(saved, device)
    fields, seconds = score(
        reconstruction, clip, truth, provenance.shown_clip(clip, record.prior), protocol=protocol, method=record.method,
        prior=record.prior.get("choice", ""), quality=record.prior.get("quality", {}), reader=reader, folder=folder,
        device=device, title=record.case,
    )  # fmt: skip
    renewed = msgspec.structs.replace(
        record, **fields, coverage=coverage(clip, truth), timing=_timing(record, spent, seconds),
        protocol={"digest": protocol.digest, **msgspec.to_builtins(protocol)},
        code=record.code | code_of(record.method), machine=machine(device, rasterizer),
    )  # fmt: skip
    return read_record(write_record(renewed, folder))


def _timing(record: RunRecord, spent: float, seconds: float) -> Timing:
    """Combine the start and duration of the fit, which a failed record lacks, with the duration of this scoring."""
    memory = max(record.timing.peak_memory_mib, round(peak_memory_mib(), 1))
    return Timing(record.timing.started, round(spent, 2), round(seconds, 2), memory)
