"""Open a saved run to show or export it: what was fitted, at all moments of its data."""

from dataclasses import dataclass
from pathlib import Path

import torch

from rewild4d.cameras.recropping import add_cameras, all_moments
from rewild4d.contracts import Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.leaderboard.records import FILE, RunRecord, read_record
from rewild4d.registry import load_method
from rewild4d.running import provenance
from rewild4d.running.rescoring import reader_of
from rewild4d.types import Clip, Truth


@dataclass(frozen=True)
class OpenedRun:
    """A run as it was saved.

    Attributes:
        folder: of the run.
        record: what was found.
        reconstruction: what was fitted.
        clip: of a video all frames that show the animal, held-out ones too, with the method's cameras; of other data
            the input.
        truth: what the clip was scored against, held-out views with cameras.
    """

    folder: Path
    record: RunRecord
    reconstruction: Reconstruction
    clip: Clip
    truth: Truth


def open_run(folder: Path, data: Path | None, device: torch.device) -> OpenedRun:
    """Open a run's record, reconstruction and data.

    Args:
        folder: of the run, with a record.json and a reconstruction.
        data: present folder of the run's data; None: the record's.
        device: on which the reconstruction computes.

    Raises:
        UserError: no record, no reconstruction, or data that is gone.
    """
    record = read_record(folder / FILE)
    saved = folder / "reconstruction"
    if not saved.is_dir():
        raise UserError(f"{saved}: expected a saved reconstruction, but there is no such folder.")
    protocol = find_protocol(record.dataset, record.protocol["name"])
    clip, truth = reader_of(folder, record, data).load(record.case, protocol.selection)
    reconstruction = load_method(record.method).load(saved, device)
    clip, truth = add_cameras(reconstruction, clip, truth, provenance.shown_clip(clip, record.prior))
    return OpenedRun(folder, record, reconstruction, all_moments(clip, truth), truth)
