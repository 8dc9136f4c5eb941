"""Readers of annotations, masks, videos and TOML, each with a tiny valid file, that damaged files are tried on."""

import contextlib
import json
from pathlib import Path

import benchmark_films
import moving
import numpy as np
from mutations import Reader

from rewild4d.datasets.aim.files import read_crop
from rewild4d.datasets.aim.files import read_keypoints as read_aim_keypoints
from rewild4d.datasets.cop3d.annotations import FrameAnnotation, read_jgz
from rewild4d.datasets.cop3d.cameras import to_opencv
from rewild4d.datasets.keypoints.files import read_keypoints
from rewild4d.datasets.keypoints.keypoints import read_badja
from rewild4d.datasets.masking.masks import open_masks
from rewild4d.datasets.video.apt_files import read_annotations
from rewild4d.datasets.video.video_file import read_video, video_facts
from rewild4d.evaluation.protocol import Protocol
from rewild4d.foreign.texts import read_toml
from rewild4d.leaderboard.specs import Spec
from rewild4d.priors.landmarks import load_mapping

STEMS, SIZE = ("0", "1", "2"), (96, 64)
ROOM = Path(__file__).parents[2] / "leaderboard"


def _written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def badja(folder: Path) -> Path:
    entry = {"joints": [[540, 960]] * 37, "visibility": [True] * 37}
    return _written(folder / "k.json", json.dumps([{"image_path": f"DAVIS/{i}.jpg"} | entry for i in range(3)]))


def coco(folder: Path) -> Path:
    entry = {"category_id": 1, "bbox": [1, 1, 20, 20], "keypoints": [20, 30, 2, 25, 30, 1]}
    content = {
        "images": [{"id": i, "file_name": f"a/{i}.png"} for i in range(3)],
        "categories": [{"id": 1, "name": "cat", "keypoints": ["nose", "tail"]}],
        "annotations": [{"id": 9 + i, "image_id": i, "track_id": 1 + i % 2} | entry for i in range(3)],
    }
    return _written(folder / "k.json", json.dumps(content))


def deeplabcut(folder: Path) -> Path:
    head = ("scorer" + 6 * ",net", "individuals" + 3 * ",a1" + 3 * ",a2", "bodyparts" + 6 * ",nose")
    rows = [f"{i},20,30,0.9,50,20,0.8" for i in range(3)]
    return _written(folder / "k.csv", "\n".join([*head, "coords" + 2 * ",x,y,likelihood", *rows]))


def sleap(folder: Path) -> Path:
    rows = [f"{track},{i},0.9,20,30,0.9,25,30,0.8" for i in range(3) for track in ("a", "b")]
    head = "track,frame_idx,instance.score,nose.x,nose.y,nose.score,tail.x,tail.y,tail.score"
    return _written(folder / "k.csv", "\n".join([head, *rows]))


def annotations(folder: Path) -> Path:
    return moving.apt(folder, count=4, with_masks=False) / "annotations" / "train_annotations.json"


def mapping(folder: Path) -> Path:
    return _written(folder / "m.toml", '[points]\nnose = "nose"\ntail = "tail_root"\n"left paw" = "front_left_foot"\n')


def protocol(folder: Path) -> Path:
    return _written(folder / "p.toml", (ROOM / "protocols" / "artemis-sweep-256-v4.toml").read_text())


def table(folder: Path) -> Path:
    return _written(folder / "t.toml", (ROOM / "tables" / "artemis.toml").read_text())


def grey_mask(folder: Path) -> Path:
    return moving.save(folder / "0.png", (moving.mask(0) // 255 * 38))


def deep_mask(folder: Path) -> Path:
    return moving.save(folder / "0.png", moving.mask(0).astype(np.uint16) * 94)


def palette_mask(folder: Path) -> Path:
    return moving.save(folder / "0.png", moving.mask(0) // 255, "P")


def jpeg_mask(folder: Path) -> Path:
    return moving.save(folder / "0.jpg", moving.mask(0))


def film(folder: Path) -> Path:
    moving.frames(folder / "f", count=3)
    return moving.film(folder / "v.mp4", folder / "f", "-vf", "setsar=2/1", "-pix_fmt", "yuv420p")


def _keypoints(path: Path) -> object:
    mask = moving.mask(0)
    return read_keypoints(path, STEMS, SIZE), read_keypoints(path, STEMS, SIZE, lambda: ((i, mask) for i in range(3)))


def _mask(path: Path) -> object:
    return open_masks([path]).read(0, None, moving.SIZE)


def _video(path: Path) -> object:
    return video_facts(path), list(read_video(path))


def aim_keypoints(folder: Path) -> Path:
    return benchmark_films.aim(folder, count=1) / "00000003_keypoint.txt"


def aim_metadata(folder: Path) -> Path:
    return benchmark_films.aim(folder, count=1) / "00000003_metadata.json"


def cop3d_frames(folder: Path) -> Path:
    return benchmark_films.cop3d(folder, count=2) / "dog" / "frame_annotations.jgz"


def _cameras(path: Path) -> object:
    found = []
    for frame in read_jgz(path, list[FrameAnnotation]):
        with contextlib.suppress(ValueError):  # the reader makes a sentence of it
            found.append(frame.viewpoint and to_opencv(frame.viewpoint, SIZE))
    return found


READERS = {
    "keypoints of BADJA": Reader(badja, _keypoints),
    "BADJA beside DAVIS": Reader(badja, lambda path: read_badja(path, STEMS, SIZE)),
    "keypoints of COCO": Reader(coco, _keypoints),
    "keypoints of DeepLabCut": Reader(deeplabcut, _keypoints),
    "keypoints of SLEAP": Reader(sleap, _keypoints),
    "annotations of APT": Reader(annotations, lambda path: read_annotations(path.parent.parent)),
    "mapping": Reader(mapping, lambda path: load_mapping(str(path))),
    "protocol": Reader(protocol, lambda path: read_toml(path, "a protocol", Protocol)),
    "table": Reader(table, lambda path: read_toml(path, "a table", Spec)),
    "keypoints of AiM": Reader(aim_keypoints, lambda path: read_aim_keypoints(path, SIZE)),
    "metadata of AiM": Reader(aim_metadata, read_crop),
    "annotations of CoP3D": Reader(cop3d_frames, _cameras),
    "grey mask": Reader(grey_mask, _mask),
    "mask of 16 bits": Reader(deep_mask, _mask),
    "mask with a palette": Reader(palette_mask, _mask),
    "mask as JPEG": Reader(jpeg_mask, _mask),
}
"""Name -> reader; see `fault_readers`."""
SLOW_READERS = {"video": Reader(film, _video)}
"""Those that start a program for every file: a tenth as many damages."""
