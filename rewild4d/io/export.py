"""A reconstruction in files that other programs open: Gaussians, an animated skinned mesh, cameras, films.

ply/00000.ply ...   the Gaussians of each frame in the INRIA layout, in the world
animated.glb        the canonical Gaussians as coloured squares, their skeleton and its motion, in the world
cameras.json        time and camera of each frame, one row a .ply, and which square of the original frame it shows
input_view.mp4, orbit.mp4
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rewild4d.cameras.input_view import input_camera
from rewild4d.contracts import Articulated, Reconstruction
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import write_text
from rewild4d.io import KINDS
from rewild4d.io.ply import write_splats
from rewild4d.io.skinned_glb import SEEN, shown, write_glb
from rewild4d.types import Camera, Clip, Frame
from rewild4d.visualize.pictures import film_rate, over, save_mp4
from rewild4d.visualize.turntable import find_framing, orbit_frames


def parse_kinds(text: str) -> tuple[str, ...]:
    """Return the kinds of files that "ply,glb" names.

    Raises:
        UserError: an unknown kind, or none.
    """
    wanted = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    for word in wanted:
        if word not in KINDS:
            raise unknown_name("kind of export", word, KINDS)
    if not wanted:
        raise UserError(f"--what: expected some of {','.join(KINDS)}, got none.")
    return wanted


def why_not(reconstruction: Reconstruction, kind: str, clip: Clip) -> str:
    """Return why a kind of file cannot be written; "" where it can."""
    if kind == "glb" and not isinstance(reconstruction, Articulated):
        return "the method has no skeleton with skinning weights"
    if kind in ("cameras", "mp4") and not any(input_camera(reconstruction, frame) for frame in clip.frames):
        return "neither the data set nor the method knows a camera"
    if kind in ("ply", "glb") and not len(reconstruction.at(clip.times[0])):
        return "there are no Gaussians"
    if kind == "glb" and isinstance(reconstruction, Articulated) and not shown(reconstruction.canonical()).any():
        return f"no Gaussian's opacity reaches {SEEN:g}"
    return ""


def export(reconstruction: Reconstruction, clip: Clip, kinds: Sequence[str], folder: Path) -> list[Path]:
    """Write files of some `KINDS`; those that cannot be written (`why_not`) are left out.

    Args:
        reconstruction: what is written.
        clip: at whose moments.
        kinds: of files.
        folder: made where it is not there.

    Returns:
        The files.

    Raises:
        UserError: the folder cannot be written.
    """
    found: list[Path] = []
    writers = {"ply": _write_plys, "glb": _write_glb, "cameras": _write_cameras, "mp4": _write_films}
    for kind in kinds:
        if not why_not(reconstruction, kind, clip):
            found += writers[kind](reconstruction, clip, folder)
    return found


def camera_table(reconstruction: Reconstruction, frames: Sequence[Frame]) -> dict[str, Any]:
    """Return the cameras of some frames as plain numbers, with the conventions spelt out."""
    rows = [_camera_row(input_camera(reconstruction, frame), frame) for frame in frames]
    return {
        "axes": "OpenCV: x right, y down, z forward",
        "pixels": "pixel centres at +0.5: column u covers [u, u + 1)",
        "world_to_camera": "4x4, row by row, acts on column vectors: x_camera = M x_world",
        "intrinsics": "3x3, row by row, in pixels of the image of width x height",
        "crop": "left, top and side of the square of the original frame (its width and height are given) that the "
        "image shows; pixel (u, v) of the image is (left + u side / width, top + v side / width) of the original",
        "units": "those of the world in which the Gaussians are; seconds",
        "frames": rows,
    }


def _camera_row(camera: Camera | None, frame: Frame) -> dict[str, Any]:
    row: dict[str, Any] = {"time": frame.time}
    if camera is not None:
        row |= {
            "width": camera.width, "height": camera.height, "intrinsics": camera.intrinsics.tolist(),
            "world_to_camera": camera.world_to_camera.tolist(),
        }  # fmt: skip
    if frame.crop is not None:
        crop = frame.crop
        row["crop"] = {"left": crop.left, "top": crop.top, "side": crop.side, "original": [crop.width, crop.height]}
    return row


def _write_plys(reconstruction: Reconstruction, clip: Clip, folder: Path) -> list[Path]:
    paths = [folder / "ply" / f"{index:05d}.ply" for index in range(len(clip.frames))]
    for path, time in zip(paths, clip.times, strict=True):
        write_splats(path, reconstruction.at(time))
    return paths


def _write_glb(reconstruction: Reconstruction, clip: Clip, folder: Path) -> list[Path]:
    assert isinstance(reconstruction, Articulated)
    path = folder / "animated.glb"
    write_glb(path, reconstruction, clip.times, clip.name, f"made from data under: {clip.licence}")
    return [path]


def _write_cameras(reconstruction: Reconstruction, clip: Clip, folder: Path) -> list[Path]:
    path = folder / "cameras.json"
    write_text(path, json.dumps(camera_table(reconstruction, clip.frames), indent=1) + "\n")
    return [path]


def _write_films(reconstruction: Reconstruction, clip: Clip, folder: Path) -> list[Path]:
    shown = [(frame, camera) for frame in clip.frames if (camera := input_camera(reconstruction, frame)) is not None]
    fps, framing = film_rate(clip.fps), find_framing(reconstruction, clip, None)
    paths = [folder / "input_view.mp4", folder / "orbit.mp4"]
    save_mp4((over(reconstruction.at(frame.time), camera) for frame, camera in shown), paths[0], fps)
    save_mp4(orbit_frames(reconstruction, clip, framing), paths[1], fps)
    return paths
