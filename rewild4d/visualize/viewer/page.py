"""The page: what its controls say is drawn, in all tabs that are open, by one thread."""

import math
import threading
import time
from collections.abc import Sequence
from typing import Any

import torch
import viser

from rewild4d.errors import UserError
from rewild4d.types import OBJECT_DIAGONAL
from rewild4d.visualize.pictures import beside, to_bytes
from rewild4d.visualize.viewer.actors import Actor
from rewild4d.visualize.viewer.comparing import HeldOut, compare
from rewild4d.visualize.viewer.controls import BLANK, SPEEDS, Controls
from rewild4d.visualize.viewer.looking import Look, look_from, look_through
from rewild4d.visualize.viewer.moments import Clock
from rewild4d.visualize.viewer.saving import save_film, save_snapshot
from rewild4d.visualize.viewer.staging import Stage

ELEVATION = math.radians(12)
FASTEST = 1 / 30
"""Least seconds between two drawings of a playing film."""
PATIENCE = 0.5
"""Most seconds without a look at Ctrl-C."""
APART = 1.0
"""Body lengths between two runs."""


class Page:
    """Runs on one page: they share time and settings, which all tabs share too; the camera is each tab's own.

    Args:
        server: without content.
        stages: of the runs, the first one's times are the page's; the others stand to its left.
    """

    def __init__(self, server: viser.ViserServer, stages: Sequence[Stage]) -> None:
        self.server, self.times = server, stages[0].run.clip.times
        self._rendering = threading.RLock()  # one thread at a time runs kernels and decodes frames
        self._greeting = threading.Lock()
        self._due = threading.Event()
        self._follow: dict[int, viser.GuiCheckboxHandle] = {}
        self._followed: dict[int, int] = {}
        self._compared: tuple[Any, ...] | None = None
        self._pictured: int | None = None
        self.clock, self._seen, self._was_playing = Clock(self.times, stages[0].run.clip.fps), 0, False
        self._furnish(stages)
        offsets = [torch.tensor((APART * OBJECT_DIAGONAL * i, 0, 0), dtype=torch.float64) for i in range(len(stages))]
        labels = [stage.run.name if len(stages) > 1 else "" for stage in stages]
        self.actors = [
            Actor(server, stage, f"/run{i}", offset, label)
            for i, (stage, offset, label) in enumerate(zip(stages, offsets, labels, strict=True))
        ]
        self.held_out = [HeldOut(stage.run) for stage in stages]
        self.controls = Controls(server, stages, self._due.set)
        self._center = torch.stack(offsets).mean(0)
        self._reach = max(stage.reach for stage in stages) + float(self._center.norm())
        self._azimuth = stages[0].azimuth
        self._begin()
        self._answer()

    def serve(self) -> None:
        """Draw whenever something has changed, until Ctrl-C."""
        self.draw()
        while True:
            speed = SPEEDS[self.controls.speed.value]
            pause = max(FASTEST, 1 / (self.actors[0].stage.run.clip.fps * speed))
            if self._due.wait(pause if self.controls.playing else PATIENCE) or self.controls.playing:
                self._due.clear()
                self.draw()

    def draw(self) -> None:
        """Draw what the controls say; what cannot be drawn is a sentence on the panel."""
        moment = self._moment()
        try:
            with self._rendering:
                self._draw(moment)
            self.controls.say("")
        except UserError as error:
            self.controls.say(str(error))

    def _draw(self, moment: int) -> None:
        controls, now = self.controls, self.times[moment]
        with self.server.atomic():
            for actor in self.actors:
                actor.show(now, *controls.chosen(), controls.draw.value)
                actor.show_camera(actor.frame(now), controls.frustum.value)
            if moment != self._pictured:
                controls.image.image = to_bytes(self.actors[0].frame(now).over(1.0))
                controls.clock.content = f"{now - self.times[0]:.2f} s of {self.times[-1] - self.times[0]:.2f} s"
                self._pictured = moment
        self._compare(now)
        for client in self.server.get_clients().values():
            self._lead(client, moment)

    def _lead(self, client: viser.ClientHandle, moment: int) -> None:
        """Move a tab that follows the film's camera, once a moment."""
        follow = self._follow.get(client.client_id)
        if follow is None or not follow.value:
            self._followed.pop(client.client_id, None)
        elif self._followed.get(client.client_id) != moment:
            self._followed[client.client_id] = moment
            self._look(client, "film")

    def _moment(self) -> int:
        """Return the moment to draw, and move the slider of a playing film."""
        controls, now = self.controls, time.monotonic()
        goes_on = controls.playing and self._was_playing and controls.moment.value == self._seen
        self._was_playing = controls.playing
        if goes_on:
            self._seen = self.clock.moment(now, SPEEDS[controls.speed.value])
            controls.moment.value = self._seen
        else:  # it stands, begins, or was moved by hand
            self._seen = int(controls.moment.value)
            self.clock.seek(self._seen, now)
        return self._seen

    def _compare(self, now: float) -> None:
        """Show the chosen held-out view at a time beside our renders, where it is asked for."""
        controls = self.controls
        controls.show_comparison(controls.held.value)
        if not controls.held.value:
            self._compared = None
            return
        names = tuple(map(str, self.held_out[0].views()))
        if controls.view.options != names:
            controls.view.options = names
        if self._compared == (controls.view.value, now):
            return
        self._compared = (controls.view.value, now)
        down = 1 if len(self.held_out) == 1 else 2  # several runs: render and difference side by side
        for held, shown in zip(self.held_out, controls.renders, strict=True):
            frame = held.nearest(int(controls.view.value), now)
            found = frame and compare(held.run, frame)
            if not (frame and found):
                shown.image, shown.label = BLANK, f"{held.run.name}: nobody knows this view's camera"
                continue
            if held is self.held_out[0]:
                controls.truth.image = to_bytes(beside(found.truth))
                controls.truth.label = f"Held-out image, {frame.time - self.times[0]:.2f} s"
            shown.image = to_bytes(torch.cat([beside(found.render), beside(found.difference)], dim=down))
            shown.label = f"{held.run.name}, {found.psnr:.2f} dB: render, difference"

    def _furnish(self, stages: Sequence[Stage]) -> None:
        """Set up the empty room: its up, its ground, the panel beside it."""
        scene, gui = self.server.scene, self.server.gui
        scene.set_up_direction("+y")
        scene.configure_environment_map(None)
        ground = min(stage.ground for stage in stages)
        scene.add_grid(
            "/ground", plane="xz", position=(0.0, ground, 0.0), infinite_grid=True, cell_size=OBJECT_DIAGONAL / 10,
            section_size=OBJECT_DIAGONAL / 2, fade_distance=40.0, cell_color=(225, 225, 225),
            section_color=(200, 200, 200),
        )  # fmt: skip
        gui.main_panel.dock_right()
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(", ".join(dict.fromkeys(stage.run.clip.name for stage in stages)))

    def _begin(self) -> None:
        """Set the camera with which a tab opens and to which it returns; a phone's is set when it is there."""
        look, camera = self._find_look("start", aspect=1.0), self.server.initial_camera
        if look is not None:
            camera.position, camera.look_at, camera.up, camera.fov = look

    def _answer(self) -> None:
        """Answer to tabs that come and go, and to buttons, each for the tab in which it was clicked."""
        controls = self.controls
        controls.sides.on_click(lambda event: self._look(event.client, event.target.value))
        controls.stand.on_click(lambda event: self._look(event.client, "held out"))
        controls.snapshot.on_click(lambda event: save_snapshot(event.client, self._title()))
        controls.film.on_click(lambda event: self._save_film(event.client))
        self.server.on_client_connect(self._greet)
        self.server.on_client_disconnect(lambda client: self._forget(client.client_id))

    def _greet(self, client: viser.ClientHandle) -> None:
        """Give a new tab its camera and its own check box."""
        with self._greeting, self.controls.looking:
            follow = client.gui.add_checkbox("Follow the film's camera", False)
        follow.on_update(lambda _: self._due.set())
        self._follow[client.client_id] = follow
        self._look(client, "start")

    def _forget(self, number: int) -> None:
        self._follow.pop(number, None)
        self._followed.pop(number, None)

    def _look(self, client: viser.ClientHandle | None, side: str) -> None:
        look = None if client is None else self._find_look(side, client.camera.aspect)
        if client is None or look is None:
            return
        with client.atomic():
            client.camera.up_direction = look.up
            client.camera.position = look.position
            client.camera.look_at = look.target
            client.camera.fov = look.fov

    def _find_look(self, side: str, aspect: float) -> Look | None:
        actor, now = self.actors[0], self.times[int(self.controls.moment.value)]
        if side in ("film", "held out"):
            with self._rendering:
                held = side == "held out"
                frame = self.held_out[0].nearest(int(self.controls.view.value), now) if held else actor.frame(now)
                camera = frame and actor.camera(frame)
            return look_through(camera, aspect, actor.offset) if camera else None
        left = math.copysign(math.pi / 2, math.sin(self._azimuth))
        azimuths = {"side": left, "front": 0.0, "back": math.pi, "start": 0.6 * left}
        return look_from(azimuths[side], ELEVATION, self._reach, aspect, self._center)

    def _title(self) -> str:
        """Return a file's name for what is shown, without its ending."""
        run, now = self.actors[0].stage.run, self.times[int(self.controls.moment.value)]
        return "".join(c if c.isalnum() else "-" for c in f"{run.clip.name}-{now - self.times[0]:.2f}s")

    def _save_film(self, client: viser.ClientHandle | None) -> None:
        stages = [actor.stage for actor in self.actors]
        if client is not None:
            save_film(client, stages, *self.controls.chosen(), self._rendering, self._title())
