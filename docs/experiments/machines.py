"""Hand 1,000 runs of a stub to ten workers of this machine, and kill two of them with SIGKILL in the middle.

    python docs/experiments/machines.py [RUNS] [WORKERS]

Prints what docs/machines.md quotes; exit status 1 where a run was lost or made twice.
"""

import os
import platform
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from threading import Thread

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "helpers"))
KILLS = 2


def kill_in_the_middle(out: Path, runs: int, killed: list[str]) -> None:
    """Kill the worker of the newest fit when a third, and when two thirds, of all fits have begun."""
    from sleeping import told

    for share in range(1, KILLS + 1):
        while len(begins := [line for line in told(out) if line[0] == "begin"]) < runs * share // (KILLS + 1):
            time.sleep(0.05)
        _, case, seed, _, number = begins[-1]
        os.kill(int(number), signal.SIGKILL)
        killed.append(f"process {number}, at {case}, seed {seed}")


def main(runs: int = 1000, workers: int = 10) -> int:
    import sleeping

    from rewild4d.running.cluster import LOCAL, ClusterFile, Site
    from rewild4d.running.parts import list_parts
    from rewild4d.running.remote import execute_remotely

    with tempfile.TemporaryDirectory() as folder:
        site, killed = Path(folder), list[str]()
        sys.path.insert(0, str(site))
        data = sleeping.install(site, cases=runs // 10)
        plan = sleeping.crowd_plan(data, site / "runs", sleeping.Nap(steps=10), seeds=tuple(range(10)))
        begin = time.perf_counter()
        planned = len(list_parts(plan))
        planning = time.perf_counter() - begin
        Thread(target=kill_in_the_middle, args=(plan.out, planned, killed), daemon=True).start()
        begin = time.perf_counter()
        records = execute_remotely([plan], Site("shared", file=ClusterFile(LOCAL, workers)), f"{planned} runs")
        seconds = time.perf_counter() - begin
        lines = sleeping.told(plan.out)
        again = execute_remotely([replace(plan)], Site("shared", file=ClusterFile(LOCAL, workers)), "again")
        nothing_new = len(sleeping.told(plan.out)) == len(lines)
    ends = Counter((case, seed) for what, case, seed, *_ in lines if what == "end")
    good = sum(record.status == "ok" for record in records)
    begun = sum(line[0] == "begin" for line in lines)
    packages = ", ".join(f"{name} {metadata.version(name)}" for name in ("distributed", "dask", "torch"))
    print(f"{datetime.now(UTC):%Y-%m-%d}, {platform.platform()}, {os.cpu_count()} cores")
    print(f"Python {platform.python_version()}, {packages}")
    print(f"planned: {planned} runs in {planning:.2f} s")
    print(f"{workers} workers, {seconds:.0f} s; killed: {'; '.join(killed)}")
    print(f"good records: {good} of {planned}; fits that ended: {sum(ends.values())}, of different runs: {len(ends)}")
    print(f"fits that began: {begun}, {begun - planned} of them again; a second command made nothing: {nothing_new}")
    ok = good == planned == len(ends) == sum(ends.values()) and begun == planned + len(killed) and again == records
    return 0 if ok and nothing_new and len(killed) == KILLS else 1


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
