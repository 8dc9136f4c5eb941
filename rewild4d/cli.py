"""The command line: a thin skin over callables. Results go to standard output, everything else to standard error."""

import io
import os
import sys
from collections.abc import Callable

from rewild4d import __version__
from rewild4d.commands import (
    bench,
    check,
    evaluate,
    export,
    leaderboard,
    make,
    masks,
    overview,
    prior,
    run,
    score,
    table,
    weights,
)
from rewild4d.errors import UserError, unknown_name

COMMANDS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "run": (run.main, "fit a method on a data set and score it on views it never saw"),
    "evaluate": (evaluate.main, "score a saved reconstruction again"),
    "masks": (masks.main, "make masks of the animal for a video that has none"),
    "export": (export.main, "write a reconstruction as .ply, .glb, cameras and films"),
    "score": (score.main, "score two folders of images or clips, or two .ply files, without our methods"),
    "table": (table.main, "print a table of what was found"),
    "leaderboard": (leaderboard.main, "make a static page of what was found"),
    "list": (overview.main, "methods, data sets, protocols, presets and tables"),
    "check": (check.main, "verify a data set's folder, or that a method keeps the contract"),
    "make": (make.main, "render a rigged, animated glTF as a data set with exact truth"),
    "prior": (prior.main, "fit the template to masked frames, or import 3D-Fauna's files"),
    "weights": (weights.main, "list, fetch, import and verify the networks behind LPIPS, KID and FVD"),
    "bench": (bench.main, "time the rasterizer or a training step on this machine"),
}


def usage() -> str:
    """The overview that `--help` prints."""
    rows = "\n".join(f"  {name:<12} {text}" for name, (_, text) in COMMANDS.items())
    return (
        f"rewild4d-bench {__version__}: a benchmark for 4D animals from one monocular video\n\n"
        f"usage: rewild4d-bench COMMAND [options]      (COMMAND --help tells its options)\n\n{rows}\n\n"
        "first run: rewild4d-bench run --method ours --dataset artemis"
    )


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Exit status: 0 done, 1 a run failed, 2 bad input."""
    _print_utf8()
    words = sys.argv[1:] if arguments is None else arguments
    if not words or words[0] in ("-h", "--help", "help"):
        print(usage())
        sys.exit(0 if words else 2)
    if words[0] == "--version":
        print(__version__)
        sys.exit(0)
    try:
        if words[0] not in COMMANDS:
            raise unknown_name("command", words[0], COMMANDS)
        status = COMMANDS[words[0]][0](words[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has had enough, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 0
    except UserError as error:
        print(f"rewild4d-bench: {error}", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("rewild4d-bench: stopped; the same command goes on where this one was.", file=sys.stderr)
        status = 130
    sys.exit(status)


def _print_utf8() -> None:
    """Encode standard output as UTF-8: tables hold arrows, and Windows gives files and pipes an older code page."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.encoding.lower() != "utf-8":
        sys.stdout.reconfigure(encoding="utf-8")
