"""The result of a fit: a function from time to Gaussians in the world."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rewild4d.errors import UserError
from rewild4d.foreign.states import Shape, read_as, require_skeleton, require_tensors
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.checkpoint import load_fitted, save_fitted
from rewild4d.ours.config import Config
from rewild4d.ours.losses.regularizers import relative_angles
from rewild4d.ours.model import Model
from rewild4d.ours.motion import Root, interpolate_similarity
from rewild4d.ours.pose import Pose
from rewild4d.ours.schedule import ramp
from rewild4d.ours.skinning import SkinningField
from rewild4d.ours.symmetry import Key
from rewild4d.types import OBJECT_DIAGONAL, Camera, Splats

STATE = "ours.pt"


class OursReconstruction:
    """A trained model with the root motion and the cameras of its clip (contracts.Articulated).

    Attributes:
        model: in the object frame.
        config: of the training.
        root: object_to_world and input cameras of the clip's frames.
    """

    def __init__(self, model: Model, config: Config, root: Root) -> None:
        self.model, self.config, self.root = model.eval().requires_grad_(False), config, root
        self.weights = model.field.sample(model.field.probabilities(), model.gaussians.means)
        self.pivots, self.parents = model.pivots, model.parents

    @torch.no_grad()
    def at(self, time: float) -> Splats:
        """Return the Gaussians at a time in seconds in the world; networks and root interpolate between frames."""
        position = self.root.position(time)
        pose = self._pose([time])
        strength = ramp(1.0, self.config.deform.ramp_start, self.config.deform.ramp_end)
        _, moved = self.model.moved(pose, self.weights, strength)
        own = self.model.gaussians
        quats = nn.functional.normalize(moved.quats, dim=-1)
        posed = Splats(moved.means, quats, own.scales(moved.log_scales), own.opacities(), own.rgb()[:, None])
        world = self.root.in_world(posed, position)
        return replace(world, colors=own.splat_colors(world.quats))

    def camera(self, time: float) -> Camera | None:
        """Return the input camera at a time, in the world frame; between frames it interpolates."""
        return self.root.camera(time)

    def canonical(self) -> Splats:
        """Return the Gaussians at rest, in the object frame; `weights` [n, J] belong to the same rows."""
        return self.model.gaussians.splats()

    @torch.no_grad()
    def articulation(self, time: float) -> tuple[Tensor, Tensor]:
        """Return rest -> posed transforms, [J, 4, 4], without the deformation, and object_to_world, [4, 4]."""
        position = self.root.position(time)
        pose = self._pose([time])
        return self.model.transforms(pose)[0], interpolate_similarity(self.root.object_to_world, position)

    @torch.no_grad()
    def diagnostics(self) -> dict[str, float | list[float]]:
        """Return figures that show silent failures.

        These are angles against the parent in degrees and shifts over the rest diagonal (mean and standard deviation
        over the frames, a list over the joints), the number of Gaussians and their mean opacity.
        """
        pose = self._pose(self.root.times.tolist())
        angles = relative_angles(pose.quats, self.parents)
        shifts = pose.shifts.norm(dim=-1) / OBJECT_DIAGONAL
        figures: dict[str, float | list[float]] = {}
        for name, values in (("angle", angles), ("shift", shifts)):
            for kind, value in (("mean", values.mean(0)), ("std", values.std(0, correction=0))):
                figures[f"joint_{name}_{kind}"] = [round(x, 4) for x in value.tolist()]
        gaussians = self.model.gaussians
        return figures | {"gaussians": float(len(gaussians)), "opacity_mean": float(gaussians.opacities().mean())}

    def save(self, folder: Path) -> None:
        """Write the state and the config into an existing, empty folder."""
        cameras = [_camera_state(camera) for camera in self.root.cameras]
        state = {"model": self.model.state_dict(), **self.root.state(), "cameras": cameras}
        save_fitted(folder, STATE, state, self.config)

    def _pose(self, times: Sequence[float]) -> Pose:
        codes = torch.tensor([self.root.code_time(time) for time in times])
        return self.model.pose(codes, [Key(1, 1, 0)] * len(times))


def _camera_state(camera: Camera | None) -> dict[str, Tensor | list[int]] | None:
    if camera is None:
        return None
    size = [camera.width, camera.height]
    return {"world_to_camera": camera.world_to_camera, "intrinsics": camera.intrinsics, "size": size}


def load_reconstruction(folder: Path, device: torch.device) -> OursReconstruction:
    """Read a reconstruction that `OursReconstruction.save` wrote.

    Raises:
        UserError: a file is missing or cannot be read.
    """
    state, config = load_fitted(folder, STATE, "ours", Config)
    with read_as(folder, "ours"):
        return _from_state(folder / STATE, state, config, device)


def _from_state(path: Path, state: dict[str, Any], config: Config, device: torch.device) -> OursReconstruction:
    """Return the reconstruction that a state holds, after its shapes were looked at."""
    sizes: dict[str, int] = {}
    require_tensors(path, state, {"times": ("T",), "object_to_world": ("T", 4, 4)}, sizes)
    saved: Any = state.get("model")
    require_tensors(path, saved, _shapes(config), sizes)
    parts = config.pose.anchor_size if config.pose.anchors else sizes["J"]
    inputs = parts + 3 * (1 + 2 * config.deform.frequencies) + 4 + 3
    require_tensors(path, saved, {"deform.query.weight": (config.deform.width, inputs)}, {})
    if config.pose.turns:
        require_tensors(path, saved, {"turns.vectors": (2, "T", "J", 3), "turns.times": ("T",)}, sizes)
    require_skeleton(path, saved["parents"], saved["mirror"])
    require_skeleton(path, saved["parents"], saved["field.mirror"])
    gaussians = Gaussians.from_state(saved, config.canonical.max_scale)
    logits, origin, pitch, mirror = (saved[f"field.{name}"] for name in ("logits", "origin", "pitch", "mirror"))
    field = SkinningField(logits, origin, pitch, mirror, config.skinning.tied)
    if field.resolution < 2 or field.resolution**3 != len(logits):
        raise UserError(f"{path}: expected 'field.logits' of a cube of voxels, got {len(logits)} rows.")
    skeleton = (saved["pivots"], saved["parents"], saved["mirror"])
    model = Model(config, gaussians, field, *skeleton, torch.Generator().manual_seed(0), saved.get("turns.times"))
    model.load_state_dict(saved)
    cameras = tuple(
        None if item is None else Camera(item["world_to_camera"], item["intrinsics"], *item["size"])
        for item in state["cameras"]
    )
    for item in filter(None, state["cameras"]):
        require_tensors(path, item, {"world_to_camera": (4, 4), "intrinsics": (3, 3)}, {})
    if len(cameras) != sizes["T"] or not all(isinstance(c.width + c.height, int) for c in cameras if c is not None):
        raise UserError(f"{path}: expected a camera of {sizes['T']} frames each, got {len(cameras)} or other sizes.")
    return OursReconstruction(model.to(device), config, Root(state["times"], state["object_to_world"], cameras))


def _shapes(config: Config) -> dict[str, Shape]:
    """Return the shapes that decide all others: the settings are held against them before a network is built."""
    pose, deform = config.pose, config.deform
    code = 2 + 2 * pose.frequencies + pose.explicit_group
    last = f"network.blocks.{pose.blocks - 1}.down.bias"
    embed: dict[str, Shape] = {
        "network.anchors": ("J", pose.anchor_size), "network.embed.weight": (pose.width, pose.anchor_size + code),
    } if pose.anchors else {"network.embed.weight": ("E", code)}  # fmt: skip
    return {
        "gaussians.means": ("n", 3), "gaussians.quats": ("n", 4), "gaussians.log_scales": ("n", 3),
        "gaussians.logit_opacities": ("n",), "gaussians.colors": ("n", "C", 3), "field.logits": ("V", "J"),
        "field.origin": (3,), "field.pitch": (3,), "field.mirror": ("J",), "pivots": ("J", 3), "parents": ("J",),
        "mirror": ("J",), **embed, last: (pose.width,),
        "deform.project.weight": (deform.width, deform.width),
    }  # fmt: skip
