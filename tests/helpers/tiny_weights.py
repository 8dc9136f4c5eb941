"""A world with one small network: its published files, and the package told to know them instead of the real ones."""

import hashlib
import io
import os
import pickle
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from calling import call

from rewild4d.commands import weights as command
from rewild4d.metrics import weight_files, weights
from rewild4d.metrics.weights import load_weights

KERNEL = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5)  # [h, w, in, out]
TREE = {
    "AlexNet_0": {"Conv_0": {"kernel": KERNEL, "bias": np.ones(5, np.float32)}},
    "NetLinLayer_0": {"Conv_0": {"kernel": np.full((1, 1, 5, 1), 0.5, np.float32)}},
}
TENSORS = {
    "head.0": torch.full((5,), 0.5),
    "trunk.0.bias": torch.ones(5),
    "trunk.0.weight": torch.from_numpy(KERNEL.transpose(3, 2, 0, 1).copy()),
}
TRUNK = {"features.0.weight": TENSORS["trunk.0.weight"], "features.0.bias": TENSORS["trunk.0.bias"]}
HEADS = {"lin0.model.1.weight": TENSORS["head.0"].reshape(1, 5, 1, 1)}


def quiet(_: str) -> None:
    pass


def saved(state: dict[str, torch.Tensor]) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream)
    return stream.getvalue()


def pinned(data: bytes) -> dict[str, int | str]:
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


@dataclass
class Tiny:
    """A world with one small network, its published files, and folders of its own."""

    here: Path
    kept: bytes
    files: dict[str, bytes]

    def put(self, folder: str, *names: str) -> Path:
        """Write published files into a folder."""
        (self.here / folder).mkdir(parents=True, exist_ok=True)
        for name in names:
            (self.here / folder / name).write_bytes(self.files[name])
        return self.here / folder

    @property
    def path(self) -> Path:
        return self.here / "home" / "tiny.safetensors"


def archives(data: bytes) -> dict[str, bytes]:
    tar, wheel = io.BytesIO(), io.BytesIO()
    with tarfile.open(fileobj=tar, mode="w:gz") as archive:
        entry = tarfile.TarInfo("tiny-1/weights/tiny.ckpt")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    with zipfile.ZipFile(wheel, "w") as archive_:
        archive_.writestr("tiny/tiny.ckpt", data)
    return {"tiny-1.tar.gz": tar.getvalue(), "tiny-1-py3-none-any.whl": wheel.getvalue()}


def pin(monkeypatch: pytest.MonkeyPatch, kept: bytes, files: dict[str, bytes]) -> None:
    """Let the package know one network and these files instead of the real ones."""
    shapes = {
        "tiny.ckpt": ("pickle", "flax-lpips"),
        "trunk.pth": ("torch", "torchvision"),
        "heads.pth": ("torch", "lpips-heads"),
    }
    known = weights.Table(
        networks={
            "tiny": weights.Network(
                **pinned(kept), used_by="a test", licence="none", made_from=[["tiny.ckpt"], ["trunk.pth", "heads.pth"]]
            )
        },
        archives={
            "tiny-1.tar.gz": weights.Archive(
                **pinned(files["tiny-1.tar.gz"]),
                requirement="tiny==1",
                members={"tiny.ckpt": "tiny-1/weights/tiny.ckpt"},
            ),
            "tiny-1-py3-none-any.whl": weights.Archive(
                **pinned(files["tiny-1-py3-none-any.whl"]),
                requirement="tiny==1",
                members={"tiny.ckpt": "tiny/tiny.ckpt"},
            ),
        },
        files={
            name: weights.PublishedFile(**pinned(files[name]), form=form, layout=layout)
            for name, (form, layout) in shapes.items()
        },
    )
    for module in (weights, weight_files, command):
        monkeypatch.setattr(module, "table", lambda: known)


class Calls:
    """Unpickled by a careless reader, it makes a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def make_tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Tiny:
    """Published files in folders of their own, and no other place to look for weights."""
    data = pickle.dumps(TREE)
    files = {"tiny.ckpt": data, "trunk.pth": saved(TRUNK), "heads.pth": saved(HEADS), **archives(data)}
    kept = safetensors.torch.save(TENSORS)
    pin(monkeypatch, kept, files)
    monkeypatch.setenv("REWILD4D_WEIGHTS", str(tmp_path / "home"))
    monkeypatch.setenv("REWILD4D_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return Tiny(tmp_path, kept, files)


def status(*words: str) -> int:
    return call("weights", *words)


def assert_loaded() -> None:
    loaded = load_weights("tiny")
    assert loaded.digest == hashlib.sha256(safetensors.torch.save(TENSORS)).hexdigest()
    assert loaded.tensors.keys() == TENSORS.keys()
    assert all(torch.equal(loaded.tensors[name], TENSORS[name]) for name in TENSORS)
