"""Damaged files end in a value or in one sentence, soon and in little memory.

`REWILD4D_MUTATIONS` says how many a reader gets: 200 where it says nothing, 2,000 with `make faults`.
"""

import os
from pathlib import Path

import pytest
from fault_readers import READERS
from mutations import LONGEST_SECONDS, drive

MUTATIONS = int(os.environ.get("REWILD4D_MUTATIONS", "200"))


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path, one_thread: None) -> None:
    found = drive(name, READERS[name], tmp_path, MUTATIONS)
    figures = f"{found.values} read, {found.refused} refused, slowest {found.slowest:.2f} s, {found.memory >> 20} MiB"
    print(f"{name}: {figures}, {len(found.faults)} faults")
    assert not found.faults, "\n".join([f"{name}: {figures}", *found.faults[:20]])
    assert found.slowest < LONGEST_SECONDS
    assert found.values + found.refused == MUTATIONS
