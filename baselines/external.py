"""Anybody's program as a competitor: it gets the clip as files and leaves Gaussians or meshes as files.

`--command "conda run -n theirs python run.py {clip} {out}"` runs a program; `--folder results/{case}` takes what one
left before; `--file theirs.toml` does what a method file says (`external_file`). `external_folder.README` says what the
two folders hold, `--profile` names other layouts.

A result in other coordinates than the input cameras is rotated, scaled and shifted to the best input-view PSNR,
as the paper does for such methods. It has then been shown the answer, so it carries the mark "upper bound" in its
record and in every table, and no rank.
"""

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import torch
from torch import Tensor

from rewild4d.baselines.external_alignment import UPS, Placement, place_by_search, place_fauna
from rewild4d.baselines.external_config import INFO, ExternalConfig
from rewild4d.baselines.external_file import facts, resolved
from rewild4d.baselines.external_folder import (
    crop_box,
    environment_name,
    find_outputs,
    program_digest,
    require_program,
    run_program,
    write_clip,
)
from rewild4d.baselines.external_profiles import PROFILES, Profile
from rewild4d.baselines.external_reading import Moment, moved_discs, painted, read_moments
from rewild4d.contracts import Log, MethodInfo
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import digest, load_tensors, save_tensors, write_text
from rewild4d.foreign.states import read_as
from rewild4d.foreign.texts import read_json
from rewild4d.io.meshes import Discs
from rewild4d.ours.motion import camera_between, frame_position
from rewild4d.priors.motion import pose_at
from rewild4d.transforms import skin_points, split_similarity, transform_splats
from rewild4d.types import Camera, Clip, Frame, Prior, Splats

STATE = "external.pt"
DONE = "done.json"
Shots = list[tuple[Frame, Camera]]


@dataclass(frozen=True)
class ExternalReconstruction:
    """Somebody's moments, in the world.

    Attributes:
        times: of the moments in seconds, ascending.
        moments: Gaussians of each.
        cameras: input camera by time, ascending.
        marks: what tables say beside the numbers.
        notes: figures for the record.
    """

    times: tuple[float, ...]
    moments: tuple[Splats, ...]
    cameras: dict[float, Camera | None]
    marks: tuple[str, ...]
    notes: dict[str, Any]

    def at(self, time: float) -> Splats:
        """Return the moment nearest to a time: nothing is known of what lies between."""
        return self.moments[min(range(len(self.times)), key=lambda i: abs(self.times[i] - time))]

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world; between frames it interpolates."""
        times = torch.tensor(tuple(self.cameras), dtype=torch.float64)
        return camera_between(tuple(self.cameras.values()), frame_position(times, time))

    def diagnostics(self) -> dict[str, Any]:
        """Return how it was placed, and how many Gaussians there are."""
        return {**self.notes, "gaussians": sum(map(len, self.moments)) / len(self.moments)}

    def save(self, folder: Path) -> None:
        cameras = {t: c and (c.world_to_camera, c.intrinsics, c.width, c.height) for t, c in self.cameras.items()}
        moments = [(m.means, m.quats, m.scales, m.opacities, m.colors) for m in self.moments]
        state = {"times": self.times, "moments": moments, "cameras": cameras, "marks": self.marks, "notes": self.notes}
        save_tensors(state, folder / STATE)


class External:
    """A program of others (contracts.Method)."""

    info: ClassVar[MethodInfo] = INFO
    Config: ClassVar[type[ExternalConfig]] = ExternalConfig

    def inputs(self, config: ExternalConfig, case: str) -> str:
        """Digest of the files that decide the result beside the settings: those that the command names, or those of a
        folder that is already there."""
        said = [msgspec.json.encode(resolved(config))] if config.file else []
        config = resolved(config)
        if not config.folder:
            found = program_digest(config.command, _file_name(case))
            return digest(*said, found) if said else found
        folder = _folder(config, case)
        paths = sorted(folder.rglob("*"), key=lambda path: path.parts)  # Windows would sort without case
        return digest(*said, *(part for path in paths if path.is_file()
                               for part in (path.relative_to(folder).as_posix(), path.read_bytes())))  # fmt: skip

    def describe(self, config: ExternalConfig) -> dict[str, str]:
        """Return for the record whose program it is, and a digest of what its command names (contracts.Method)."""
        told, config = facts(config), resolved(config)
        profile = _profile(config)
        about = {"program": config.program or (profile.title if profile.paper else ""), **told}
        if config.command:
            about["environment"] = environment_name(config.command)
            about["program_digest"] = program_digest(config.command, "")
        return {name: text for name, text in about.items() if text}

    def require(self, config: ExternalConfig, cases: Sequence[str]) -> None:
        """Say what no case could be made with before any is (`Method`).

        Raises:
            UserError: an unknown profile, both or neither of command and folder, or one that cannot be used.
        """
        config = resolved(config)
        _profile(config)
        if bool(config.command) == bool(config.folder):
            raise UserError(
                "external: expected either --command (a program to run) or --folder (its results), or --file for both."
            )
        if config.command:
            require_program(config.command)
        elif not any(_folder(config, case).is_dir() for case in cases):
            first = _folder(config, cases[0])
            raise UserError(f"{first}: expected the folder of a program's results, but there is no such folder.")

    def fit(
        self, clip: Clip, prior: Prior, *, config: ExternalConfig, seed: int, device: torch.device, log: Log,
        workdir: Path | None,
    ) -> ExternalReconstruction:  # fmt: skip
        """Run the program, or take what it left, and read it; see contracts.Method."""
        self.require(config, [clip.name])
        config = resolved(config)
        profile = _profile(config)
        for frame in clip.frames:
            crop_box(frame.mask)  # an empty mask is said before hours of work
        if config.folder:
            return _read(_folder(config, clip.name), clip, prior, profile, config, seed, log)
        with tempfile.TemporaryDirectory() as spare:
            work = workdir or Path(spare)
            _run(work, clip, prior, profile, config, seed, device.type == "cuda")
            try:
                return _read(work / "out", clip, prior, profile, config, seed, log)
            except Exception:
                (work / DONE).unlink(missing_ok=True)  # a mended program must be run, not its old output read again
                raise

    def load(self, folder: Path, device: torch.device) -> ExternalReconstruction:
        state = load_tensors(folder / STATE)
        with read_as(folder, "external"):
            cameras = {time: values and Camera(*values) for time, values in state["cameras"].items()}
            moments = tuple(Splats(*values) for values in state["moments"])
            return ExternalReconstruction(state["times"], moments, cameras, tuple(state["marks"]), state["notes"])


def _profile(config: ExternalConfig) -> Profile:
    """Return the profile with the settings that override it."""
    if config.profile not in PROFILES:
        raise unknown_name("profile", config.profile, PROFILES)
    profile = PROFILES[config.profile]
    placed = profile.placed if config.placed == "profile" else config.placed == "yes"
    return msgspec.structs.replace(profile, placed=placed, up=profile.up if config.up == "profile" else config.up)


def _folder(config: ExternalConfig, case: str) -> Path:
    return Path(config.folder.replace("{case}", _file_name(case)))


def _file_name(case: str) -> str:
    return case.replace("/", "__")


def _run(
    work: Path, clip: Clip, prior: Prior, profile: Profile, config: ExternalConfig, seed: int, gpu: bool
) -> None:  # fmt: skip
    """Run the program, unless it has already run in this folder on the same input to its end."""
    identity = digest(msgspec.json.encode(config), clip.digest, prior.digest, str(seed))
    done = work / DONE
    if done.is_file() and read_json(done, "a digest of the input") == identity:
        return
    for name in ("clip", "out"):
        shutil.rmtree(work / name, ignore_errors=True)
    write_clip(work / "clip", clip, prior, profile.crops)
    run_program(
        config.command, clip=work / "clip", out=work / "out", case=_file_name(clip.name), seed=seed,
        timeout=config.timeout, log=work / "program.log", gpu=gpu,
    )  # fmt: skip
    write_text(done, json.dumps(identity) + "\n")


def _read(
    folder: Path, clip: Clip, prior: Prior, profile: Profile, config: ExternalConfig, seed: int, log: Log
) -> ExternalReconstruction:
    """Read files as Gaussians in the world."""
    paths = find_outputs(folder, profile, len(clip.frames))
    moments = read_moments(paths, clip.times, config.points, seed)
    times = _times(clip, len(moments), profile.spread)
    shots = [(frame, _camera(frame, prior)) for frame in clip.frames]
    nearest = [min(range(len(shots)), key=lambda i: abs(clip.frames[i].time - time)) for time in times]
    placed: Sequence[Moment] = moments
    marks: tuple[str, ...] = ()
    notes: dict[str, Any] = {"program": config.program or profile.title, "files": len(paths)}
    if len(moments) != len(clip.frames):
        notes["moments"] = f"{len(moments)} files for {len(clip.frames)} frames, spread evenly over the clip"
    if profile.crops:
        placed = [_placed_by_fauna(*pair, prior) for pair in zip(paths, moments, shots, strict=True)]
    elif not profile.placed:
        found = _search(moments, times, clip, prior, shots, profile, log)
        placed = [_moved(moment, found.matrix) for moment in moments]
        marks = ("upper bound: rotated, scaled and shifted to the best input-view PSNR",)
        notes |= {"placed_azimuth": found.azimuth, "placed_elevation": found.elevation, "placed_scale": found.scale,
                  "placed_psnr": found.psnr}  # fmt: skip
    splats = _colored(placed, [shots[index] for index in nearest])
    cameras = {frame.time: camera for frame, camera in shots}
    return ExternalReconstruction(tuple(times), tuple(splats), dict(cameras), marks, notes)


def _times(clip: Clip, count: int, spread: bool) -> list[float]:
    """Seconds of each moment: those of the frames, or spread so that as many moments as frames fall on the frames."""
    if not spread:
        return list(clip.times)
    first, last, frames = clip.times[0], clip.times[-1], len(clip.times)
    step = (last - first) / max(1, frames - 1)
    return [first + step * ((index + 1) / (count + 1) * (frames + 1) - 1) for index in range(count)]


def _search(
    moments: Sequence[Moment],
    times: Sequence[float],
    clip: Clip,
    prior: Prior,
    shots: Shots,
    profile: Profile,
    log: Log,
) -> Placement:
    """Rotate to the best input-view PSNR; a mesh without colour is compared in the animal's mean colour."""
    mean = sum(frame.rgb.sum((1, 2)) for frame in clip.frames) / sum(frame.mask.sum() for frame in clip.frames)
    plain = [m.splats(torch.as_tensor(mean).expand(len(m.points), 3) if m.colors is None else m.colors)
             if isinstance(m, Discs) else m for m in moments]  # fmt: skip
    at = [plain[min(range(len(times)), key=lambda i: abs(times[i] - frame.time))] for frame in clip.frames]
    depth = _depth(prior, *shots[0])
    axes = UPS if profile.up == "any" else (profile.up,)
    found = [place_by_search(at, shots, depth, axis, profile.elevation, log) for axis in axes]
    return max(found, key=lambda placement: placement.psnr)


def _placed_by_fauna(path: Path, moment: Moment, shot: tuple[Frame, Camera], prior: Prior) -> Moment:
    frame, camera = shot
    pose = path.with_name(path.name.removesuffix("_mesh.obj") + "_pose.txt")
    return _moved(moment, place_fauna(pose, crop_box(frame.mask), camera, _depth(prior, frame, camera)))


def _moved(moment: Moment, matrix: Tensor) -> Moment:
    return moved_discs(moment, matrix) if isinstance(moment, Discs) else transform_splats(moment, matrix)


def _colored(moments: Sequence[Moment], shots: Shots) -> list[Splats]:
    """Return Gaussians of all moments; a mesh without colour is painted from the frames."""
    bare = [moment for moment in moments if isinstance(moment, Discs) and moment.colors is None]
    if bare:
        if len(bare) < len(moments):
            raise UserError("external: expected meshes that all have colours or all have none, got some of either.")
        return painted(bare, shots)
    return [m.splats(m.colors) if isinstance(m, Discs) and m.colors is not None else m for m in moments]  # type: ignore[misc]


def _camera(frame: Frame, prior: Prior) -> Camera:
    """Return the frame's camera in the world; where nobody knows it, the prior's."""
    if frame.camera is not None:
        return frame.camera
    row = int((prior.times - frame.time).abs().argmin())
    matrix = prior.object_to_world[row].double()
    scale = float(split_similarity(matrix)[0])
    grow = torch.diag(torch.tensor((scale, scale, scale, 1.0), dtype=torch.float64))
    camera = prior.cameras[row]
    return replace(camera, world_to_camera=grow @ camera.world_to_camera.double() @ torch.linalg.inv(matrix))


def _depth(prior: Prior, frame: Frame, camera: Camera) -> float:
    """Return the depth of the prior's middle before a camera."""
    object_to_world, transforms = pose_at(prior, frame.time)
    posed = skin_points(prior.vertices, prior.weights, transforms).double()
    middle = object_to_world[:3, :3] @ posed.median(0).values + object_to_world[:3, 3]
    return float((camera.world_to_camera.double() @ torch.cat((middle, torch.ones(1).double())))[2])
