"""A hand-made glTF whose every pose can be worked out on paper."""

import json
import struct
from pathlib import Path

import numpy as np

HALF_TURN_Z = [0.0, 0.0, 1.0, 0.0]  # xyzw


class Builder:
    """Collects accessors for a .glb."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def view(self, array: np.ndarray) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes()
        return len(self.views) - 1

    def add(self, values: object, dtype: type = np.float32, **extra: object) -> int:
        array = np.asarray(values, dtype)
        kind = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}[array.shape[1:]]
        code = {np.uint8: 5121, np.uint16: 5123, np.float32: 5126}[dtype]
        entry = {"componentType": code, "count": len(array), "type": kind, **extra}
        self.accessors.append({"bufferView": self.view(array), **entry})
        return len(self.accessors) - 1

    def write(self, path: Path, tree: dict) -> Path:
        tree = {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": len(self.data)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
            **tree,
        }
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        blob = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def build(path: Path, *, attach_to: int = 2, skinned: bool = True, move_tag: bool = False) -> Path:
    """A quad skinned to joints `root` (at y = 1) and `tip` (at y = 3), in an armature that is twice as large.

    The clip lasts 2 s: the root's scale grows linearly from 1 to 3, the tip makes half a turn about z by steps at 1 s.
    A small triangle `tag` hangs from the tip through an intermediate node.
    """
    b = Builder()
    positions = b.add([[0, 0, 0], [1, 0, 0], [0, 3, 0], [1, 3, 0]])
    joints = b.add([[0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]], np.uint8)
    weights = b.add([[255, 0, 0, 0], [255, 0, 0, 0], [255, 0, 0, 0], [51, 204, 0, 0]], np.uint8, normalized=True)
    colors = b.add([[255, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8, normalized=True)
    faces = b.add([0, 1, 2, 1, 3, 2], np.uint16)
    tag = b.add([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    inverse = np.stack([np.eye(4), np.eye(4)])
    inverse[0, :3, 3], inverse[1, :3, 3] = (0, -1, 0), (0, -3, 0)
    bind = b.add(inverse.transpose(0, 2, 1))
    times = b.add([0.0, 2.0])
    steps = b.add([0.0, 1.0, 2.0])
    grow = b.add([[1, 1, 1], [3, 3, 3]])
    turn = b.add([[0, 0, 0, 1], HALF_TURN_Z, HALF_TURN_Z])
    slide = b.add([[0, 0, 0], [4, 0, 0]])
    attributes = {"POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights, "COLOR_0": colors}
    samplers = [
        {"input": times, "output": grow},
        {"input": steps, "output": turn, "interpolation": "STEP"},
        {"input": times, "output": slide},
    ]
    channels = [
        {"sampler": 0, "target": {"node": 1, "path": "scale"}},
        {"sampler": 1, "target": {"node": 2, "path": "rotation"}},
    ]
    if move_tag:
        channels.append({"sampler": 2, "target": {"node": 3, "path": "translation"}})
    nodes: list[dict] = [
        {"name": "armature", "scale": [2, 2, 2], "children": [1, 5]},
        {"name": "root", "translation": [0, 1, 0], "children": [2]},
        {"name": "tip", "translation": [0, 2, 0]},
        {"name": "between", "translation": [0, 0, 0] if move_tag else [0, 0, 5], "children": [4]},
        {"name": "tag", "mesh": 1, "rotation": HALF_TURN_Z},
        {"name": "quad", "mesh": 0, "translation": [100, 0, 0], **({"skin": 0} if skinned else {})},
    ]
    nodes[attach_to].setdefault("children", []).append(3)
    tree = {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [
            {"primitives": [{"attributes": attributes, "indices": faces, "material": 0}]},
            {"primitives": [{"attributes": {"POSITION": tag}}]},
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 1.0, 1.0, 1.0]}}],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": bind}],
        "animations": [{"name": "Trot", "samplers": samplers, "channels": channels}],
    }
    return b.write(path, tree)
