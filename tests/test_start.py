"""The start: what help and misspelt words must not wait for, and Ctrl-C at any moment."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rewild4d import cli, registry
from rewild4d.running.interrupts import STATUS

HEAVY = ("torch", "numba", "pandas", "open3d", "scipy", "cv2", "sklearn", "matplotlib", "trimesh", "numpy")
"""Packages that take from tenths of a second to seconds to import."""
TELL = f"import sys; print('heavy:', *sorted({{*{HEAVY}}} & {{*sys.modules}}), file=sys.stderr)"
CALL = f"import atexit; atexit.register(lambda: exec({TELL!r})); from rewild4d.cli import main; main()"


def python(code: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)


def test_what_flags_need_imports_nothing_heavy() -> None:
    """The package, its command line, every command, and the settings and tables that lists and flags read."""
    commands = sorted({f"commands.{module}" for module, _ in cli.COMMANDS.values()})
    ground = ["config", "contracts", "registry", "files", "evaluation.protocol", "leaderboard.specs", "metrics.names",
              "metrics.score", "priors.config", "ours.config"]  # fmt: skip
    settings = sorted({module.removeprefix("rewild4d.") for module, _, _ in registry.SETTINGS.values()})
    modules = ["rewild4d", *(f"rewild4d.{name}" for name in ("cli", *ground, *settings, *commands))]
    each = f"import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name); {TELL}"
    done = python(each, *modules)
    assert dict(zip(modules, done.stderr.splitlines(), strict=False)) == dict.fromkeys(modules, "heavy:")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--help", ""),
        ("list", ""),
        ("run --method gart --help", ""),
        ("runn", "unknown command 'runn'. Did you mean 'run'?"),
        ("run --method our", "unknown method 'our'. Did you mean 'ours'?"),
        ("run --dataset artemi", "unknown dataset 'artemi'. Did you mean 'artemis'?"),
        ("run --mehtod ours", "unknown option '--mehtod'. Did you mean '--method'?"),
        ("run --method ours --loss.sism 0.3", "unknown option '--loss.sism'. Did you mean '--loss.ssim'?"),
        ("run --method d3dgs-star --network.widht=64", "Did you mean '--network.width'?"),
        ("run --method external --profil glb", "Did you mean '--profile'?"),
        ("run --method prior-only --no-jason", "Did you mean '--no-json'?"),
        ("run --preset quik", "unknown preset of 'ours' 'quik'. Did you mean 'quick'?"),
        ("run --iterations many", "Error parsing --iterations: invalid literal for int"),
        ("run --table artemi", "unknown table 'artemi'. Did you mean 'artemis'?"),
        ("table --foramt latex", "unknown option '--foramt'. Did you mean '--format'?"),
        ("bench rasterizr", "unknown benchmark 'rasterizr'. Did you mean 'rasterizer'?"),
        ("weights lst", "unknown command of weights 'lst'. Did you mean 'list'?"),
    ],
)
def test_help_and_misspelt_words_wait_for_nothing_heavy(words: str, sentence: str) -> None:
    done = python(CALL, *words.split())
    *said, heavy = done.stderr.splitlines()
    assert heavy == "heavy:"
    assert done.returncode == (2 if sentence else 0)
    assert len(said) == bool(sentence) and sentence in "".join(said)


def test_what_is_known_of_a_method_before_it_is_loaded_is_the_methods_own() -> None:
    assert registry.SETTINGS.keys() == registry.METHODS.keys()
    for name in registry.METHODS:
        method = registry.load_method(name)
        assert registry.method_info(name) == method.info and registry.load_config(name) is method.Config
    for name in registry.DATASETS:
        assert registry.load_dataset(name).__doc__.startswith(registry.dataset_title(name) + ".\n")


def test_ctrl_c_while_a_command_is_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupting:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "rewild4d.commands.overview":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "rewild4d.commands.overview", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupting(), *sys.meta_path])
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop:
            cli.main(["list"])
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert (stop.value.code, capsys.readouterr().err) == (STATUS, f"{cli.STOPPED}\n")


def test_a_command_leaves_ctrl_c_as_it_was(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert signal.getsignal(signal.SIGINT) is before and "usage" in capsys.readouterr().out


INTERRUPT = """
import os, signal, time
def swallow(kill, process):
    try:
        kill(process, signal.SIGINT)
        time.sleep(20)
    except KeyboardInterrupt:
        print("unwound")
        raise OSError("another error") if __name__ != "plain" else KeyboardInterrupt
"""
"""Interrupts processes and turns the KeyboardInterrupt into another error, unless it is called plain."""


def interrupted(folder: Path, body: str) -> subprocess.CompletedProcess[str]:
    """Call `list` in a terminal of its own, with another function in the place of the command's."""
    (folder / "library.py").write_text(INTERRUPT)
    (folder / "imported.py").write_text("import os, library\nlibrary.swallow(os.kill, os.getpid())\n")
    (folder / "command.py").write_text(f"import os\nimport library\n\ndef main(arguments):\n{body}\n    return 0\n")
    unignored = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # a test in the background
    stand_in = f"{unignored}; import sys; sys.path.insert(0, {str(folder)!r}); import command"
    code = f"{stand_in}; sys.modules['rewild4d.commands.overview'] = command; from rewild4d.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, "list"], capture_output=True, text=True, start_new_session=True)


@pytest.mark.parametrize(
    ("body", "out"),
    [
        ("    library.__dict__['__name__'] = 'plain'; library.swallow(os.kill, os.getpid())", "unwound\n"),
        ("    library.__dict__['__name__'] = 'numba.core'; library.swallow(os.kill, os.getpid())", ""),
        ("    import imported", ""),
    ],
    ids=["work", "compiler", "import"],
)
def test_ctrl_c_unwinds_work_and_ends_what_would_swallow_it(body: str, out: str, tmp_path: Path) -> None:
    done = interrupted(tmp_path, body)
    assert (done.returncode, done.stderr, done.stdout) == (STATUS, f"{cli.STOPPED}\n", out)


@pytest.mark.parametrize("name", ["plain", "numba.core"])
def test_ctrl_c_ends_workers_that_start_wait_or_work_without_a_word(name: str, tmp_path: Path) -> None:
    body = f"""
    from rewild4d.running.workers import Threads, Workers
    with Workers(3, Threads(1, 1), "auto") as workers:
        workers.map(work, [(0,), (1,), (2,)], lambda *_: print("lost"))

def work(number):
    import contextlib, io
    from rewild4d.progress import Progress
    library.__dict__['__name__'] = {name!r}
    with contextlib.redirect_stderr(io.StringIO()):
        Progress("its lock may be a semaphore, which Python tells of where nobody closed it")(1, 2)
    if number:
        library.swallow(os.killpg, os.getpgid(0))
"""
    done = interrupted(tmp_path, body)
    assert (done.returncode, done.stderr) == (STATUS, f"{cli.STOPPED}\n")
    assert "lost" not in done.stdout
