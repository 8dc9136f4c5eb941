"""What is written to disk: whole, or one sentence and nothing."""

import errno
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pytest
import torch
from listening import Errors
from small_files import largest_file

from rewild4d.errors import DiskFull, UserError
from rewild4d.files import atomic, held, load_tensors, remove_leftovers, replaced_folder, save_tensors, write_text


def test_tensors_on_a_full_disk_are_one_sentence_and_leave_what_was_there(tmp_path: Path) -> None:
    save_tensors({"a": torch.ones(3)}, tmp_path / "state.pt")
    sentence = re.escape(f"{tmp_path / 'state.pt'}: could not be written: File too large.")
    with largest_file(20_000), pytest.raises(DiskFull, match=f"^{sentence}$"):
        save_tensors({"a": torch.zeros(100_000)}, tmp_path / "state.pt")
    assert torch.equal(torch.load(tmp_path / "state.pt", weights_only=True)["a"], torch.ones(3))
    assert [path.name for path in tmp_path.iterdir()] == ["state.pt"]


def test_a_held_folder_makes_others_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order, errors = [], Errors("waiting")
    monkeypatch.setattr(sys, "stderr", errors)

    def second() -> None:
        with held(tmp_path / "run", "waiting"):
            order.append("second")

    with held(tmp_path / "run", "waiting"):
        assert (tmp_path / "run").is_dir()
        other = Thread(target=second)
        other.start()
        assert errors.said.wait(60)
        order.append("first")
    other.join()
    assert order == ["first", "second"]
    (tmp_path / "file").touch()
    with (
        pytest.raises(UserError, match="file/run: expected a folder that can be written"),
        held(tmp_path / "file/run", ""),
    ):
        pass


def test_what_a_killed_process_had_begun_is_removed(tmp_path: Path) -> None:
    kept = [tmp_path / "film.mp4", tmp_path / ".hidden", tmp_path / ".a.folder__.mp4"]
    kept[0].write_text("a")
    kept[1].write_text("b")
    kept[2].mkdir()
    block = atomic(tmp_path / "film.mp4")
    begun = block.__enter__()  # and no end
    assert begun.is_file() and begun.parent == tmp_path
    remove_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(kept)


def test_a_file_that_cannot_be_read_is_not_called_damaged(tmp_path: Path) -> None:
    (tmp_path / "state.pt").mkdir()
    with pytest.raises(UserError, match=r"state\.pt: expected a checkpoint, but: Is a directory\."):
        load_tensors(tmp_path / "state.pt", "checkpoint")


def kill_within(block: str) -> None:
    """Run the beginning of a `with` block in another process, which is killed inside of it."""
    code = f"import os, signal\nfrom pathlib import Path\nfrom rewild4d.files import *\n{block}"
    done = subprocess.run([sys.executable, "-c", f"{code}; os.kill(os.getpid(), signal.SIGKILL)"])
    assert done.returncode == -signal.SIGKILL


def test_what_killed_writers_leave_does_not_add_up(tmp_path: Path) -> None:
    path = tmp_path / "prior.npz"
    for _ in range(2):
        kill_within(f"with atomic(Path({str(path)!r})) as part: part.write_text('half of it')")
        assert [left.name for left in tmp_path.iterdir()] == [".prior.part.npz"]
    write_text(path, "all")
    assert [(left.name, left.read_text()) for left in tmp_path.iterdir()] == [("prior.npz", "all")]


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with atomic(path) as first:
        first.write_text("first")
        with atomic(path) as second:
            assert second != first
            second.write_text("second")
        assert path.read_text() == "second"
        with atomic(path) as third:
            third.write_text("third")
    assert [(left.name, left.read_text()) for left in tmp_path.iterdir()] == [("a.txt", "first")]


def test_a_link_in_the_place_of_a_file_that_is_begun_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("kept")
    (tmp_path / ".a.part.txt").symlink_to(tmp_path / "other")
    with pytest.raises(UserError, match="a.txt: expected a folder that can be written, but: Too many levels"):
        write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "other").read_text() == "kept"


def files(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


BUILD = """
import os, signal, sys
from pathlib import Path
from rewild4d.files import replaced_folder

page, deadly = Path(sys.argv[1]), sys.argv[2]
rename = Path.rename


def move(path, target):
    rename(path, target)
    if path.name == deadly:
        os.kill(os.getpid(), signal.SIGKILL)


Path.rename = move
with replaced_folder(page, "marker", "") as building:
    (building / "marker").touch()
    (building / "text").write_text("new")
    if not deadly:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(
    ("deadly", "found"), [("", "old"), ("page", ""), (".page.part", "new")], ids=["building", "between", "after"]
)
def test_a_folder_is_replaced_whole_whenever_the_process_is_killed(tmp_path: Path, deadly: str, found: str) -> None:
    page = tmp_path / "page"

    def build(text: str) -> None:
        with replaced_folder(page, "marker", "") as building:
            (building / "marker").touch()
            (building / "text").write_text(text)

    build("old")
    done = subprocess.run([sys.executable, "-c", BUILD, str(page), deadly])
    assert done.returncode == -signal.SIGKILL
    assert files(page) == ({"marker": "", "text": found} if found else {})
    build("newer")
    assert files(tmp_path) == {"page/marker": "", "page/text": "newer"}, "nothing is left of the killed one"


def test_a_folder_that_cannot_be_moved_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page"
    with replaced_folder(page, "marker", "") as building:
        (building / "marker").touch()
    rename = Path.rename

    def broken(path: Path, target: Path) -> Path:
        if path.name == ".page.part":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", broken)
    said = "page: could not be written: No space left on device"
    with pytest.raises(DiskFull, match=said), replaced_folder(page, "marker", ""):
        pass
    assert files(tmp_path) == {"page/marker": ""}
