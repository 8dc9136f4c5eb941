"""The notebook's functions: lazy to import, the same numbers as a run, one sentence for what cannot be."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import rewild4d as rw
from rewild4d.baselines.prior_only import PriorOnlyConfig
from rewild4d.config import load_preset
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.ours.config import Config
from rewild4d.running.conformance import tiny_case


@pytest.fixture(scope="module")
def case() -> rw.LoadedCase:
    made = tiny_case()
    return rw.LoadedCase(made.clip, made.truth, find_protocol("artemis", None), made)


def test_importing_the_package_loads_nothing_heavy() -> None:
    program = "import sys, rewild4d; print(*sorted({'torch', 'numpy', 'numba', 'pandas'} & {*sys.modules}), 'nothing')"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["nothing"]
    assert {"fit", "records"} <= {*dir(rw)}
    with pytest.raises(AttributeError, match="module 'rewild4d' has no attribute 'fitt'"):
        rw.fitt  # noqa: B018


def test_fit_render_evaluate(case: rw.LoadedCase) -> None:
    fitted = rw.fit(case, "prior-only", settings={"gaussians": 500}, progress=False)
    frame = case.truth.held_out[0]
    assert frame.camera is not None
    image = rw.render(fitted, frame.time, frame.camera, background=0.0)
    assert image.shape == (*frame.mask.shape[1:], 3) and image.dtype == np.float32
    assert image.min() >= 0 and 0.1 < image.max() <= 1
    scores = rw.evaluate(fitted, case, progress=False)
    assert scores.index.name == "metric" and list(scores.columns) == ["value", "unit", "better", "count", "note"]
    assert scores.loc["psnr", "value"] > 15 and scores.loc["psnr", "unit"] == "dB"
    assert scores.loc["chamfer_relative", "note"].startswith("not computed: ")
    assert np.isnan(scores.loc["chamfer_relative", "value"])


def test_the_same_seed_gives_the_same_image(case: rw.LoadedCase) -> None:
    threads = torch.get_num_threads()
    images = [rw.render(rw.fit(case, "prior-only", seed=3, progress=False), 0.0, case.clip.frames[0].camera)
              for _ in range(2)]  # fmt: skip
    assert (images[0] == images[1]).all() and torch.get_num_threads() == threads


def test_settings_are_those_of_the_flags() -> None:
    config = load_preset("ours", Config, "quick")
    changed = rw.with_settings(config, {"loss.ssim": 0.3, "geometry.tv-every": 2})
    assert (changed.loss.ssim, changed.geometry.tv_every) == (0.3, 2)
    assert rw.with_settings(config, {}) == config
    with pytest.raises(UserError, match="unknown setting 'loss.sism'. Did you mean 'loss.ssim'?"):
        rw.with_settings(config, {"loss.sism": 0.3})
    with pytest.raises(UserError, match="settings: expected values that fit PriorOnlyConfig, but Expected `int`"):
        rw.with_settings(PriorOnlyConfig(), {"gaussians": "many"})


def test_what_cannot_be_is_a_sentence(case: rw.LoadedCase, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="unknown method 'our'. Did you mean 'ours'?"):
        rw.fit(case, "our", progress=False)
    with pytest.raises(UserError, match="the data set 'davis' has no built-in data"):
        rw.load_case("davis", progress=False)
    with pytest.raises(UserError, match="expected one mask for each frame, got 2 and 1"):
        rw.case_from_frames([np.zeros((8, 8, 3), np.uint8)] * 2, [np.zeros((8, 8))], fps=10.0)
    with pytest.raises(UserError, match="expected frames of 3 axes, got shape \\(8, 8\\)"):
        rw.case_from_frames([np.zeros((8, 8), np.uint8)], [np.zeros((8, 8))], fps=10.0)
    with pytest.raises(UserError, match="expected a folder of runs, but there is no such folder"):
        rw.records(tmp_path / "none")
    with pytest.raises(UserError, match="render: the reconstruction does not know the input camera"):
        empty = rw.fit(case, "empty", progress=False)
        rw.render(empty, 0.0)
