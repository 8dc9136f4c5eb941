"""The folder contract: what a program of others is given, how it is run, and which of its files are its answer."""

import json
import math
import os
import re
import string
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rewild4d.baselines.external_profiles import Profile
from rewild4d.errors import UserError
from rewild4d.files import command_words, digest, write_text
from rewild4d.foreign.environments import Here, environment_of
from rewild4d.foreign.programs import run_foreign
from rewild4d.priors.io import save_prior
from rewild4d.types import Clip, Frame, Prior

CROP = 256
"""Side of the square crops that 3D-Fauna takes, pixels."""
LARGE = 1 << 26
"""Bytes from which on a file that a command names (weights, an interpreter) counts by its size and time of change."""
PAD = 0.15
"""Added to the animal's box on every side of a crop, as a share of its longer side."""
README = """What this folder is

frames/0000.png ...   the video, on white          masks/0000.png ...   its mattes (255 = animal)
rgba/0000.png ...     both in one file             prior.npz            the template that every method starts from
clip.json             name, fps, size, and for each frame its time in seconds, its files and its camera
                      (OpenCV axes, world_to_camera 4x4, intrinsics 3x3 with pixel centres at +0.5; null: not known)

What to write into the output folder: frame_0000.ply ... , one for each frame: 3D Gaussians in the layout of 3DGS, or
meshes (.ply, .obj, coloured or not), in the world of the cameras; or a single animated .glb (`--profile glb`), whose
clip begins at the first frame and ends at the last.
"""


def write_clip(folder: Path, clip: Clip, prior: Prior, crops: bool) -> None:
    """Write all that a program may see: the clip and the prior.

    Args:
        folder: made where it is not there.
        clip: the frames.
        prior: a start.
        crops: write 3D-Fauna's square crops too.
    """
    listed = []
    for index, frame in enumerate(clip.frames):
        name = f"{index:04d}.png"
        white, matte = frame.over(1.0), frame.mask
        straight = torch.where(matte > 1e-3, frame.rgb / matte.clamp_min(1e-3), torch.ones_like(frame.rgb))
        _write_png(folder / "frames" / name, white)
        _write_png(folder / "masks" / name, matte)
        _write_png(folder / "rgba" / name, torch.cat((straight, matte)))
        if crops:
            _write_crop(folder / "crops", f"{index:04d}", frame)
        camera = frame.camera and {
            "world_to_camera": frame.camera.world_to_camera.tolist(), "intrinsics": frame.camera.intrinsics.tolist(),
        }  # fmt: skip
        listed.append({"index": index, "time": frame.time, "frame": f"frames/{name}", "mask": f"masks/{name}",
                       "rgba": f"rgba/{name}", "camera": camera})  # fmt: skip
    height, width = clip.frames[0].mask.shape[1:]
    about = {"name": clip.name, "fps": clip.fps, "width": width, "height": height, "licence": clip.licence,
             "frames": listed}  # fmt: skip
    save_prior(prior, folder / "prior.npz")
    write_text(folder / "README.txt", README)
    write_text(folder / "clip.json", json.dumps(about, indent=1) + "\n")


def crop_box(mask: Tensor) -> tuple[float, float, float]:
    """Return the left, top and side of the square around the animal, in pixels; it may reach beyond the image.

    Raises:
        UserError: the mask is empty.
    """
    rows, columns = (mask[0] > 0.5).nonzero().unbind(1)
    if not len(rows):
        raise UserError("expected an animal in every frame, but a mask is empty.")
    top, bottom = float(rows.min()), float(rows.max()) + 1
    left, right = float(columns.min()), float(columns.max()) + 1
    side = math.ceil(max(bottom - top, right - left) * (1 + 2 * PAD))
    return round((left + right - side) / 2), round((top + bottom - side) / 2), side


def program_digest(command: str, case: str) -> str:
    """Digest of the files that a command names, in a word or in a part of one ("--config=FILE"), and of what its
    environment has installed; "" for none."""
    try:
        words = {*command_words(command), *re.split(r"[\s='\";]+", command)}
    except ValueError:  # a quote that does not end is said when the program is to start
        return ""
    named = sorted(word.replace("{case}", case) for word in words)
    files = [word for word in named if os.path.isfile(word) and os.access(word, os.R_OK)]
    installed = next((environment_of(word).identity() for word in command_words(command)[:1]), "")
    parts = [part for file in files for part in (file, _content(Path(file)))] + ([installed] if installed else [])
    return digest(*parts) if parts else ""


def _content(file: Path) -> bytes | str:
    about = file.stat()
    return file.read_bytes() if about.st_size < LARGE else f"{about.st_size} {about.st_mtime_ns}"


def require_program(command: str) -> None:
    """Fail on a command whose words are wrong, whose environment is not there, or whose program cannot be started.

    Raises:
        UserError: so it is.
    """
    environment, words = _parted(_words(command, dict.fromkeys(("clip", "out", "case", "seed"), "x")))
    environment.require(words[0])


def environment_name(command: str) -> str:
    """Return "venv:PATH" or "docker:IMAGE" of a command, "" for neither."""
    return environment_of(next(iter(command_words(command)), "")).name


def run_program(
    command: str, *, clip: Path, out: Path, case: str, seed: int, timeout: float, log: Path, gpu: bool = False
) -> None:
    """Run a program of others until it ends.

    Args:
        command: its words, with {clip} and {out} for the two folders, and {case} and {seed} where it wants them, and
            its environment before them (`foreign.environments`).
        clip: what `write_clip` wrote.
        out: where it writes; made, and empty.
        case: name of the case.
        seed: of the run.
        timeout: seconds.
        log: file for what it prints; of more than `programs.HEAD` + 2 `programs.TAIL` bytes the middle is left out.
        gpu: whether a container may use the GPU.

    Raises:
        UserError: it cannot be started, does not end in time, or ends with another status than 0.
    """
    environment = environment_of(command_words(command)[0])
    places = dict(zip(("clip", "out"), environment.places(clip, out), strict=True))
    _, words = _parted(_words(command, {**places, "case": case, "seed": str(seed)}))
    out.mkdir(parents=True, exist_ok=True)
    call = environment.call(words, clip, out, gpu)
    with environment.watched(out):
        ended = run_foreign(call.words, timeout=timeout, log=log, environment=call.variables)
    if ended.status != 0:
        raise UserError(
            f"{words[0]}: ended with status {ended.status}; its last words: '{ended.said or 'none'}' (log: {log})."
        )


def _parted(words: list[str]) -> tuple[Here, list[str]]:
    """Part a command's words into its environment and its program with arguments."""
    environment = environment_of(words[0])
    rest = words[1:] if environment.name else words
    if not rest:
        raise UserError(f"--command: expected a program behind '{words[0]}', got nothing.")
    return environment, rest


def _words(command: str, given: Mapping[str, str]) -> list[str]:
    """A command's words with what {clip}, {out}, {case} and {seed} stand for; bare names only, as `str.format` would
    look up attributes."""
    try:
        words = command_words(command)
        fields = [field for word in words for field in string.Formatter().parse(word) if field[1] is not None]
    except ValueError as error:  # a quote or a brace that does not end
        raise UserError(f"--command: expected whole words and braces, got '{command}': {error}.") from error
    if not all(name in given and not rule and not conversion for _, name, rule, conversion in fields):
        raise UserError(f"--command: expected words with {{clip}}, {{out}}, {{case}} or {{seed}}, got '{command}'.")
    if not {"clip", "out"} <= {name for _, name, _, _ in fields}:
        raise UserError(
            f"--command: expected {{clip}} and {{out}} for the two folders among its words, got '{command}'."
        )
    return [word.format(**given) for word in words]


def find_outputs(folder: Path, profile: Profile, frames: int) -> list[Path]:
    """Return a program's files in the order of time, by the last number in their names.

    Raises:
        UserError: the folder is not there, no file fits, or they are not numbered one after another from 0 or from 1
            on, as many as the frames or, where the profile spreads them, as many as its program writes.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: expected the folder of a program's results, but there is no such folder.")
    found = next(filter(None, (sorted(folder.glob(pattern)) for pattern in profile.patterns)), [])
    wanted = " or ".join(profile.patterns)
    if not found:
        raise UserError(f"{folder}: expected files {wanted}, found none.")
    found.sort(key=lambda path: (number(path), str(path)))
    single = found[0].suffix.lower() in (".glb", ".gltf")
    if single and len(found) > 1:
        raise UserError(f"{folder}: expected one animated file {wanted}, found {len(found)}.")
    if not single:
        counts, said = _wanted(profile, frames, len(found))
        count = len(found) if len(found) in counts else counts[0]
        fault = _fault([number(path) for path in found], count)
        if fault is not None:
            raise UserError(f"{folder}: expected {said.format(wanted)}, found {len(found)}{fault}.")
    return found


def _wanted(profile: Profile, frames: int, found: int) -> tuple[tuple[int, ...], str]:
    """Return how many files a program may leave, the usual number first, and what to call them."""
    if not profile.spread:
        return (frames,), f"{frames} files {{}}, one a frame"
    if profile.moments:
        other = f" (or {frames}, one a frame)" if frames != profile.moments else ""
        return (profile.moments, frames), f"{profile.moments} files {{}}{other}"
    least = min(frames, 2)  # a single moment of a moving animal is what a killed program leaves
    return (max(found, least),), f"at least {least} files {{}}, numbered one after another"


def _fault(numbers: list[int], count: int) -> str | None:
    """Say what keeps ascending numbers from being ``count``, from 0 or from 1 on; None where nothing does."""
    first = 1 if numbers[0] == 1 else 0
    twice = next((one for one, other in pairwise(numbers) if one == other), None)
    missing = next((wanted for wanted in range(first, first + count) if wanted not in numbers), None)
    if numbers[0] < 0:
        return "; at least one has no number in its name"
    if twice is not None:
        return f"; more than one has the number {twice}"
    if missing is not None:
        return f"; the first that is missing is {missing}"
    return "" if len(numbers) != count else None


def number(path: Path) -> int:
    """Return the last number in a file's name, -1 where there is none."""
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1]) if digits else -1


def _write_crop(folder: Path, name: str, frame: Frame) -> None:
    """Image, mask and box of one frame as 3D-Fauna's data sets have them."""
    left, top, side = crop_box(frame.mask)
    height, width = frame.mask.shape[1:]
    rows, columns = (torch.arange(int(side)) + int(start) for start in (top, left))
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    picked = (
        torch.cat((frame.rgb, frame.mask))[:, rows.clamp(0, height - 1)][:, :, columns.clamp(0, width - 1)] * inside
    )
    small = interpolate(picked[None], (CROP, CROP), mode="area" if side > CROP else "bilinear")[0]
    _write_png(folder / f"{name}_rgb.png", small[:3])
    _write_png(folder / f"{name}_mask.png", small[3:])
    write_text(folder / f"{name}_box.txt", f"{int(name)} {left:g} {top:g} {side:g} {side:g} {width} {height} 1\n")


def _write_png(path: Path, image: Tensor) -> None:
    """Write [1, 3 or 4, h, w] channels in [0, 1]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[pixels.shape[2]]
    if not cv2.imwrite(str(path), np.ascontiguousarray(pixels[..., order])):
        raise UserError(f"{path}: could not be written.")
