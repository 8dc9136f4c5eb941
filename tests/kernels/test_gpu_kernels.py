"""The GPU's small kernels against their twins in double precision: interpreted, and on a GPU where there is one."""

import json
import os
import subprocess
import sys

import pytest
import torch
import triton_twins

from rewild4d.kernels import gpu
from rewild4d.kernels.switch import VARIABLE

needs_triton = pytest.mark.skipif(not gpu._has_triton(), reason="triton is not installed here")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")
NAMES = {
    "multiply",
    "L1 and SSIM",
    "smallest axes",
    "top axes",
    "colours of splats",
    *(f"colours of degree {degree}" for degree in (1, 2, 3)),
}


@needs_triton
def test_interpreted_kernels_are_their_twins() -> None:
    words = [sys.executable, triton_twins.__file__, "cpu"]
    done = subprocess.run(words, env=os.environ | {"TRITON_INTERPRET": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    errors = json.loads(done.stdout)
    assert errors.keys() == NAMES
    assert max(map(max, errors.values())) < 1e-5, errors


@needs_gpu
def test_kernels_on_a_gpu_are_their_twins() -> None:
    errors = triton_twins.errors("cuda")
    assert errors.keys() == NAMES and max(map(max, errors.values())) < 1e-5, errors


def test_they_run_on_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not gpu.on_gpu(torch.ones(2))
    monkeypatch.setenv(VARIABLE, "torch")
    assert not gpu.on_gpu()
