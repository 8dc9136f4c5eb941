"""How tests read short films of a moving animal, fit a prior to them and look at them."""

from pathlib import Path

import cv2
import moving
import msgspec
import numpy as np
import torch

from rewild4d.commands.shared import choose_prior
from rewild4d.contracts import Selection
from rewild4d.datasets.video.online import Online
from rewild4d.evaluation.protocol import Protocol
from rewild4d.priors.config import FOOTAGE
from rewild4d.registry import load_method
from rewild4d.running import runner
from rewild4d.types import Camera, Clip, Frame, Splats

SELECTION = Selection(cameras="unknown", size=64, framing="crop", split=5)
PROTOCOL = Protocol(
    name="test-v1", dataset="online", title="", description="", background=1.0, scores=("psnr", "psnr_fg", "iou"),
    floors=(), selection=SELECTION,
)  # fmt: skip
TINY = msgspec.structs.replace(
    FOOTAGE, yaw_starts=4,
    stages=tuple(msgspec.structs.replace(stage, steps=1, frames=3, size=24) for stage in FOOTAGE.stages),
)  # fmt: skip
"""Settings of priors of footage with a step a stage."""
PAN = 4
"""Pixels a frame by which the camera of `panned` follows the animal, which stays at its place in the image."""


def restored(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """The frame's mask back in the original frame, nearest pixel, bool [h, w]."""
    assert frame.crop is not None
    rows, columns = np.mgrid[: size[1], : size[0]]
    points = torch.from_numpy(np.stack((columns + 0.5, rows + 0.5), axis=-1)).float()
    at = frame.crop.from_original(points, frame.mask.shape[1]).floor().long()
    inside = ((at >= 0) & (at < frame.mask.shape[1])).all(-1)
    at = at.clamp(0, frame.mask.shape[1] - 1)
    return ((frame.mask[0][at[..., 1], at[..., 0]] > 0.5) & inside).numpy()


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


def panned(folder: Path, count: int = 12) -> Path:
    """folder/frames and folder/masks: an animal that walks to the right before a camera that pans along."""
    scene = np.random.default_rng(0).integers(0, 255, (64, 96 + PAN * count, 3), dtype=np.uint8)
    scene = cv2.normalize(cv2.GaussianBlur(scene, (0, 0), 4.0), None, 0, 255, cv2.NORM_MINMAX)
    where = {"left": 48.0, "step": 0.0}
    for i in range(count):
        inside = moving.mask(i, **where)[..., None] > 0
        view = scene[:, PAN * i : PAN * i + 96]
        moving.save(folder / "frames" / f"{i:05d}.png", np.where(inside, np.uint8(150), view))
        moving.save(folder / "masks" / f"{i:05d}.png", moving.mask(i, **where))
    return folder


def plan(reader: Online, case: str, out: Path, prior: str = "template") -> runner.Plan:
    """A run of `prior-only` with 300 Gaussians."""
    entry = runner.Entry(
        "prior-only", "quick", msgspec.structs.replace(load_method("prior-only").Config(), gaussians=300), (0,)
    )
    return runner.Plan(
        dataset="online", reader=reader, root=out, cases=(case,), protocol=PROTOCOL, entries=(entry,),
        prior=choose_prior(prior, "quick", reader), device=torch.device("cpu"), out=out,
    )  # fmt: skip


class Plate:
    """The pixels of one frame as Gaussians on a plane that faces a camera, at twice the size of the image asked for."""

    def __init__(self, clip: Clip, knows: bool = True) -> None:
        self.frame, self.knows = clip.frames[0], knows
        self.asked: list[float] = []

    def at(self, time: float) -> Splats:
        rows, columns = torch.nonzero(self.frame.mask[0] > 0.5, as_tuple=True)
        middle = torch.stack(((columns + 0.5) / 32 - 1, (rows + 0.5) / 32 - 1, torch.full(rows.shape, 2.0)), dim=1)
        count = len(rows)
        return Splats(middle, torch.tensor((1.0, 0, 0, 0)).expand(count, 4), torch.full((count, 3), 0.012),
                      torch.full((count,), 0.95), self.frame.rgb[:, rows, columns].T[:, None].contiguous())  # fmt: skip

    def camera(self, time: float) -> Camera | None:
        self.asked.append(time)
        intrinsics = torch.tensor(((128.0, 0, 64), (0, 128, 64), (0, 0, 1)), dtype=torch.float64)
        return Camera(torch.eye(4, dtype=torch.float64), intrinsics, 128, 128) if self.knows else None

    def save(self, folder: Path) -> None: ...
