"""Run `ours` on a small animal through dask-jobqueue's SLURMCluster, cancel a job in the middle, check the records.

Called by slurm.sh, which starts Slurm: python slurm_table.py FOLDER
"""

import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from rewild4d.datasets.builtin import synthetic
from rewild4d.datasets.rigs.studio import render_artemis
from rewild4d.leaderboard.records import find_records

CLUSTER = """
class = "SLURMCluster"
workers = 2
retries = 3

[arguments]
queue = "all"
cores = 1
memory = "4GB"
walltime = "01:00:00"
interface = "lo"
log_directory = "{logs}"
"""
SETTINGS = ["--iterations", "160", "--warmup.iterations", "0", "--canonical.samples", "600", "--checkpoint-every", "20"]
SETTINGS += ["--image-size", "96", "--skinning.resolution", "12", "--seeds", "0", "1"]


def call(*words: str) -> str:
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def cancel_one(out: Path, process: subprocess.Popen[bytes]) -> str:
    """Cancel a job whose fit has a checkpoint, as Slurm does at the end of a job's time."""
    while process.poll() is None:
        if list(out.glob("*/*/ours-*/work/checkpoint.pt")):
            (job, *_) = call("squeue", "--noheader", "--states=running", "--format=%i").split()
            call("scancel", "--signal=KILL", "--full", job)
            call("scancel", job)
            return job
        time.sleep(0.1)
    return ""


def main(folder: Path) -> int:
    walk = synthetic.build("tiger")[0]
    data = render_artemis(
        [replace(walk, bones=walk.bones[:8])], folder / "tiger", views=3, width=96, height=64, progress=None
    )
    (folder / "slurm.toml").write_text(CLUSTER.format(logs=folder / "logs"))
    out = folder / "runs"
    words = ["--data", str(data), "--protocol", "artemis-sweep-128-v1", "--prior", "template:quadruped"]
    words += ["--executor", "dask", "--cluster", str(folder / "slurm.toml"), "--out", str(out), *SETTINGS]
    process = subprocess.Popen([str(Path(sys.executable).with_name("rewild4d-bench")), "run", *words])
    cancelled = cancel_one(out, process)
    status = process.wait()
    print(subprocess.run([str(Path(sys.executable).with_name("rewild4d-bench")), "status", str(out)], text=True,
                         capture_output=True).stdout)  # fmt: skip
    jobs = re.findall(r"JobId=(\d+) JobName=(\S+).*? JobState=(\w+)", call("scontrol", "show", "jobs", "--oneliner"))
    print("jobs of Slurm:", *(f"{job} {name} {state}" for job, name, state in jobs), sep="\n  ")
    found = [(record.case, record.method, record.seed, record.status) for _, record in find_records(out)]
    expected = [("tiger/walk", "empty", 0, "ok"), ("tiger/walk", "ours", 0, "ok"), ("tiger/walk", "ours", 1, "ok"),
                ("tiger/walk", "prior-only", 0, "ok")]  # fmt: skip
    right = sorted(found) == expected and status == 0 and bool(cancelled) and max(int(job) for job, *_ in jobs) > 2
    print(f"exit status {status}; job {cancelled or 'none'} was cancelled in the middle of a fit; {len(jobs)} jobs")
    print(f"records: {'as expected' if right else f'expected {expected}, got {sorted(found)}'}")
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
