"""The command line: a thin skin over callables. Results go to standard output, everything else to standard error.

A command's module is imported when the command is called, and each imports what computes once its flags are known: help
and misspelt words wait for neither torch nor numba.
"""

import errno
import io
import os
import signal
import sys

from rewild4d import __version__
from rewild4d.errors import UserError, shown, unknown_name
from rewild4d.running.interrupts import STATUS, answer_interrupts

COMMANDS = {
    "run": ("run", "fit a method on a data set and score it on views it never saw"),
    "evaluate": ("evaluate", "score a saved reconstruction again"),
    "masks": ("masks", "make masks of the animal for a video that has none"),
    "export": ("export", "write a reconstruction as .ply, .glb, cameras and films"),
    "view": ("view", "look at runs in the browser, from any side at any time"),
    "report": ("report", "write one HTML page of a run, with a player of its Gaussians"),
    "status": ("status", "say what of a folder of runs is done, running, failed or waiting, and the time left"),
    "score": ("score", "score two folders of images or clips, or two .ply files, without our methods"),
    "definitions": ("definitions", "score a saved run by the definitions of several papers"),
    "table": ("table", "print a table of what was found"),
    "leaderboard": ("leaderboard", "make a static page of what was found"),
    "list": ("overview", "methods, data sets, protocols, presets and tables"),
    "check": ("check", "verify a data set's folder, or that a method keeps the contract"),
    "make": ("make", "render a rigged, animated glTF as a data set with exact truth"),
    "prior": ("prior", "fit the template to masked frames, or import 3D-Fauna's files"),
    "weights": ("weights", "list, fetch, import and verify the networks behind LPIPS, KID and FVD"),
    "bench": ("bench", "time the rasterizer or a training step on this machine"),
}
"""Name -> module in `rewild4d.commands` with `main(arguments) -> exit status`, and a line for the overview."""
STOPPED = "rewild4d-bench: stopped; the same command goes on where this one was."


def usage() -> str:
    """Return the overview that `--help` prints."""
    rows = "\n".join(f"  {name:<12} {text}" for name, (_, text) in COMMANDS.items())
    return (
        f"rewild4d-bench {__version__}: a benchmark for 4D animals from one monocular video\n\n"
        f"usage: rewild4d-bench COMMAND [options]      (COMMAND --help tells its options)\n\n{rows}\n\n"
        "first run: rewild4d-bench run --method ours --dataset artemis"
    )


def main(arguments: list[str] | None = None) -> None:
    """Run a command and exit: 0 done, 1 a run failed, 2 bad input, 130 stopped by Ctrl-C."""
    watching, status = False, 1
    try:
        watching = answer_interrupts(main.__code__, f"{STOPPED}\n")
        _print_utf8()
        status = _run(sys.argv[1:] if arguments is None else arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has had enough, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 0
    except UserError as error:
        print(f"rewild4d-bench: {error}", file=sys.stderr)
        status = 2
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        refused = UserError(
            f"{shown(error.filename, 200)}: expected a shorter name: the file system takes none of this length."
        )
        print(f"rewild4d-bench: {refused}", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        status = STATUS
    finally:
        if watching:  # a second Ctrl-C, while the process ends, would print pages
            signal.signal(signal.SIGINT, signal.SIG_IGN if status == STATUS else signal.default_int_handler)
    if status == STATUS:
        print(STOPPED, file=sys.stderr)
    sys.exit(status)


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(usage())
        return 0 if words else 2
    if words[0] == "--version":
        print(__version__)
        return 0
    if words[0] not in COMMANDS:
        raise unknown_name("command", words[0], COMMANDS)
    import importlib

    return importlib.import_module(f"rewild4d.commands.{COMMANDS[words[0]][0]}").main(words[1:])


def _print_utf8() -> None:
    """Encode standard output as UTF-8: tables hold arrows, and Windows gives files and pipes an older code page."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.encoding.lower() != "utf-8":
        sys.stdout.reconfigure(encoding="utf-8")
