"""A program of somebody else: reads the written clip, writes an animal in one of many layouts, or fails in many ways.

Run by tests/test_external*.py as a separate process; it imports nothing of ours, as somebody else's would not.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np

ORDER = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
         "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
REST = {0: 0, 1: 9, 2: 24, 3: 45}


def gaussians(body: dict, degree: int) -> tuple[list[str], np.ndarray]:
    """Names and values of the reference layout."""
    means, colors = np.array(body["points"]), np.array(body["colors"])
    count = len(means)
    columns = {"x": means[:, 0], "y": means[:, 1], "z": means[:, 2], "opacity": np.full(count, 6.0)}
    columns |= {name: np.zeros(count) for name in ("nx", "ny", "nz", "rot_1", "rot_2", "rot_3")}
    columns |= {f"f_dc_{i}": (colors[:, i] - 0.5) / 0.28209479177387814 for i in range(3)}
    columns |= {f"scale_{i}": np.full(count, np.log(body["radius"])) for i in range(3)} | {"rot_0": np.ones(count)}
    names = ORDER[:9] + [f"f_rest_{i}" for i in range(REST[degree])] + ORDER[9:]
    columns |= {f"f_rest_{i}": np.zeros(count) for i in range(REST[degree])}
    return names, np.stack([columns[name] for name in names], axis=1).astype(np.float32)


def write_ply(path: Path, names: list[str], values: np.ndarray, ascii_body: bool) -> None:
    kind = "ascii" if ascii_body else "binary_little_endian"
    lines = ["ply", f"format {kind} 1.0", f"element vertex {len(values)}", *(f"property float {n}" for n in names)]
    head = "\n".join([*lines, "end_header", ""]).encode()
    body = "\n".join(" ".join(map(str, row)) for row in values.tolist()).encode() if ascii_body else values.tobytes()
    path.write_bytes(head + body)


def write_obj(path: Path, vertices: list, faces: list, colors: list | None) -> None:
    lines = ["mtllib gone.mtl"]
    for index, point in enumerate(vertices):
        more = colors[index] if colors else []
        lines.append("v " + " ".join(f"{value:.6f}" for value in [*point, *more]))
    lines += ["f " + " ".join(f"{corner + 1}//{corner + 1}" for corner in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")


def write_textured(path: Path, vertices: list, faces: list, one: bytes, other: bytes) -> None:
    """An OBJ with a texture of two colours: one on one side of the vertices' mean z, the other on the other."""
    pixels = b"".join(b"\0" + one * 8 + other * 8 for _ in range(4))
    path.with_suffix(".png").write_bytes(png(16, 4, pixels))
    path.with_suffix(".mtl").write_text(f"newmtl m\nmap_Kd {path.with_suffix('.png').name}\n")
    lines = [f"mtllib {path.with_suffix('.mtl').name}", "vt 0.1 0.5", "vt 0.9 0.5"]
    lines += ["v " + " ".join(f"{value:.6f}" for value in point) for point in vertices]
    middle = sum(point[2] for point in vertices) / len(vertices)
    side = [1 if point[2] < middle else 2 for point in vertices]
    lines += ["f " + " ".join(f"{corner + 1}/{side[corner]}" for corner in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")


def png(width: int, height: int, rows: bytes) -> bytes:
    import zlib

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def main() -> None:
    clip, out, what, seed = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4]
    about = json.loads((clip / "clip.json").read_text())
    for frame in about["frames"]:
        for name in ("frame", "mask", "rgba"):
            assert (clip / frame[name]).is_file(), frame[name]
    assert (clip / "prior.npz").is_file() and (clip / "README.txt").is_file() and seed == "7"
    bodies = json.loads(Path(sys.argv[5]).read_text())
    print("reading", about["name"])
    if what == "crash":
        print("CUDA out of memory")
        sys.exit(3)
    if what == "nothing":
        return
    if what == "hang":
        import time

        time.sleep(60)
    if what == "half":
        bodies = bodies[::2]
    for index, body in enumerate(bodies):
        number = 2 * index if what == "half" else index
        write(out, what, number, body)


def write(out: Path, what: str, index: int, body: dict) -> None:
    path = out / f"frame_{index:04d}.ply"
    degree = int(what[2]) if what.startswith("sh") else 0
    names, values = gaussians(body, degree)
    if what == "nan" and index == 1:
        values[5, 1] = np.nan
    if what == "huge":
        values[:, names.index("scale_0") : names.index("scale_2") + 1] = 88
    if what == "empty":
        values = values[:0]
    if what == "order":
        turn = list(reversed(range(len(names))))
        names, values = [names[i] for i in turn], np.ascontiguousarray(values[:, turn])
    if what == "cut":
        write_ply(path, names, values, False)
        path.write_bytes(path.read_bytes()[:-100])
    elif what in ("mesh", "colored"):
        write_obj(
            path.with_suffix(".obj"), body["vertices"], body["faces"], body["shade"] if what == "colored" else None
        )
    elif what == "textured":
        write_textured(path.with_suffix(".obj"), body["vertices"], body["faces"], b"\xff\0\0", b"\0\xff\0")
    elif what == "dreammesh4d":
        folder = out / "extracted_textured_meshes"
        folder.mkdir(exist_ok=True)
        write_textured(
            folder / f"extracted_mesh_{index}.obj", body["vertices"], body["faces"], b"\x80" * 3, b"\x80" * 3
        )
    elif what == "gvfdiffusion":
        (out / "gaussians").mkdir(exist_ok=True)
        write_ply(out / "gaussians" / f"timestep_{index:02d}.ply", names, values, False)
    elif what == "fauna":
        stem = f"0000123_{index:>10}"
        write_obj(out / f"{stem}_mesh.obj", body["vertices"], body["faces"], None)
        (out / f"{stem}_pose.txt").write_text("\n".join(f"{value:.6f}" for value in body["pose"]) + "\n")
        (out / f"{stem}_arti_params.txt").write_text("0 0 0\n" * 20)
    else:
        write_ply(path, names, values, what == "ascii")


if __name__ == "__main__":
    main()
