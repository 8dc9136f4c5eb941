"""Cluster files, and flags of clusters: what cannot be is one sentence, before anything is made."""

import signal
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest
from calling import refusal

from rewild4d.errors import UserError
from rewild4d.running.cluster import ClusterFile, Site, check_site, connected, read_cluster_file

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
if find_spec("dask_jobqueue") is None:
    pytest.skip("the extra `cluster` is not installed", allow_module_level=True)
TOML = 'class = "SLURMCluster"\nworkers = 16\n[arguments]\nqueue = "gpu"\ncores = 1\n'
YAML = "class: SLURMCluster\nworkers: 16\narguments:\n  queue: gpu\n  cores: 1\n"


def test_classes_of_queues_leave_ctrl_c_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """dask_jobqueue sets a handler of its own when it is imported."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "dask_jobqueue"]:
        monkeypatch.delitem(sys.modules, name)
    before = signal.getsignal(signal.SIGINT)
    (tmp_path / "a.toml").write_text(TOML)
    with suppress(UserError):  # there may be no Slurm here
        check_site(Site("shared", file=read_cluster_file(tmp_path / "a.toml"), source="a.toml"))
    assert "dask_jobqueue.runner" in sys.modules and signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(("name", "text"), [("a.toml", TOML), ("a.yaml", YAML), ("a.yml", YAML)])
def test_toml_and_yaml_say_the_same(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    found = read_cluster_file(tmp_path / name)
    assert found == ClusterFile("SLURMCluster", workers=16, retries=3, arguments={"queue": "gpu", "cores": 1})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "workers = 2",
            "expected a cluster file (class, workers, arguments), but Object missing required field `cl",
        ),
        ('class = "SLURMCuster"', "unknown class of a cluster 'SLURMCuster'. Did you mean 'SLURMCluster'?"),
        ('class = "dask:Nope"', "expected a class at dask:Nope, but module 'dask' has no attribute 'Nope'"),
        ('class = "LocalCluster"\nworkers = 0', "expected `workers` of at least 1, got 0"),
        ('class = "LocalCluster"\nretries = -1', "expected `retries` of at least 0, got -1"),
        ('class = "LocalCluster"\nworker = 3', "Object contains unknown field `worker`"),
        ("class = ", "but Invalid value (at end of document)"),
    ],
)
def test_a_cluster_file_that_cannot_be_is_a_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(UserError) as error:
        read_cluster_file(tmp_path / "bad.toml")
    assert sentence in str(error.value)


def test_yaml_that_cannot_be_parsed_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text("class: [")
    with pytest.raises(UserError, match="bad.yaml: expected a cluster file .class, workers, arguments., but while"):
        read_cluster_file(tmp_path / "bad.yaml")


def test_a_queue_that_is_not_here_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(UserError, match="^a.toml: PBSCluster calls the command qsub, which is not here.$"):
        check_site(Site("shared", file=ClusterFile("PBSCluster"), source="a.toml"))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"cores": 4, "processes": 2}, "expected as many `processes` as `cores` (a run has one thread), got 2 and 4."),
        ({"cores": 1}, "SLURMCluster could not be started: "),
    ],
)
def test_arguments_that_a_class_does_not_take_are_a_sentence(arguments: dict[str, int], sentence: str) -> None:
    site = Site("shared", file=ClusterFile("SLURMCluster", arguments=arguments), source="a.toml")
    with pytest.raises(UserError) as error, connected(site, 1):
        pass
    assert str(error.value).startswith(f"a.toml: {sentence}")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--scheduler tcp://a:1", "--scheduler: expected --executor dask with it, got local."),
        ("--cluster a.toml", "--cluster: expected --executor dask with it, got local."),
        ("--records returned", "--records: expected --executor dask with it, got local."),
        (
            "--executor dask --scheduler tcp://a:1 --cluster a.toml",
            "--cluster: expected either this or --scheduler, got",
        ),
        ("--executor slurm", "invalid choice 'slurm' for argument '--executor'"),
    ],
)
@pytest.mark.parametrize("start", ["run", "run --table artemis"])
def test_flags_that_do_not_fit_are_one_sentence(
    start: str, words: str, sentence: str, capsys: pytest.CaptureFixture[str],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    said = refusal(capsys, *start.split(), *words.split())
    assert sentence in said and len(said.splitlines()) == 1 and not list(tmp_path.iterdir())


def test_without_the_extra_one_sentence_names_it(capsys: pytest.CaptureFixture[str], tmp_path: Path,
                                                 monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = refusal(capsys, "run", "--executor", "dask")
    assert said == (
        "rewild4d-bench: --executor dask: expected the package distributed, run: pip install -e '.[cluster]'.\n"
    )
