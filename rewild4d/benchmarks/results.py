"""What a benchmark found, as data: one row a number, and what decides it beside them."""

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
    """Of a benchmark that computes with the device's own backend, the CPU's where none is given."""
    device = device or torch.device("cpu")
    return machine(device, pick_rasterizer("auto", device))


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One number.

    Attributes:
        subject: who or what was measured: "rewild4d", a peer, the floor, an operator of torch.
        quantity: "forward", "forward+backward", "step", "peak memory", ...
        value: the median where it was measured several times; None where there is none, ``note`` then says why.
        unit: "ms", "MiB", "dB", "1/s", "1" for counts and shares, ...
        gaussians: how many the scene has, where that matters.
        size: side of the square image in pixels, where that matters.
        repeats: how often it was measured; 0 for what was not measured here.
        minimum: of the repeats.
        spread: between the quartiles of the repeats.
        note: why there is no value, or what the number leaves out.
    """

    subject: str
    quantity: str
    value: float | None
    unit: str
    gaussians: int | None = None
    size: int | None = None
    repeats: int = 1
    minimum: float | None = None
    spread: float | None = None
    note: str = ""


class Result(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One run of a benchmark.

    Attributes:
        schema: version of this layout.
        benchmark: "rasterizer" or "step".
        command: the words after `rewild4d-bench`.
        started: UTC, ISO 8601.
        threads: that computed.
        settings: gaussians, sizes, repeats and what else the flags said.
        machine: processor, system and versions of what computes.
        peers: version of each peer that is installed.
        code: version of rewild4d and digest of its sources.
        rows: what was found.
    """

    benchmark: str
    command: list[str]
    threads: int
    settings: dict[str, int | str | list[int]]
    rows: list[Row]
    peers: dict[str, str] = {}
    schema: int = SCHEMA
    started: str = msgspec.field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    machine: dict[str, str] = msgspec.field(default_factory=this_machine)
    code: dict[str, str] = msgspec.field(default_factory=code_version)


def timed_row(subject: str, quantity: str, sample: Sample, gaussians: int, size: int, note: str = "") -> Row:
    """The row of a measured time."""
    return Row(
        subject=subject,
        quantity=quantity,
        value=sample.median,
        unit="ms",
        gaussians=gaussians,
        size=size,
        repeats=sample.repeats,
        minimum=sample.minimum,
        spread=sample.spread,
        note=note,
    )


def to_json(result: Result) -> str:
    """The result as indented JSON."""
    return msgspec.json.format(msgspec.json.encode(result), indent=1).decode()


def write_result(result: Result, path: Path) -> None:
    """Write the result atomically.

    Raises:
        UserError: the folder cannot be written.
    """
    write_text(path, to_json(result) + "\n")


def default_path(benchmark: str, device: torch.device | None = None) -> Path:
    """Where a result goes: named after benchmark, processor (or GPU) and day, so that a day's last run stays."""
    found = this_machine(device)
    processor = re.sub(r"[^a-z0-9]+", "-", found.get("gpu", found["processor"]).lower()).strip("-")
    return Path("results", "speed", f"{benchmark}-{processor}-{datetime.now(UTC):%Y-%m-%d}.json")
