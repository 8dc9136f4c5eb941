"""Zip files that others made: unpacked only where every name, size and byte is as it should be."""

import stat
import time
import warnings
import zipfile
from pathlib import Path

import pytest

from rewild4d.errors import UserError
from rewild4d.leaderboard.bundle import MOST_FILES, safe_name, unpack, write_bundle


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "files" / "a").mkdir(parents=True)
    (tmp_path / "files" / "a" / "one.txt").write_text("one")
    (tmp_path / "files" / "two.txt").write_text("two" * 1000)
    return tmp_path / "files"


@pytest.fixture
def empty(tmp_path: Path) -> Path:
    (tmp_path / "empty").mkdir()
    return tmp_path / "empty"


def archive(path: Path, *entries: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as made, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, content in entries:
            made.writestr(name, content)
    return path


def test_what_is_packed_is_unpacked(folder: Path, empty: Path) -> None:
    write_bundle(folder, folder.parent / "a.zip")
    digests, faults = unpack(folder.parent / "a.zip", empty)
    assert faults == [] and [*digests] == ["a/one.txt", "two.txt"]
    assert digests["a/one.txt"] == "7692c3ad3540bb803c020b3aee66cd8887123234ea0c6e7143c0add73ff431ed"  # sha256sum
    for name in digests:
        assert (empty / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize(
    "name",
    ["../a", "/etc/passwd", "a/../../b", "C:\\a", "a\\b", "a//b", "a/", ".hidden", "a/.b", "", "a\0b", "a b", "x" * 241,
     "a/" * 8 + "b"],
)  # fmt: skip
def test_names_that_leave_the_folder_or_hide_are_refused(name: str, tmp_path: Path, empty: Path) -> None:
    assert not safe_name(name)
    if name and "\0" not in name:
        _, faults = unpack(archive(tmp_path / "a.zip", ("good.txt", b"good"), (name, b"bad")), empty)
        assert faults and "expected names of files below its own folder, got '" in faults[0]
        assert not list(empty.iterdir()) and {path.name for path in tmp_path.iterdir()} == {"a.zip", "empty"}


def info(name: str, mode: int) -> zipfile.ZipInfo:
    made = zipfile.ZipInfo(name)
    made.create_system, made.external_attr = 3, mode << 16
    return made


def test_links_devices_and_double_names_are_refused(tmp_path: Path, empty: Path) -> None:
    link, pipe = info("link", stat.S_IFLNK | 0o777), info("pipe", stat.S_IFIFO | 0o666)
    _, faults = unpack(
        archive(tmp_path / "a.zip", (link, b"/etc/passwd"), (pipe, b""), ("b", b"1"), ("B", b"2")), empty
    )
    assert faults == [
        "expected regular files, but 'link' is a symbolic link.",
        "expected regular files, but 'pipe' is something else.",
        "expected every name once, got 'b' 2 times.",
    ]
    _, faults = unpack(archive(tmp_path / "b.zip", ("a", b"1"), ("a/b", b"2")), empty)
    assert faults == ["expected 'a' to be a file or a folder, got both."]
    assert not list(empty.iterdir())


def test_a_bomb_is_told_before_it_is_unpacked(tmp_path: Path, empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as made:
        for index in range(3):
            made.writestr(f"{index}.txt", bytes(1 << 20))
    monkeypatch.setenv("REWILD4D_LARGEST_GIB", str(2 / 1024))
    _, (fault,) = unpack(tmp_path / "a.zip", empty)
    assert fault.startswith("expected at most 0.00195 GiB once unpacked") and fault.endswith("got 0.00293 GiB.")
    assert not list(empty.iterdir())


def test_a_size_that_lies_ends_at_what_was_said(tmp_path: Path, empty: Path) -> None:
    """The list says ten bytes, what is packed are a million."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("a.txt", bytes(1_000_000))
    data = (tmp_path / "a.zip").read_bytes()
    size = (1_000_000).to_bytes(4, "little")
    assert data.count(size) == 2
    (tmp_path / "a.zip").write_bytes(data.replace(size, (10).to_bytes(4, "little")))
    _, (fault,) = unpack(tmp_path / "a.zip", empty)
    assert fault.startswith("'a.txt' cannot be unpacked: Bad CRC-32") and not list(empty.iterdir())


def test_too_many_files_are_told_from_the_end(tmp_path: Path, empty: Path) -> None:
    archive(tmp_path / "a.zip", *((f"{index:x}", b"") for index in range(MOST_FILES + 1)))
    begin = time.monotonic()
    with pytest.raises(UserError, match=f"of at most {MOST_FILES} files, got {MOST_FILES + 1}"):
        unpack(tmp_path / "a.zip", empty)
    assert time.monotonic() - begin < 1


def test_every_cut_is_one_sentence(folder: Path, empty: Path, tmp_path: Path) -> None:
    write_bundle(folder, tmp_path / "a.zip")
    data = (tmp_path / "a.zip").read_bytes()
    for length in range(len(data)):
        (tmp_path / "cut.zip").write_bytes(data[:length])
        with pytest.raises(UserError, match="cut.zip: expected a bundle as `leaderboard submit` writes it, but it is"):
            unpack(tmp_path / "cut.zip", empty)


def test_bytes_of_no_file_are_found(folder: Path, empty: Path, tmp_path: Path) -> None:
    write_bundle(folder, tmp_path / "a.zip")
    data = (tmp_path / "a.zip").read_bytes()
    for hidden in (data + b"more", b"more" + data):
        (tmp_path / "b.zip").write_bytes(hidden)
        with pytest.raises(UserError, match="goes on behind its end|not where it should be"):
            unpack(tmp_path / "b.zip", empty)
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as made:
        extra = zipfile.ZipInfo("a.txt")
        extra.extra = b"\xfe\xca\4\0more"
        made.writestr(extra, b"a")
    assert unpack(tmp_path / "c.zip", empty)[1] == [
        "expected a bundle as `leaderboard submit` writes it, but it has bytes that belong to no file, or to two."
    ]
