"""Stand a run on the page: the animal at the origin, upright, of one size, in a chosen shape and colour.

The page's frame of reference, the *stage*: x the animal's left, y up, z ahead, its diagonal `OBJECT_DIAGONAL` units, as
in the object frame, but at rest: the animal moves in it as it does in the world.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.cameras.input_view import finite_at, input_camera
from rewild4d.cameras.placement import IDENTITY, Placement
from rewild4d.contracts import Articulated, Reconstruction
from rewild4d.errors import UserError
from rewild4d.harmonics import base_colors
from rewild4d.transforms import (
    camera_in_object,
    matrix_to_quat,
    on_cpu,
    similarity,
    skin_points,
    skin_quats,
    split_similarity,
    transform_splats,
)
from rewild4d.types import OBJECT_DIAGONAL, Camera, Clip, Frame, Splats, Truth
from rewild4d.visualize.pictures import part_colors
from rewild4d.visualize.turntable import Framing, find_framing, solid

Shape = Literal["deformed", "posed", "canonical"]
"""As the method answers; skinned by the joints alone, without the deformation; at rest."""
Paint = Literal["appearance", "parts"]
"""The animal's colours without what depends on the view; a colour for the bone of largest skinning weight."""
SAMPLED = 16
"""Times at which place and size are measured."""
STRAY = 0.002
"""Share of the Gaussians that may lie below the ground."""


@dataclass(frozen=True)
class Run:
    """What is shown of a run.

    Attributes:
        name: as the page says it.
        reconstruction: of the clip.
        clip: frames with cameras, of the reconstruction where the data set has none.
        truth: held-out frames.
        background: grey level in [0, 1] on which the run was scored.
        placement: by which its held-out views were drawn.
    """

    name: str
    reconstruction: Reconstruction
    clip: Clip
    truth: Truth
    background: float = 1.0
    placement: Placement = IDENTITY


@dataclass(frozen=True)
class Stage:
    """A run in the frame of the page.

    Attributes:
        run: what is shown.
        world_to_stage: similarity, float64, [4, 4].
        rest_to_stage: the same for the object frame of the shape at rest, float64, [4, 4].
        ground: height of the lowest points, in stage units.
        reach: radius of a ball around the origin that holds the animal at all times, in stage units.
        azimuth: of the input camera about up, from ahead towards left, radians.
        shapes: what can be shown.
        paints: how it can be coloured.
    """

    run: Run
    world_to_stage: Tensor
    rest_to_stage: Tensor
    ground: float
    reach: float
    azimuth: float
    shapes: tuple[Shape, ...]
    paints: tuple[Paint, ...]

    @torch.no_grad()
    def splats(self, time: float, shape: Shape = "deformed", paint: Paint = "appearance") -> Splats:
        """Return the Gaussians at a time in the stage's frame, on the CPU, their colours RGB, [n, 1, 3].

        Args:
            time: seconds; before the first or after the last frame of the clip, what is there.
            shape: one of ``shapes``; canonical does not depend on the time.
            paint: one of ``paints``.

        Raises:
            UserError: the reconstruction holds a NaN or an infinite value.
        """
        made, times = self.run.reconstruction, self.run.clip.times
        time = min(max(time, times[0]), times[-1])
        if shape == "canonical":
            splats = made.canonical()  # type: ignore[attr-defined]
        else:
            splats = posed(made, time) if shape == "posed" else finite_at(made, time)  # type: ignore[arg-type]
        colors = base_colors(splats)
        if paint == "parts":
            weights = made.weights  # type: ignore[attr-defined]
            colors = part_colors(weights.shape[1]).to(colors)[weights.argmax(1)]
        plain = replace(on_cpu(splats), colors=colors.float().cpu()[:, None])
        return transform_splats(plain, self.rest_to_stage if shape == "canonical" else self.world_to_stage)

    def camera(self, frame: Frame) -> Camera | None:
        """Return a frame's camera in the frame of the stage, or None where nobody knows it."""
        camera = input_camera(self.run.reconstruction, frame)
        return camera and camera_in_object(camera, torch.linalg.inv(self.world_to_stage))

    def framing(self, shape: Shape) -> Framing | None:
        """Return position and size of the animal for a film of one orbit, in the frame of the stage."""
        run = self.run
        framing = find_framing(run.reconstruction, run.clip, run.truth.up)
        if framing is None:
            return None
        scale, rotation, shift = split_similarity(self.world_to_stage)
        middles = framing.middles @ (scale * rotation).T + shift
        axes = framing.axes @ rotation.T
        if shape == "canonical":  # it stands still, upright
            middles, axes = torch.zeros_like(middles), torch.eye(3).double().expand_as(axes)
        return replace(framing, middles=middles, axes=axes, radius=float(scale) * framing.radius)


def set_stage(run: Run) -> Stage:
    """Measure where the animal is, how large it is and which way is up.

    Raises:
        UserError: no Gaussians, no camera, or numbers that are not finite.
    """
    times = run.clip.times
    first = finite_at(run.reconstruction, times[0])
    if not len(first):
        raise UserError(f"{run.name}: the reconstruction has no Gaussians to show.")
    rows = sorted({round(i * (len(times) - 1) / (SAMPLED - 1)) for i in range(SAMPLED)})
    framing = find_framing(run.reconstruction, run.clip.only(rows), run.truth.up)
    if framing is None:
        raise UserError(f"{run.name}: neither the data set nor the method knows a camera, or a time has no Gaussians.")
    # What the data set knows of up, else the animal's own or the cameras'.
    up = normalize(framing.axes[:, 1].mean(0) if run.truth.up is None else run.truth.up.double(), dim=0)
    ahead = framing.axes[:, 2].mean(0)
    ahead = normalize(ahead - (ahead @ up) * up, dim=0)
    rotation = torch.stack((torch.linalg.cross(up, ahead), up, ahead))
    scale, center = OBJECT_DIAGONAL / (2 * framing.radius), framing.middles.mean(0)
    matrix = similarity(scale, rotation, -scale * rotation @ center)
    few = [solid(run.reconstruction.at(times[row])) for row in rows[:: len(rows) // 4 or 1]]
    lowest = [means @ (scale * rotation[1]) - scale * radii for means, radii in few]
    away = float((framing.middles - center).norm(dim=1).max())
    return Stage(
        run, matrix, _stand(run.reconstruction), ground=min(float(torch.quantile(y, STRAY)) for y in lowest)
        + float(matrix[1, 3]), reach=float(scale) * (framing.radius + away), azimuth=framing.azimuth,
        shapes=_shapes(run.reconstruction), paints=_paints(run.reconstruction, len(first)),
    )  # fmt: skip


def posed(reconstruction: Articulated, time: float) -> Splats:
    """Return the Gaussians at rest, skinned by the joints at a time, without any further deformation, in the world.

    Their colours are RGB without what depends on the view, [n, 1, 3].
    """
    rest = reconstruction.canonical()
    transforms, object_to_world = reconstruction.articulation(time)
    weights, transforms = reconstruction.weights.to(rest.means), transforms.to(rest.means)
    skinned = replace(
        rest,
        means=skin_points(rest.means, weights, transforms),
        quats=skin_quats(rest.quats, weights, matrix_to_quat(transforms[:, :3, :3])),
        colors=base_colors(rest)[:, None],
    )
    return transform_splats(skinned, object_to_world.to(rest.means.device))


def _shapes(reconstruction: Reconstruction) -> tuple[Shape, ...]:
    if isinstance(reconstruction, Articulated):
        return ("deformed", "posed", "canonical")
    return ("deformed", "canonical") if hasattr(reconstruction, "canonical") else ("deformed",)


def _paints(reconstruction: Reconstruction, count: int) -> tuple[Paint, ...]:
    weights = getattr(reconstruction, "weights", None)
    return ("appearance", "parts") if weights is not None and len(weights) == count else ("appearance",)


def _stand(reconstruction: Reconstruction) -> Tensor:
    """Return the translation that puts the middle of the shape at rest at the origin, float64, [4, 4]."""
    matrix = torch.eye(4, dtype=torch.float64)
    if hasattr(reconstruction, "canonical"):
        body, _ = solid(reconstruction.canonical())
        matrix[:3, 3] = -(body.amin(0) + body.amax(0)) / 2
    return matrix
