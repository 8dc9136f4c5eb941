"""Method files, and programs in environments of their own: what runs, what the record says of it, wrong files."""

import os
import re
import venv
from pathlib import Path

import msgspec
import pytest
from artemis_animals import write_animal
from calling import refusal
from external_program import a_plan, fit

from rewild4d.baselines.external import External, ExternalConfig
from rewild4d.baselines.external_file import resolved
from rewild4d.commands.run import _with_method_file
from rewild4d.errors import UserError
from rewild4d.leaderboard.tables import standings
from rewild4d.leaderboard.variants import variants
from rewild4d.running import runner
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

PROGRAM = """
import sys
from pathlib import Path
for i in range({frames}):
    text = "v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n"
    (Path(sys.argv[2]) / f"frame_{{i:04d}}.obj").write_text(text)
(Path(sys.argv[2]) / "where.txt").write_text(sys.prefix)
"""
FILE = """
name = "Theirs"
command = "python {here}/run.py {clip} {out}"
environment = "venv:{here}/env"
description = "Three triangles"
licence = "MIT"
citation = "They et al., 2026"
authors = ["A. One", "B. Two"]
links = ["https://example.org/theirs"]

[settings]
points = 200
timeout = 60
"""


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case(frames=2, views=3)


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A method file beside its program and its environment."""
    folder = tmp_path_factory.mktemp("their method")
    venv.create(folder / "env", symlinks=os.name != "nt")
    (folder / "run.py").write_text(PROGRAM.format(frames=2))
    (folder / "theirs.toml").write_text(FILE)
    return folder / "theirs.toml"


def test_a_method_file_runs_in_its_environment_and_the_record_says_whose_it_is(
    case: Case, method: Path, tmp_path: Path
) -> None:
    plan = a_plan(case, tmp_path, ExternalConfig(file=str(method)))
    (found,) = runner.execute(plan)
    assert found.status == "ok", found.error
    assert found.diagnostics["program"] == "Theirs" and found.diagnostics["gaussians"] == 200
    about = {name: found.code[name] for name in ("program", "licence", "citation", "authors", "links", "description")}
    assert about == {
        "program": "Theirs", "licence": "MIT", "citation": "They et al., 2026", "authors": "A. One, B. Two",
        "links": "https://example.org/theirs", "description": "Three triangles",
    }  # fmt: skip
    assert found.code["environment"] == f"venv:{method.parent / 'env'}" and len(found.code["program_digest"]) == 64
    named = msgspec.structs.replace(found, prior={"choice": "template"})
    assert [one.label for one in variants([named])] == ["external: Theirs"]
    (table,) = standings([named])
    assert table.rows[0].stubs == ("external: Theirs",)


def test_the_program_runs_with_the_interpreter_of_its_environment(case: Case, method: Path, tmp_path: Path) -> None:
    fit(case, ExternalConfig(file=str(method)), tmp_path)
    assert Path((tmp_path / "out" / "where.txt").read_text()) == method.parent / "env"
    command = f"'venv:{method.parent / 'env'}' python '{method.parent / 'run.py'}' {{clip}} {{out}}"
    (tmp_path / "again").mkdir()
    fit(case, ExternalConfig(command=command, points=200), tmp_path / "again")
    assert Path((tmp_path / "again" / "out" / "where.txt").read_text()) == method.parent / "env"


def test_another_command_in_the_file_is_another_run_and_another_citation_is_not(method: Path, tmp_path: Path) -> None:
    def identity(text: str) -> str:
        (tmp_path / "theirs.toml").write_text(text.replace("{here}", str(method.parent)))
        return External().inputs(ExternalConfig(file=str(tmp_path / "theirs.toml")), "tiny/walk")

    before = identity(FILE.replace("their method", "x"))
    assert identity(FILE.replace("2026", "2027")) == before
    assert identity(FILE.replace("points = 200", "points = 300")) != before
    assert identity(FILE.replace("{out}", "{out} --fast")) != before


def test_a_flag_wins_over_the_file(method: Path) -> None:
    assert resolved(ExternalConfig(file=str(method), points=7)).points == 7
    assert (resolved(ExternalConfig(file=str(method))).points, resolved(ExternalConfig(file=str(method))).timeout) == (
        200, 60.0,
    )  # fmt: skip


def test_run_takes_a_file_for_the_name_of_a_method() -> None:
    expected = ["--seeds", "1", "--method", "external", "--file", "a/b.toml", "--json"]
    assert _with_method_file(["--seeds", "1", "--method", "a/b.toml", "--json"]) == expected
    assert _with_method_file(["--seeds", "1", "--method=a/b.toml", "--json"]) == expected
    assert _with_method_file(["--method", "gart"]) == ["--method", "gart"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name = ", "expected a method file, but Invalid value"),
        ('name = "x"', "expected either 'command' or 'folder' in a method file."),
        ('name = "x"\ncommand = "a"\nfolder = "b"', "expected either 'command' or 'folder' in a method file."),
        ('command = "a"', "expected a method file, but Object missing required field `name`"),
        ('name = "x"\ncomand = "a"', "expected a method file, but Object contains unknown field `comand`"),
        ('name = "x"\ncommand = "a"\nenvironment = "conda:x"', "to be venv:PATH or docker:IMAGE, got 'conda:x'"),
        (
            'name = "x"\nfolder = "a"\nsettings.point = 3',
            "expected settings among profile, placed",
        ),
        ('name = "x"\nfolder = "a"\nsettings.points = -3', "expected a method file, but in 'settings'"),
        ('name = "x"\nfolder = "a"\nsettings.up = "w"', "expected a method file, but in 'settings'"),
    ],
)
def test_a_file_that_does_not_fit_is_one_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(UserError, match=re.escape(sentence)) as error:
        resolved(ExternalConfig(file=str(tmp_path / "x.toml")))
    assert str(error.value).startswith(f"{tmp_path / 'x.toml'}: ")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--method", "/no/such.toml"], "/no/such.toml: expected a method file, but there is no such file"),
        (
            ["--method", "external", "--command", "venv:/no python {clip} {out}"],
            "venv:/no: expected an environment",
        ),
        (["--method", "external", "--command", "venv:/no"], "expected {clip} and {out} for the two folders"),
        (
            ["--method", "external", "--file", "x.toml", "--command", "x {clip} {out}"],
            "expected either --file (a method file) or --command or --folder, got both",
        ),
    ],
)
def test_a_wrong_command_is_told_before_anything_is_made(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    data = write_animal(tmp_path / "cat")
    said = refusal(capsys, "run", *words, "--data", data, "--out", tmp_path / "runs")
    assert sentence in said and len(said.strip().splitlines()) == 1
    assert not list((tmp_path / "runs").rglob("*.*"))
