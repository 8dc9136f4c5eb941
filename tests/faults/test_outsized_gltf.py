"""glTF files that would take minutes or the whole memory, or read elsewhere, are refused in less than two seconds."""

import json
import os
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig_files import Builder, build

from rewild4d.datasets.rigs import gltf_file
from rewild4d.datasets.rigs.gltf import MOST_LEVELS
from rewild4d.datasets.rigs.reader import clips, content, load_rig
from rewild4d.errors import UserError
from rewild4d.io.meshes import read_mesh

SOON = 2.0
linked = pytest.mark.skipif(os.name == "nt", reason="Windows has neither pipes in folders nor links for everybody")


def changed(folder: Path, change: Any) -> Path:
    """The made rig after a function changed its JSON."""
    data = build(folder / "whole.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    builder = Builder()
    builder.data = data[28 + length :]
    return builder.write(folder / "rig.glb", tree)


def chain(tree: dict[str, Any], count: int) -> None:
    """Hang a chain of bones below the tip, each a joint of the skin."""
    first = len(tree["nodes"])
    tree["nodes"] += [{"children": [first + k + 1]} for k in range(count - 1)] + [{}]
    tree["nodes"][2].setdefault("children", []).append(first)
    skin = tree["skins"][0]
    skin["joints"] += list(range(first, first + count))
    del skin["inverseBindMatrices"]


def zeros(tree: dict[str, Any], count: int) -> None:
    """Make the vertices, their joints and weights accessors without data."""
    for index, (code, kind) in enumerate(((5126, "VEC3"), (5121, "VEC4"), (5126, "VEC4"))):
        tree["accessors"][index] = {"componentType": code, "count": count, "type": kind}


def nested(levels: int) -> list[Any]:
    found: list[Any] = []
    for _ in range(levels):
        found = [found]
    return found


def many_primitives(tree: dict[str, Any]) -> None:
    for mesh in tree["meshes"]:
        mesh["primitives"] *= 60_000


def seconds(path: Path) -> float:
    begin = time.process_time()
    clips(path)
    load_rig(path, "Trot", 3)
    return time.process_time() - begin


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda t: t["nodes"].extend([{}] * 200_000), "expected a rig of at most 20000 nodes, got 20000"),
        (lambda t: chain(t, 30_001), "expected a rig of at most 20000 nodes, got 3000"),
        (lambda t: chain(t, MOST_LEVELS), f"expected a node hierarchy of at most {MOST_LEVELS} levels, got"),
        (lambda t: zeros(t, 90_000_000), "but it says 90000000"),
        (lambda t: zeros(t, 400_000), "but it says 400000"),
        (many_primitives, "expected a rig of at most 200000 parts"),
        (lambda t: t["animations"].extend([{"name": "Trot"}] * 250_000), "expected a rig of at most 200000 parts"),
        (lambda t: t.update(extras=[[0]] * 250_000), "expected a rig of at most 200000 parts"),
        (lambda t: t.update(extras=nested(400)), "expected JSON of a rig, got some that is nested 51 times"),
        (lambda t: t.update(animations=[0]), "expected a list of objects 'animations', got something else"),
        (lambda t: [t["accessors"][index].update(count=10**30) for index in range(3)], "what the file has room for"),
    ],
)  # fmt: skip
def test_outsized_files_are_refused_soon(tmp_path: Path, change: Any, sentence: str) -> None:
    path = changed(tmp_path, change)
    begin = time.process_time()
    with pytest.raises(UserError, match=sentence):
        clips(path)
        load_rig(path, "Trot", 3)
    assert time.process_time() - begin < SOON


def test_a_long_chain_of_bones_is_read_soon(tmp_path: Path) -> None:
    path = changed(tmp_path, lambda tree: chain(tree, MOST_LEVELS - 10))
    assert seconds(path) < SOON
    animal = load_rig(path, "Trot", 3)
    assert len(animal.bones_rest) == 2 + MOST_LEVELS - 10
    assert animal.parents.tolist() == [-1, *range(MOST_LEVELS - 9)]


def test_as_many_nodes_as_are_let_in_are_read_soon(tmp_path: Path) -> None:
    def more(tree: dict[str, Any]) -> None:
        tree["nodes"] += [{"translation": [0, 0, 1]} for _ in range(gltf_file.MOST_NODES - len(tree["nodes"]))]

    assert seconds(changed(tmp_path, more)) < SOON


@linked
@pytest.mark.parametrize(
    "uri",
    ["../secret.bin", "%2e%2e/secret.bin", "/dev/zero", "/etc/hostname", "link.bin", "file:///etc/hosts", "pipe"],
)
def test_buffers_lie_in_the_folder_of_their_file(tmp_path: Path, uri: str) -> None:
    folder = tmp_path / "rig"
    folder.mkdir()
    path = build(folder / "rig.glb")
    length = struct.unpack_from("<I", path.read_bytes(), 12)[0]
    (tmp_path / "secret.bin").write_bytes(path.read_bytes()[28 + length :])
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    os.mkfifo(folder / "pipe")
    tree = json.loads(path.read_bytes()[20 : 20 + length])
    tree["buffers"][0]["uri"] = uri
    (folder / "rig.gltf").write_text(json.dumps(tree))
    begin = time.process_time()
    for read in (content, lambda path: load_rig(path, "Trot")):
        with pytest.raises(UserError, match="expected names of files in its own folder|it is a device or a pipe"):
            read(folder / "rig.gltf")
    assert time.process_time() - begin < SOON


def test_a_buffer_below_its_file_is_read(tmp_path: Path) -> None:
    path = build(tmp_path / "rig.glb")
    length = struct.unpack_from("<I", path.read_bytes(), 12)[0]
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "a b.bin").write_bytes(path.read_bytes()[28 + length :])
    tree = json.loads(path.read_bytes()[20 : 20 + length])
    tree["buffers"][0]["uri"] = "parts/a%20b.bin"
    (tmp_path / "rig.gltf").write_text(json.dumps(tree))
    one, other = load_rig(path, "Trot", 3), load_rig(tmp_path / "rig.gltf", "Trot", 3)
    assert np.array_equal(one.bones, other.bones) and one.surfaces[0].faces.tolist() == other.surfaces[0].faces.tolist()


@linked
@pytest.mark.parametrize("name", ["../a.png", "/dev/zero", "pipe.png"])
def test_pictures_of_an_obj_lie_in_its_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    folder = tmp_path / "mesh"
    folder.mkdir()
    os.mkfifo(folder / "pipe.png")
    (folder / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    (folder / "a.mtl").write_text(f"map_Kd {name}\n")
    with pytest.raises(UserError, match="expected names of files in its own folder|it is a device or a pipe"):
        read_mesh(folder / "a.obj")
