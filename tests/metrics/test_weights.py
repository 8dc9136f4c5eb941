"""Weights: every byte is checked, nothing that a file says is run, and each thing that can go wrong is one sentence."""

import errno
import hashlib
import pickle
from pathlib import Path

import pytest
import safetensors.torch
from tiny_weights import TENSORS, TREE, Calls, Tiny, assert_loaded, make_tiny, pin, quiet, status

from rewild4d.errors import UserError
from rewild4d.metrics.weight_files import import_weights
from rewild4d.metrics.weights import WeightsMissing, load_weights


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Tiny:
    return make_tiny(monkeypatch, tmp_path)


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
        "rewild4d.files._begin", lambda _: (_ for _ in ()).throw(OSError(errno.EROFS, "Read-only file system"))
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
