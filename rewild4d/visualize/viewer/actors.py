"""A run in the browser's scene: its Gaussians as splats and as points, its name, and the film's camera."""

import math
from typing import Literal

import numpy as np
import viser
from torch import Tensor

from rewild4d.transforms import matrix_to_quat
from rewild4d.types import Camera, Frame
from rewild4d.visualize.pictures import to_bytes
from rewild4d.visualize.viewer.looking import centered
from rewild4d.visualize.viewer.moments import Moment, Moments
from rewild4d.visualize.viewer.staging import Paint, Shape, Stage

Draw = Literal["splats", "points"]
POINT = 0.03
"""Size of a point in stage units."""
BODY = 26
"""Opacity, of 255, from which a Gaussian is a point."""
INK = (40, 40, 40)


class Actor:
    """One run in the scene.

    Args:
        server: of the page.
        stage: of the run.
        name: of its nodes in the scene.
        offset: of the animal in the scene, float64, [3].
        label: drawn above it; "" for none.
    """

    def __init__(self, server: viser.ViserServer, stage: Stage, name: str, offset: Tensor, label: str) -> None:
        self.stage, self.offset, self.moments = stage, offset, Moments(stage)
        self._scene, self._name = server.scene, name
        self._drawn: tuple[Moment, Draw] | None = None
        self._place = tuple(offset.tolist())
        first = self.moments.get(stage.run.clip.times[0], "deformed", "appearance")
        self._splats = self._scene.add_gaussian_splats(f"{name}/splats", *vars(first).values(), position=self._place)
        self._points = self._scene.add_point_cloud(
            f"{name}/points", first.centers, first.rgbs, point_size=POINT, point_shape="circle", precision="float32",
            position=self._place, visible=False,
        )  # fmt: skip
        if label:
            top = float(first.centers[:, 1].max()) + 0.4
            above = (self._place[0], self._place[1] + top, self._place[2])
            self._scene.add_label(f"{name}/label", label, position=above, anchor="bottom-center")
        self._frustum: viser.CameraFrustumHandle | None = None

    def show(self, time: float, shape: Shape, paint: Paint, draw: Draw) -> None:
        """Draw a moment, where it is not what is drawn already."""
        shape = shape if shape in self.stage.shapes else "deformed"
        paint = paint if paint in self.stage.paints else "appearance"
        moment = self.moments.get(time, shape, paint)
        if self._drawn is not None and self._drawn[0] is moment and self._drawn[1] == draw:
            return
        if draw == "splats":
            self._splats.set_gaussians(*vars(moment).values())
        else:
            body = moment.opacities[:, 0] >= BODY
            self._points.points, self._points.colors = moment.centers[body], moment.rgbs[body]
        self._splats.visible, self._points.visible = draw == "splats", draw == "points"
        self._drawn = moment, draw

    def show_camera(self, frame: Frame, shown: bool) -> None:
        """Draw the film's camera with its image, or take it away."""
        camera = self.camera(frame) if shown else None
        if self._frustum is not None:
            self._frustum.visible = camera is not None
        if camera is None:
            return
        camera = centered(camera)
        to_world = camera.world_to_camera.inverse()
        quat, position = matrix_to_quat(to_world[:3, :3]).numpy(), to_world[:3, 3].numpy()
        fov = 2 * math.atan(camera.height / 2 / float(camera.intrinsics[1, 1]))
        image = to_bytes(frame.over(1.0))
        if self._frustum is None:
            self._frustum = self._scene.add_camera_frustum(
                f"{self._name}/camera", fov, camera.width / camera.height, scale=0.6, color=INK, image=image,
                wxyz=quat, position=position,
            )  # fmt: skip
        self._frustum.wxyz, self._frustum.position = quat, position
        self._frustum.fov, self._frustum.image = fov, image

    def camera(self, frame: Frame) -> Camera | None:
        """Return a frame's camera in the scene, or None where nobody knows it."""
        camera = self.stage.camera(frame)
        if camera is None:
            return None
        moved = camera.world_to_camera.clone()
        moved[:3, 3] -= moved[:3, :3] @ self.offset.to(moved)
        return Camera(moved, camera.intrinsics, camera.width, camera.height)

    def frame(self, time: float) -> Frame:
        """Return the film's frame that is closest to a time."""
        frames = self.stage.run.clip.frames
        return frames[int(np.argmin([abs(frame.time - time) for frame in frames]))]
