"""What is written to disk: whole, or one sentence and nothing."""

import re
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.files import atomic, held, load_tensors, remove_leftovers, save_tensors


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond some bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_tensors_on_a_full_disk_are_one_sentence_and_leave_what_was_there(tmp_path: Path) -> None:
    save_tensors({"a": torch.ones(3)}, tmp_path / "state.pt")
    sentence = re.escape(f"{tmp_path / 'state.pt'}: could not be written: File too large.")
    with largest_file(20_000), pytest.raises(UserError, match=f"^{sentence}$"):
        save_tensors({"a": torch.zeros(100_000)}, tmp_path / "state.pt")
    assert torch.equal(torch.load(tmp_path / "state.pt", weights_only=True)["a"], torch.ones(3))
    assert [path.name for path in tmp_path.iterdir()] == ["state.pt"]


def test_a_held_folder_makes_others_wait(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    order = []

    def second() -> None:
        with held(tmp_path / "run", "waiting"):
            order.append("second")

    with held(tmp_path / "run", "waiting"):
        assert (tmp_path / "run").is_dir()
        other = Thread(target=second)
        other.start()
        while not capsys.readouterr().err:
            time.sleep(0.01)
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
