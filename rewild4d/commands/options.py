"""Share the flags that several commands have."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rewild4d.contracts import Parts


@dataclass(frozen=True, kw_only=True)
class DataFlags:
    """Flags of the data.

    Attributes:
        data: one animal's folder or a folder of animals; the built-in animals where it is left out.
        video: the same as --data, for a video file or a folder of frames (--dataset online).
        masks: of the animal: a folder or, for online, a video; instead of the data set's own.
        parts: of masks in several parts: all, or main, the one that continues the frame before; where left out (auto),
            main if many masks hold a second animal apart from the first.
        start: time of the first frame that is used, seconds.
        end: time of the last frame that is used, seconds.
        fps: frames per second that are used; of a folder of frames, the rate of its recording.
    """

    data: Path | None = None
    video: Path | None = None
    masks: Path | None = None
    parts: Parts | None = None
    start: float | None = None
    end: float | None = None
    fps: float | None = None


@dataclass(frozen=True, kw_only=True)
class ComputeFlags:
    """Flags of devices and kernels.

    Attributes:
        device: auto, cpu or cuda.
        rasterizer: what renders: auto, numba (CPU), triton or gsplat (CUDA), or reference (small scenes only).
        kernels: auto (fused CPU kernels where they fit) or torch (plain torch everywhere, to try edited code); auto, or
            what $REWILD4D_KERNELS says, where it is left out.
        json: print the records as a JSON array, and nothing else, to standard output.
    """

    device: str = "auto"
    rasterizer: str = "auto"
    kernels: str | None = None
    json: bool = False


@dataclass(frozen=True, kw_only=True)
class ClusterFlags:
    """Flags of runs on several machines.

    Attributes:
        executor: local (--jobs processes of this machine) or dask (workers of a Dask cluster, one run at a time each).
        scheduler: of dask: address of a scheduler that runs already ("tcp://host:8786").
        cluster: of dask, instead of an address: a TOML or YAML file that says what to start (dask-jobqueue's
            SLURMCluster, for example); where both are left out, --jobs workers of this machine.
        records: of dask: shared (workers write into --out, on a file system that all share) or returned (workers write
            into folders of their own, and this command fetches and writes what they made).
    """

    executor: Literal["local", "dask"] = "local"
    scheduler: str = ""
    cluster: Path | None = None
    records: Literal["shared", "returned"] = "shared"


@dataclass(frozen=True, kw_only=True)
class RunFlags(ClusterFlags, ComputeFlags, DataFlags):
    """Flags of commands that fit. Help lists the flags of later base classes first.

    Attributes:
        jobs: runs at a time (a case, a method and a seed each); 0 is one for each processor core or GPU.
        threads: of torch in each run; other numbers than 1 may change the last digits. Fused kernels use idle cores
            too, without changing results.
        out: folder for runs.
    """

    jobs: int = 0
    threads: int = 1
    out: Path = Path("runs")
