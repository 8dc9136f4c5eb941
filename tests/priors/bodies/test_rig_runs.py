"""A rig of one's own from the command line: fitted to a film, taken by a run, refused where it cannot be used."""

from pathlib import Path

import numpy as np
import pytest
from calling import call, refusal
from films import TINY, panned, plan
from rig_files import save_template

from rewild4d.datasets.video.online import Online
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import load_prior
from rewild4d.running import runner

pytestmark = pytest.mark.usefixtures("cache", "tiny_footage", "one_thread")

WAVE = 0.4 * np.sin(np.linspace(0, 2 * np.pi, 25))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_template(tmp_path_factory.mktemp("rigs") / "dog.glb", QUADRUPED.build(), {13: WAVE})


def test_it_is_fitted_to_a_film_and_taken_by_a_run(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rewild4d.priors.choose.FOOTAGE", TINY)
    folder = panned(tmp_path / "clip")
    words = ("--frames", folder / "frames", "--masks", folder / "masks", "--out", tmp_path / "p.npz", "--fps", 10)
    assert call("prior", "fit", *words, "--rig", rig) == 0
    assert "body_margin" not in capsys.readouterr().out
    made = load_prior(tmp_path / "p.npz")
    assert made.provenance.startswith("Template (dog.glb) fitted to the 12 masks")
    assert made.vertices.shape == QUADRUPED.build().vertices.shape and len(made.parents) == 20
    (record,) = runner.execute(plan(Online(folder, fps=10), "clip", tmp_path / "runs", f"template:{rig}"))
    assert record.status == "ok", record.error
    assert record.prior["provenance"].startswith("Template (dog.glb)")
    assert record.prior["choice"] == f"template:{rig}"


def test_another_file_of_the_same_name_is_another_prior(rig: Path, tmp_path: Path) -> None:
    folder = panned(tmp_path / "clip", 6)
    clip, truth = Online(folder, fps=10).load("clip", plan(Online(folder, fps=10), "clip", tmp_path).protocol.selection)
    other = save_template(tmp_path / "dog.glb", QUADRUPED.build(), {13: 2 * WAVE})
    first, second = (PriorChoice(f"template:{path}", STANDARD).identity(clip, truth) for path in (rig, other))
    assert first != second


def test_what_cannot_be_used_is_one_sentence(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = panned(tmp_path / "clip", 6)
    words = ("--frames", folder / "frames", "--masks", folder / "masks", "--out", tmp_path / "p.npz", "--rig")
    keypoints = ("--keypoints", tmp_path / "k.json", "--mapping", "badja")
    assert "--rig and --keypoints: expected one of them" in refusal(capsys, "prior", "fit", *words, rig, *keypoints)
    assert "--rig and --prior: expected one of them" in refusal(
        capsys, "prior", "fit", *words, rig, "--prior", "template:biped"
    )
    assert "missing.glb" in refusal(capsys, "prior", "fit", *words, tmp_path / "missing.glb")
    assert f"--rig {tmp_path}: expected a .glb or .gltf file." in refusal(capsys, "prior", "fit", *words, tmp_path)
    (tmp_path / "broken.glb").write_bytes(rig.read_bytes()[:500])
    assert "broken.glb" in refusal(capsys, "prior", "fit", *words, tmp_path / "broken.glb")
    assert not (tmp_path / "p.npz").exists()
