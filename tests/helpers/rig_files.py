"""A hand-made glTF whose every pose can be worked out on paper."""

import json
import struct
from pathlib import Path
from typing import Any

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


def quats_about_x(angles: np.ndarray) -> np.ndarray:
    """Return xyzw quaternions of rotations about x, [n] -> [n, 4]."""
    zero = np.zeros_like(angles)
    return np.stack((np.sin(angles / 2), zero, zero, np.cos(angles / 2)), axis=1)


def save_template(
    path: Path, template: Any, swings: dict[int, np.ndarray], *, hung: dict[int, int] | None = None,
    shifts: dict[int, np.ndarray] | None = None, yaw: float = 0.0,
) -> Path:  # fmt: skip
    """Write a template of the package as a rig with one clip of a second.

    Args:
        path: the .glb to write.
        template: a `Template`.
        swings: angles about x of some bones over the clip, each [n].
        hung: other parents of some bones in the file, -1 for the root.
        shifts: translations of some bones over the clip against their parents in the file, each [n, 3].
        yaw: the whole animal is turned by in the file, radians.
    """
    b, count = Builder(), len(template.parents)
    parents = [(hung or {}).get(bone, parent) for bone, parent in enumerate(template.parents)]
    pivots = template.bones[:, 0].numpy().astype(float)
    weights = template.weights.numpy()
    order = np.argsort(-weights, axis=1)[:, :4]
    largest = np.take_along_axis(weights, order, 1)
    inverse = np.tile(np.eye(4), (count, 1, 1))
    inverse[:, :3, 3] = -pivots
    attributes = {
        "POSITION": b.add(template.vertices.numpy()),
        "JOINTS_0": b.add(order, np.uint8),
        "WEIGHTS_0": b.add(largest / largest.sum(1, keepdims=True)),
    }
    faces, bind = b.add(template.faces.numpy().flatten(), np.uint16), b.add(inverse.transpose(0, 2, 1))
    nodes: list[dict] = [
        {"name": f"bone_{bone}", "translation": list(pivots[bone] - (pivots[parent] if parent >= 0 else 0))}
        for bone, parent in enumerate(parents)
    ]
    nodes.append({"name": "armature", "rotation": [0.0, float(np.sin(yaw / 2)), 0.0, float(np.cos(yaw / 2))]})
    nodes.append({"name": "skin", "mesh": 0, "skin": 0})
    for bone, parent in enumerate(parents):
        nodes[parent if parent >= 0 else count].setdefault("children", []).append(bone)
    nodes[count]["children"].append(count + 1)
    samplers, channels = [], []
    tracks = [(bone, "rotation", quats_about_x(angles)) for bone, angles in swings.items()]
    for bone, kind, values in [*tracks, *((bone, "translation", moved) for bone, moved in (shifts or {}).items())]:
        samplers.append({"input": b.add(np.linspace(0, 1, len(values))), "output": b.add(values)})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": bone, "path": kind}})
    tree = {
        "scene": 0,
        "scenes": [{"nodes": [count]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": faces}]}],
        "skins": [{"joints": list(range(count)), "inverseBindMatrices": bind}],
        "animations": [{"name": "Swing", "samplers": samplers, "channels": channels}] if channels else [],
    }
    return b.write(path, tree)
