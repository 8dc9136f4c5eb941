"""Check a method, or a metric of another package, against the contract on a tiny case: `check --method NAME`.

A method that passes can be run, resumed, evaluated again and compared.
"""

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from rewild4d.cameras.rendering import render
from rewild4d.config import load_preset
from rewild4d.contracts import Clouds, Finding, HeldOut, Method, NotComputed, Reconstruction
from rewild4d.errors import UserError
from rewild4d.evaluation.plugged import Source, find_metric, measure
from rewild4d.files import digest
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.kinematics import pose
from rewild4d.priors.motion import pose_at, pose_gaussians, quats_from_normals, sample_surface
from rewild4d.priors.posed import posed_prior
from rewild4d.progress import Progress
from rewild4d.registry import load_method
from rewild4d.running.runner import save_reconstruction
from rewild4d.transforms import camera_in_object, look_at, similarity, transform_splats
from rewild4d.types import OBJECT_DIAGONAL, Camera, Case, Clip, Frame, Splats, Truth


def check_method(name: str, preset: str) -> list[Finding]:
    """Fit the method twice on a tiny case and report every requirement that it breaks."""
    method = load_method(name)
    config = load_preset(name, method.Config, preset)
    case = tiny_case()
    findings = []
    with tempfile.TemporaryDirectory() as folder:
        for title, test in _checks(name, method, config, case, Path(folder)):
            try:
                message = test()
                findings.append(Finding("error" if message else "ok", f"{name}: {title}", message or "kept"))
            except Exception as error:  # whatever a plug-in raises is what the check is there to report
                findings.append(Finding("error", f"{name}: {title}", f"{type(error).__name__}: {error}"))
                if title == "fits":
                    break
    return findings


def check_metric(name: str) -> list[Finding]:
    """Measure two images, or two moments, twice, and report every requirement that a metric breaks."""
    case, findings = tiny_case(frames=2, views=3), []
    images = [
        HeldOut(frame.time, frame.view, 0.9 * frame.over(1.0), frame.over(1.0), frame.mask, frame.mask, 1.0)
        for frame in case.truth.held_out
    ]
    points = case.prior.vertices.double()
    clouds = [Clouds(time, points + 0.01, points.clone(), OBJECT_DIAGONAL) for time in case.clip.times]
    values: list[float | None] = []

    def measured() -> str:
        metric, info = find_metric(name)
        items: list[Any] = [*(images if info.needs == "images" else clouds)]
        with contextlib.suppress(NotComputed):
            values.append(measure(metric, info, Source(lambda: items, len(items), "", "item")).value)
        return ""

    def repeats() -> str:
        measured()
        return "" if len(set(values)) <= 1 else f"expected the same value twice, got {values[0]} and {values[1]}"

    for title, test in (("measures", measured), ("same items, same value", repeats)):
        try:
            message = test()
        except (Exception, SystemExit) as error:  # whatever a plug-in raises is what the check is there to report
            message = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        findings.append(Finding("error" if message else "ok", f"{name}: {title}", message or "kept"))
        if message:
            break
    return findings


def _checks(
    name: str, method: Method, config: Any, case: Case, folder: Path
) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield the checks in order: each returns an empty string, or what came instead of what was expected."""
    fitted: list[Reconstruction] = []

    def fit(clip: Clip = case.clip, workdir: Path | None = None) -> Reconstruction:
        with contextlib.closing(Progress(f"check {name}")) as log:
            return method.fit(
                clip, case.prior, config=config, seed=0, device=torch.device("cpu"), log=log, workdir=workdir
            )

    def fits() -> str:
        (folder / "work").mkdir()
        fitted.append(fit(workdir=folder / "work"))
        splats = fitted[0].at(case.clip.times[0])
        return "" if isinstance(splats, Splats) else f"expected types.Splats from at(time), got {type(splats).__name__}"

    def repeats() -> str:
        return _difference(fitted[0], fit(), case, "a second fit with the same seed")

    def reloads() -> str:
        save_reconstruction(fitted[0], folder / "saved")
        return _difference(fitted[0], method.load(folder / "saved", torch.device("cpu")), case, "the saved one")

    def resumes() -> str:
        return _difference(fitted[0], fit(workdir=folder / "work"), case, "a fit resumed in a finished work folder")

    def refuses() -> str:
        empty = replace(case.clip.frames[1], mask=torch.zeros_like(case.clip.frames[1].mask))
        frames = (case.clip.frames[0], empty, *case.clip.frames[2:])
        try:
            fit(replace(case.clip, frames=frames, digest=digest(case.clip.digest, "empty")))
        except UserError as error:
            return "" if str(error) else "expected a sentence in the UserError, got nothing"
        return "" if method.info.is_floor else "expected a UserError on an empty mask, got a reconstruction"

    yield "fits", fits
    yield "same seed, same result", repeats
    yield "save and load, same pixels", reloads
    yield "resumes to the same result", resumes
    yield "refuses an empty mask in one sentence", refuses


def _difference(one: Reconstruction, other: Reconstruction, case: Case, what: str) -> str:
    for frame in (case.clip.frames[0], case.truth.held_out[-1]):
        assert frame.camera is not None
        pictures = [render(reconstruction.at(frame.time), frame.camera) for reconstruction in (one, other)]
        if not torch.equal(pictures[0][0], pictures[1][0]):
            largest = float((pictures[0][0] - pictures[1][0]).abs().max())
            return f"expected the same pixels from {what}, got a difference of up to {largest:.2e}"
    return ""


def tiny_case(frames: int = 4, width: int = 96, height: int = 64, views: int = 6) -> Case:
    """Render a walking template from a ring of cameras in a rotated, scaled world: the truth is known exactly."""
    template = QUADRUPED.build()
    times = torch.arange(frames, dtype=torch.float64) / 10
    angles = torch.zeros(frames, len(template.parents), 3)
    for leg, phase in zip((10, 13, 16, 19), (0.0, 0.5, 0.0, 0.5), strict=True):
        angles[:, leg, 0] = 0.4 * torch.sin(2 * math.pi * (times.float() * 2 + phase))
    transforms = pose(angles, template.bones[:, 0], template.parents)
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)))[0]
    translation = torch.tensor((0.4, -0.2, 0.7), dtype=torch.float64)
    world = similarity(0.3, rotation * torch.linalg.det(rotation), translation)
    ring = [_ring_camera(world, 2 * math.pi * view / views, width, height) for view in range(views)]
    cameras = [camera_in_object(ring[i % views], world) for i in range(frames)]
    prior = posed_prior(
        template, transforms, world.expand(frames, 4, 4).clone(), cameras, times, name="exact",
        provenance="the template that the images were drawn from", digest=digest(transforms, world),
    )  # fmt: skip
    sample = sample_surface(prior, 4000, torch.Generator().manual_seed(0))
    colors = 0.5 + 0.4 * torch.sin(3 * sample.points)
    scales = sample.radius * torch.tensor((1.0, 1.0, 0.5)).expand(4000, 3)

    def shot(index: int, view: int) -> Frame:
        object_to_world, posed = pose_at(prior, float(times[index]))
        splats = pose_gaussians(sample, quats_from_normals(sample.normals), scales, colors, posed)
        rgb, mask = render(transform_splats(splats, object_to_world), ring[view])
        return Frame(float(times[index]), ring[view], rgb, mask, view)

    shown = tuple(shot(i, i % views) for i in range(frames))
    held = [shot(i, (i + 2) % views) for i in range(frames)]
    key = digest(*(frame.rgb for frame in shown))
    return Case(Clip("tiny/walk", "template", shown, 10.0, "CC0 1.0", key), prior, Truth(held, None, key))


def _ring_camera(world: torch.Tensor, azimuth: float, width: int, height: int) -> Camera:
    """Return a camera that looks at the animal from an azimuth, a little from above."""
    eye = torch.tensor((12 * math.sin(azimuth), 4.0, 12 * math.cos(azimuth), 1.0), dtype=torch.float64)
    up = torch.nn.functional.normalize(world[:3, 1], dim=0)
    focal = 1.6 * width
    intrinsics = torch.tensor(((focal, 0, width / 2), (0, focal, height / 2), (0, 0, 1)), dtype=torch.float64)
    return Camera(look_at((world @ eye)[:3], world[:3, 3], up), intrinsics, width, height)
