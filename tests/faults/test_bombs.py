"""Small files that unpack to gigabytes are refused from their headers: soon, in little memory, with the limit named.

The limit is a sixteenth of a GiB here, so that the files can be made soon.
"""

import io
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from fault_readers import read_frame
from mutations import measured
from one_mask import read_values

from rewild4d.datasets.artemis.files import read_parents
from rewild4d.datasets.artemis.volume import _tensor
from rewild4d.datasets.images import read_picture
from rewild4d.datasets.video.footage import open_footage
from rewild4d.datasets.video.video_file import video_facts
from rewild4d.errors import UserError
from rewild4d.files import load_tensors
from rewild4d.foreign.reading import FILM, VARIABLE, largest, read_arrays
from rewild4d.io.ply import read_splats
from rewild4d.metrics.sets import read_features
from rewild4d.priors.io import load_prior

SOON, LITTLE = 2.0, 100 << 20
GIB = 1 << 30
BOMB = GIB // 8


def header(shape: tuple[int, ...], kind: str = "|u1") -> bytes:
    """The header of an .npy file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def zeros_in_zip(path: Path, name: str, size: int, begin: bytes = b"") -> None:
    """An archive with one entry of ``size`` zeros."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w") as entry:
        entry.write(begin)
        for _ in range(size >> 24):
            entry.write(bytes(1 << 24))


def npz(path: Path) -> None:
    zeros_in_zip(path, "about.npy", BOMB, header((BOMB,)))


def lying_npz(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", header((10**12,)) + b"\0" * 100)


def npy(path: Path) -> None:
    path.write_bytes(header((10**12,), "<i8") + b"\0" * 100)


def pth(path: Path) -> None:
    torch.save(torch.zeros(4), path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in parts.items():
            with archive.open(name, "w") as entry:
                entry.write(part)
                for _ in range(BOMB >> 24 if name.endswith("data/0") else 0):
                    entry.write(bytes(1 << 24))


def repeated(path: Path) -> None:
    torch.save(torch.zeros(1).expand(1 << 20, 1 << 20), path)


def png(path: Path) -> None:
    side, squeezed = 6_000, zlib.compressobj()
    rows = b"".join(squeezed.compress(bytes(side + 1)) for _ in range(side)) + squeezed.flush()
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b""))
    made = b"".join(struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + made)


def sparse(path: Path) -> None:
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n")
    with path.open("r+b") as file:
        file.truncate(GIB)


LARGE = r"of at most 0\.0625 GiB .* got 0\.125 GiB"
CASES: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object], str]] = {
    "prior": ("a.npz", npz, load_prior, LARGE),
    "features": ("a.npz", npz, read_features, LARGE),
    "lying prior": ("a.npz", lying_npz, load_prior, "its header says more values than it holds"),
    "parents": ("bone_parents.npy", npy, lambda path: read_parents(path.parent), "says more values than it holds"),
    "frame": ("a.npy", npy, read_frame, "its header says more values than it holds"),
    "tensor": ("a.pth", pth, _tensor, LARGE),
    "repeated tensor": ("a.pth", repeated, load_tensors, r"at most 0\.0625 GiB .* got 4\.1e\+03 GiB"),
    "picture": ("a.png", png, read_picture, "expected a picture, 6000x6000 pixels, of at most"),
    "mask": ("a.png", png, read_values, "expected a picture, 6000x6000 pixels, of at most"),
    "PLY": ("a.ply", sparse, read_splats, r"of at most 0\.0625 GiB .* got 1 GiB"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_small_file_does_not_fill_the_memory(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(1 / 16))
    file, make, read, sentence = CASES[name]
    path = tmp_path / file
    make(path)
    begin = time.process_time()
    with measured() as grown, pytest.raises(UserError, match=sentence):
        read(path)
    assert time.process_time() - begin < SOON
    assert grown() < LITTLE


def test_the_limit_can_be_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert largest() == GIB
    np.savez(tmp_path / "a.npz", a=np.zeros(1 << 17))  # 2^17 numbers of 8 bytes are 2^-10 GiB
    monkeypatch.setenv(VARIABLE, str(0.9 / 1024))
    with pytest.raises(UserError, match=rf"environment variable {VARIABLE} sets the limit\), got 0.000977 GiB"):
        read_arrays(tmp_path / "a.npz", "arrays")
    monkeypatch.setenv(VARIABLE, str(1.1 / 1024))
    assert read_arrays(tmp_path / "a.npz", "arrays")["a"].shape == (1 << 17,)
    monkeypatch.setenv(VARIABLE, "much")
    with pytest.raises(UserError, match=f"{VARIABLE}: expected a number of GiB above zero, got 'much'"):
        largest()


def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "rows": rng.normal(size=(3, 4)), "columns": np.asfortranarray(rng.normal(size=(3, 4)).astype(">f4")),
        "none": np.zeros((0, 3)), "one": np.array(5), "text": np.array("walk"), "words": np.array(["a", "bc"]),
        "yes": np.array([True, False]), "empty": np.array(""),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = read_arrays(tmp_path / "a.npz", "arrays")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert np.array_equal(found[name], array) and found[name].dtype == array.dtype, name


def test_a_picture_beyond_what_pillow_takes_has_the_same_sentence(tmp_path: Path) -> None:
    begin = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", len(begin)) + b"IHDR" + begin + struct.pack(">I", zlib.crc32(b"IHDR" + begin))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + b"\0\0\0\1IDATx")
    for read in (read_picture, read_values):
        with pytest.raises(UserError, match=rf"a picture of at most 67108864 pixels .*{VARIABLE} sets the limit"):
            read(tmp_path / "a.png")


def test_films_are_measured_before_they_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixty frames of 64x48 pixels: a frame takes 16 bytes a pixel while it is read, the film 4 bytes a pixel."""
    path, frame, film = tmp_path / "a.mp4", 16 * 64 * 48, 60 * 4 * 64 * 48
    imageio.mimwrite(path, [np.full((48, 64, 3), shade, np.uint8) for shade in range(60)], fps=30)
    monkeypatch.setenv(VARIABLE, str(0.9 * frame / GIB))
    with pytest.raises(UserError, match=r"expected frames of a video, 64x48 pixels, of at most"):
        video_facts(path)
    monkeypatch.setenv(VARIABLE, str(0.9 * film / FILM / GIB))
    with pytest.raises(UserError, match="expected a film whose frames are held together of at most"):
        open_footage(path).reels[0].picture(0)
    monkeypatch.setenv(VARIABLE, str(1.1 * film / FILM / GIB))
    assert open_footage(path).reels[0].picture(59).rgb.shape == (3, 48, 64)
