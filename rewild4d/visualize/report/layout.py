"""Pack moving Gaussians into a small file for the page's player, and unpack it: layout, version 1.

    deflate (zlib) of
      "R4SP"                4 bytes
      version               uint16, little endian as all numbers here
      length of the header  uint32
      header                JSON: {"clouds": [{"count": n, "moments": T, "frame": ..., "tracks": [...]}, ...]}
      tracks                in the header's order, one after the other

A cloud is a run of moments with as many Gaussians, the same one in the same row. A track is a property of it: {"name",
"components" k, "moments" (T, or 1 where nothing moves), "bits" b, "low" [k], "high" [k], "order" o, "along"}. Its
values are codes: an integer c from 0 to 2^b - 1 stands for low + c (high - low) / (2^b - 1), so that a value is off by
half a step at most. Codes stand as [moments, k, n], each as its residual modulo 2^b: o differences over the moments (0
before the first one), then, if "along" is true, one along the rows (0 before the first one). A residual is a signed
number r of b bits, written as 2r or, below zero, -2r - 1: first the low bytes of the whole track, then, for b > 8, its
high bytes.

The page holds the whole in base 85 (RFC 1924), "," in place of "<".

Rows lie along a space-filling curve: neighbours move alike, so that residuals are small and deflate well.

Tracks: means (box of the cloud), quats (wxyz), scales (natural logarithm), opacities, colors. "frame" says what colours
are: "rgb", or coefficients of spherical harmonics for directions in the "world" or in the Gaussian's "own" frame.
"""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

MAGIC = b"R4SP"
VERSION = 1
BITS = {"means": 16, "quats": 8, "scales": 8, "opacities": 8, "colors": 8}
"""Of a code, by the name of its track, in the order of the file."""
Frame = Literal["rgb", "world", "own"]
_WAYS = tuple((order, along) for order in (1, 2) for along in (False, True))
"""Of making residuals: "order" and "along" of a track; the one with the smallest residuals is taken."""
_HEAD = struct.Struct("<4sHI")


@dataclass(frozen=True)
class Cloud:
    """Gaussians over a run of moments, the same one in the same row.

    Attributes:
        tracks: name -> values, float64, [T or 1, n, k]: means, quats (unit, wxyz), scales (natural logarithm),
            opacities and colors, k = 3, 4, 3, 1 and 3 (degree + 1)^2, coefficient by coefficient.
        moments: T.
        frame: what the colours are: "rgb", or coefficients of harmonics in the "world" or the Gaussian's "own" frame.
    """

    tracks: Mapping[str, np.ndarray]
    moments: int
    frame: Frame

    def __len__(self) -> int:
        return self.tracks["means"].shape[1]


def steps(values: np.ndarray, bits: int) -> np.ndarray:
    """Return the step between codes of each component of a track [T, n, k], [k]: an error is half of it at most."""
    return (values.max((0, 1)) - values.min((0, 1))) / (2**bits - 1) if values.size else np.zeros(values.shape[2])


def pack(clouds: Sequence[Cloud]) -> bytes:
    """Write clouds in the layout above."""
    heads: list[dict[str, Any]] = []
    body: list[bytes] = []
    for cloud in clouds:
        tracks = []
        for name, bits in BITS.items():
            values = cloud.tracks[name]
            head, codes = _coded(values, bits)
            made = [(way, _residuals(codes, bits, *way)) for way in _WAYS]
            way, written = min(made, key=lambda one: _size(one[1]))
            tracks.append({"name": name, **head, "order": way[0], "along": way[1]})
            body += _bytes(written, bits)
        heads.append({"count": len(cloud), "moments": cloud.moments, "frame": cloud.frame, "tracks": tracks})
    header = json.dumps({"clouds": heads}, separators=(",", ":")).encode()
    deflate = zlib.compressobj(level=6, strategy=zlib.Z_FILTERED)  # level 9 takes several times as long for a hundredth
    return deflate.compress(b"".join((_HEAD.pack(MAGIC, VERSION, len(header)), header, *body))) + deflate.flush()


def unpack(data: bytes) -> list[Cloud]:
    """Read clouds back as the page does; values are off by half a step of their track at most.

    Raises:
        ValueError: other data, or another version.
    """
    raw = zlib.decompress(data)
    magic, version, length = _HEAD.unpack_from(raw)
    if (magic, version) != (MAGIC, VERSION):
        raise ValueError(f"expected {MAGIC!r} of version {VERSION}, got {magic!r} of version {version}")
    place = _HEAD.size + length
    clouds = []
    for head in json.loads(raw[_HEAD.size : place])["clouds"]:
        tracks = {}
        for track in head["tracks"]:
            shape = (track["moments"], track["components"], head["count"])
            size, bits = int(np.prod(shape)), track["bits"]
            read = np.frombuffer(raw, np.uint8, size, place).astype(np.int32)
            if bits > 8:
                read += np.frombuffer(raw, np.uint8, size, place + size).astype(np.int32) << 8
            place += size * (2 if bits > 8 else 1)
            codes = _codes(read.reshape(shape), bits, track["order"], track["along"])
            low, high = np.array(track["low"]), np.array(track["high"])
            tracks[track["name"]] = low + codes.transpose(0, 2, 1) * ((high - low) / (2**bits - 1))
        clouds.append(Cloud(tracks, head["moments"], head["frame"]))
    return clouds


def curve_order(points: np.ndarray) -> np.ndarray:
    """Return rows of points [n, 3] in the order of a Morton curve through their box, [n]."""
    low, high = points.min(0), points.max(0)
    cells = ((points - low) / np.maximum(high - low, 1e-30) * 1023).astype(np.int32)
    keys = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1).astype(np.int64) << (3 * bit + axis)
    return np.argsort(keys, kind="stable")


def _coded(values: np.ndarray, bits: int) -> tuple[dict[str, Any], np.ndarray]:
    """Return the head of a track and its codes, [moments, k, n]; one moment where no value moves by half a step."""
    step = steps(values, bits)
    if len(values) > 1 and np.all(np.abs(values - values[:1]) <= step / 2):
        values = values[:1]
    low = values.min((0, 1)) if values.size else np.zeros(values.shape[2])
    high = low + step * (2**bits - 1)
    codes = np.rint((values - low) / np.where(step > 0, step, 1)).astype(np.int32).transpose(0, 2, 1)
    head = {"components": values.shape[2], "moments": len(values), "bits": bits}
    return {**head, "low": low.tolist(), "high": high.tolist()}, np.minimum(codes, 2**bits - 1)


def _residuals(codes: np.ndarray, bits: int, order: int, along: bool) -> np.ndarray:
    """Return what is written for codes [moments, k, n]."""
    rest = codes
    for _ in range(order):
        rest = np.diff(rest, axis=0, prepend=np.int32(0))
    if along:
        rest = np.diff(rest, axis=2, prepend=np.int32(0))
    half = 1 << (bits - 1)
    rest = ((rest + half) & (2 * half - 1)) - half
    return np.where(rest < 0, -2 * rest - 1, 2 * rest)


def _codes(written: np.ndarray, bits: int, order: int, along: bool) -> np.ndarray:
    """Return codes from what `_residuals` made of them."""
    codes = np.where(written & 1, -(written + 1) // 2, written // 2)
    if along:
        codes = np.cumsum(codes, axis=2, dtype=np.int32)
    for _ in range(order):
        codes = np.cumsum(codes, axis=0, dtype=np.int32)
    return codes & (2**bits - 1)


def _size(residuals: np.ndarray) -> float:
    """Estimate the bits that residuals take."""
    return float(np.log2(residuals + np.float32(1)).sum())


def _bytes(residuals: np.ndarray, bits: int) -> list[bytes]:
    low = (residuals & 255).astype(np.uint8).tobytes()
    return [low, (residuals >> 8).astype(np.uint8).tobytes()] if bits > 8 else [low]
