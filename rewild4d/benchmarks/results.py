"""Results of a benchmark: a row for each number."""

import re
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import torch

from rewild4d.benchmarks.timing import Sample
from rewild4d.files import write_text
from rewild4d.machine import code_version, machine
from rewild4d.rasterizer import pick_rasterizer

SCHEMA = 1

OURS, FLOOR = "rewild4d", "arithmetic floor"
FORWARD, BOTH = "forward", "forward+backward"


def this_machine(device: torch.device | None = None) -> dict[str, str]:
    """Describe the machine of a benchmark on a device, by default the CPU."""
    device = device or torch.device("cpu")
    return machine(device, pick_rasterizer("auto", device))


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One number."""

    subject: str  # what was measured: "rewild4d", a peer, the arithmetic floor, an operator of torch
    quantity: str  # "forward", "forward+backward", "step", "peak memory", ...
    value: float | None  # median of the repeats; None with the reason in ``note``
    unit: str  # "ms", "MiB", "dB", "1/s", "1" for counts and shares, ...
    gaussians: int | None = None  # of the scene, if they matter
    size: int | None = None  # side of the square image in pixels, if it matters
    repeats: int = 1  # number of measurements; 0 for a value that was not measured here
    minimum: float | None = None  # of the repeats
    spread: float | None = None  # interquartile range of the repeats
    note: str = ""  # why there is no value, or what the number leaves out


class Result(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One run of a benchmark."""

    benchmark: str  # "rasterizer" or "step"
    command: list[str]  # the words after `rewild4d-bench`
    threads: int  # number used
    settings: dict[str, int | str | list[int]]  # gaussians, sizes, repeats and other flags
    rows: list[Row]  # the numbers
    peers: dict[str, str] = {}  # version of each installed peer
    schema: int = SCHEMA  # version of this layout
    # UTC, ISO 8601
    started: str = msgspec.field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    # processor, system and versions of what computes
    machine: dict[str, str] = msgspec.field(default_factory=this_machine)
    code: dict[str, str] = msgspec.field(default_factory=code_version)  # version of rewild4d and digest of its sources


def single_row(
    subject: str, quantity: str, value: float | None, unit: str, gaussians: int, size: int, note: str = ""
) -> Row:
    """Return the row of a number that was measured once, or of None, which was not."""
    return Row(
        subject=subject, quantity=quantity, value=value, unit=unit, gaussians=gaussians, size=size,
        repeats=int(value is not None), note=note,
    )  # fmt: skip


def timed_row(subject: str, quantity: str, sample: Sample, gaussians: int, size: int, note: str = "") -> Row:
    """Return the row of a measured time."""
    return Row(
        subject=subject, quantity=quantity, value=sample.median, unit="ms", gaussians=gaussians, size=size,
        repeats=sample.repeats, minimum=sample.minimum, spread=sample.spread, note=note,
    )  # fmt: skip


def to_json(result: Result) -> str:
    """Encode the result as indented JSON."""
    return msgspec.json.format(msgspec.json.encode(result), indent=1).decode()


def write_result(result: Result, path: Path) -> None:
    """Write the result atomically.

    Raises:
        UserError: the folder cannot be written.
    """
    write_text(path, to_json(result) + "\n")


def default_path(benchmark: str, device: torch.device | None = None) -> Path:
    """Return the path of a result, named after benchmark, processor (or GPU) and day."""
    found = this_machine(device)
    processor = re.sub(r"[^a-z0-9]+", "-", found.get("gpu", found["processor"]).lower()).strip("-")
    return Path("results", "speed", f"{benchmark}-{processor}-{datetime.now(UTC):%Y-%m-%d}.json")
