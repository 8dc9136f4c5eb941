"""Kill a run at random moments of every stage, start it again, and compare the result with an undisturbed one.

    make kills        # 20 moments, ten minutes; another number: make kills MOMENTS=100

One process makes a data set's runs, collects them and builds their page. It says when each stage begins and ends; its
whole process group is killed (SIGKILL) inside of a stage, at a moment drawn from that stage's undisturbed duration.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

STAGES = {
    "prior": "rewild4d.running.runner:make_prior",
    "fit": "rewild4d.running.runner:Job._fit",
    "checkpoint": "rewild4d.ours.training:save_checkpoint",
    "evaluation": "rewild4d.running.scoring:evaluate",
    "pictures": "rewild4d.running.scoring:save_pictures",
    "record": "rewild4d.running.runner:write_record",
    "collect": "rewild4d.leaderboard.collect:collect",
    "build": "rewild4d.leaderboard.site:build_site",
}
"""Where each begins and ends."""
SETTINGS = (
    "--iterations", "60", "--warmup.iterations", "20", "--canonical.samples", "600", "--checkpoint-every", "10",
    "--image-size", "96", "--skinning.resolution", "12",
)  # fmt: skip
PROGRAM = """
import importlib, json, os, sys

def told(stage, call):
    def say(*given, **named):
        os.write(pipe, f"begin {stage}\\n".encode())
        try:
            return call(*given, **named)
        finally:
            os.write(pipe, f"end {stage}\\n".encode())
    return say

if __name__ == "__main__":
    pipe, stages, commands = int(sys.argv[1]), json.loads(sys.argv[2]), json.loads(sys.argv[3])
    for stage, place in stages.items():
        module, names = place.split(":")
        *owners, name = names.split(".")
        owner = importlib.import_module(module)
        for each in owners:
            owner = getattr(owner, each)
        setattr(owner, name, told(stage, getattr(owner, name)))
    import msgspec

    from rewild4d import cli
    from rewild4d.priors.config import PRESETS

    stages = tuple(msgspec.structs.replace(stage, steps=6) for stage in PRESETS["quick"].stages)
    PRESETS["quick"] = msgspec.structs.replace(PRESETS["quick"], stages=stages)  # any prior will do
    for words in commands:
        try:
            cli.main(words)
        except SystemExit as stop:
            if stop.code:
                raise
"""
Moment = tuple[str, int, float]
"""A stage, which of its occurrences, and how many seconds after that begins."""


@dataclass(frozen=True)
class Drill:
    """What is killed and made again.

    Attributes:
        data: folder of the data set.
        root: for the results.
        settings: flags of `run`.
    """

    data: Path
    root: Path
    settings: Sequence[str] = SETTINGS

    def start(self, name: str, moment: Moment | None = None) -> list[tuple[str, float]]:
        """Work in a folder of some name, to the end or until a moment; returns what was said, with seconds.

        Raises:
            RuntimeError: the process ended by itself with another status than 0.
        """
        out = self.root / name
        out.mkdir(exist_ok=True)
        commands = [
            ["run", "--data", self.data, "--protocol", "artemis-sweep-128-v1", "--out", out / "runs", "--jobs", "1",
             *self.settings],
            ["leaderboard", "collect", "--runs", out / "runs", "--out", out / "kept"],
            ["leaderboard", "build", "--runs", out / "runs", "--out", out / "page"],
        ]  # fmt: skip
        reading, writing = os.pipe()
        words = [sys.executable, "-c", PROGRAM, str(writing), json.dumps(STAGES), json.dumps(commands, default=str)]
        with tempfile.TemporaryFile() as log:
            process = subprocess.Popen(words, pass_fds=(writing,), stdout=log, stderr=log, start_new_session=True)
            os.close(writing)
            said, is_killed = [], False
            for line in _lines(reading):
                said.append((line, time.monotonic()))
                if moment and line == f"begin {moment[0]}" and [each for each, _ in said].count(line) > moment[1]:
                    time.sleep(moment[2])
                    os.killpg(process.pid, signal.SIGKILL)
                    is_killed = True
                    break
            os.close(reading)
            if process.wait() and not is_killed:
                log.seek(0)
                raise RuntimeError(f"{name}: {log.read().decode(errors='replace')[-2000:]}")
        return said

    def lend_prior(self, name: str, other: str) -> None:
        """Begin a folder with the fitted priors of another one, which take most of the time."""
        shutil.copytree(self.root / name / "runs" / "priors", self.root / other / "runs" / "priors")

    def result(self, name: str) -> dict[str, object]:
        """Everything below a folder by its name: records without their times, the bytes of pictures and tensors."""
        folder = self.root / name
        return {
            path.relative_to(folder).as_posix(): _content(path) for path in sorted(folder.rglob("*")) if path.is_file()
        }


def _lines(handle: int) -> Iterator[str]:
    rest = b""
    while data := os.read(handle, 4096):
        *whole, rest = (rest + data).split(b"\n")
        yield from (line.decode() for line in whole)


def _content(path: Path) -> object:
    if path.name == "record.json":
        record = json.loads(path.read_text())
        del record["timing"]
        return record
    if path.suffix in (".html", ".json", ".jsonl"):  # they tell how long it took
        return None
    return path.read_bytes()


def durations(said: Sequence[tuple[str, float]]) -> dict[str, list[float]]:
    """Seconds of every occurrence of each stage, in their order."""
    found: dict[str, list[float]] = {stage: [] for stage in STAGES}
    begun: dict[str, float] = {}
    for line, when in said:
        word, stage = line.split()
        if word == "begin":
            begun[stage] = when
        else:
            found[stage].append(when - begun[stage])
    return found


def draw(known: dict[str, list[float]], count: int, seed: int) -> list[Moment]:
    """Moments in all stages by turns, each in any of its occurrences and anywhere in it."""
    generator = random.Random(seed)
    found = []
    for number in range(count):
        stage = list(STAGES)[number % len(STAGES)]
        which = generator.randrange(len(known[stage]))
        found.append((stage, which, generator.random() * known[stage][which]))
    return found


def differences(one: dict[str, object], other: dict[str, object]) -> list[str]:
    """Names of files that are in only one of two results, or not the same in both."""
    return sorted(name for name in {*one, *other} if one.get(name, "absent") != other.get(name, "absent"))


def make_data(folder: Path) -> Path:
    """A few frames of a built-in animal."""
    from rewild4d.datasets.builtin import synthetic
    from rewild4d.datasets.rigs.studio import render_artemis

    walk = synthetic.build("tiger")[0]
    return render_artemis([replace(walk, bones=walk.bones[:8])], folder, views=3, width=96, height=64, progress=None)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rewild4d-kills-") as name:
        drill = Drill(make_data(Path(name) / "tiger"), Path(name))
        known = durations(drill.start("whole"))
        whole = drill.result("whole")
        good = 0
        for number, moment in enumerate(draw(known, options.moments, options.seed)):
            if moment[0] != "prior":
                drill.lend_prior("whole", f"killed{number}")
            drill.start(f"killed{number}", moment)
            drill.start(f"killed{number}")
            wrong = differences(whole, drill.result(f"killed{number}"))
            good += not wrong
            stage, which, seconds = moment
            found = f"not as undisturbed: {', '.join(wrong)}" if wrong else "as undisturbed"
            print(f"{number + 1:3d}  {stage} {which}, {seconds:.3f} s in: {found}", flush=True)
    print(f"{good} of {options.moments} end in the undisturbed result")
    return 0 if good == options.moments else 1


if __name__ == "__main__":
    sys.exit(main())
