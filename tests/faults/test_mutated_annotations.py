"""Damaged annotations, masks, videos and TOML end in a value or in one sentence, soon and in little memory."""

import os
from pathlib import Path

import pytest
from annotation_readers import READERS, SLOW_READERS
from mutations import LONGEST_SECONDS, drive

MUTATIONS = int(os.environ.get("REWILD4D_MUTATIONS", "200"))


@pytest.mark.parametrize("name", [*READERS, *SLOW_READERS])
def test_damaged_annotations_are_read_or_refused(name: str, tmp_path: Path, one_thread: None) -> None:
    reader, count = (READERS | SLOW_READERS)[name], MUTATIONS if name in READERS else MUTATIONS // 10
    found = drive(name, reader, tmp_path, count)
    figures = f"{found.values} read, {found.refused} refused, slowest {found.slowest:.2f} s, {found.memory >> 20} MiB"
    print(f"{name}: {figures}, {len(found.faults)} faults")
    assert not found.faults, "\n".join([f"{name}: {figures}", *found.faults[:20]])
    assert found.slowest < LONGEST_SECONDS
    assert found.values + found.refused == count
