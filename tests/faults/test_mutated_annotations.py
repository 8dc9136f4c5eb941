"""Damaged annotations, masks, videos and TOML end in a value or in one sentence, soon and in little memory."""

import os
from pathlib import Path

import pytest
from annotation_readers import READERS, SLOW_READERS
from mutations import LONGEST_SECONDS, drive

from rewild4d.errors import UserError

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


def test_files_that_once_were_tracebacks_are_sentences(shared: Path, tmp_path: Path) -> None:
    """The first letters of a file's name say its reader."""
    folder = shared / "data" / "faults"
    if not folder.is_dir():
        pytest.skip(f"the files are not here ({folder}); set REWILD4D_SHARED to the folder that holds data/faults")
    names = {"kp-badja": "keypoints of BADJA", "k.json": "keypoints of BADJA", "kp-coco": "keypoints of COCO",
             "kp-dlc": "keypoints of DeepLabCut", "kp-sleap": "keypoints of SLEAP", "apt": "annotations of APT",
             "toml-mapping": "mapping", "deep.toml": "mapping", "toml-protocol": "protocol",
             "toml-table": "table"}  # fmt: skip
    read = []
    for start, name in names.items():
        place = READERS[name].make(tmp_path / start)
        for file in sorted(folder.glob(f"{start}*")):
            place.write_bytes(file.read_bytes())
            try:
                READERS[name].read(place)
                read.append(file.name)
            except UserError as error:
                assert len(str(error)) <= 400 and str(error).count("\n") == 0
    assert read == ["kp-dlc-3.csv"], "it is whole, in UTF-16"
