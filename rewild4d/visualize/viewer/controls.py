"""The panel beside the scene. What stands here is the same in every tab; only a tab's camera is its own."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import viser

from rewild4d.visualize.viewer.comparing import BRIGHTEST
from rewild4d.visualize.viewer.staging import Paint, Shape, Stage

SPEEDS = {"¼ ×": 0.25, "½ ×": 0.5, "1 ×": 1.0, "2 ×": 2.0}
SIDES = ("film", "side", "front", "back")
"""From where a tab looks at a click: the film's camera, or around the animal."""
BLANK = np.full((8, 8, 3), 255, np.uint8)


class Controls:
    """Make the panel's elements, and tell of every change that a person makes.

    Args:
        server: of the page.
        stages: of the runs.
        changed: called after each.

    Attributes:
        moment: slider, index of the moment.
        playing: whether the film plays.
        held: whether a held-out view is compared.
    """

    def __init__(self, server: viser.ViserServer, stages: Sequence[Stage], changed: Callable[[], None]) -> None:
        self._changed, self.playing = changed, False
        gui, times = server.gui, stages[0].run.clip.times
        self.notice = gui.add_markdown("", visible=False)
        self.moment: Any = gui.add_slider("Moment", 0, max(len(times) - 1, 0), 1, 0, disabled=len(times) == 1)
        self.clock = gui.add_markdown("")
        self.play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY, disabled=len(times) == 1)
        self.play.on_click(self._toggle)
        self.speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 ×")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Show"):
            self.shape = gui.add_dropdown("Shape", _all(stage.shapes for stage in stages), hint=SHAPE_HINT)
            self.paint = gui.add_dropdown("Colour", _all(stage.paints for stage in stages), hint=PAINT_HINT)
            self.draw: Any = gui.add_dropdown("Draw as", ("splats", "points"))
            self.frustum = gui.add_checkbox("Film's camera in the scene", False)
        with tabs.add_tab("Look") as self.looking:
            self.sides = gui.add_button_group("Look from", SIDES)
            self.image = gui.add_image(BLANK, label="Input frame")
        with tabs.add_tab("Held out"):
            self._compare(gui, stages)
        with tabs.add_tab("Save"):
            self.snapshot = gui.add_button("Picture of this view (PNG)", icon=viser.Icon.CAMERA)
            self.film = gui.add_button("Film once around (MP4)", icon=viser.Icon.MOVIE)
        for element in (self.moment, self.speed, self.shape, self.paint, self.draw, self.frustum, self.held, self.view):
            element.on_update(self._tell)

    def _compare(self, gui: viser.GuiApi, stages: Sequence[Stage]) -> None:
        count = len(stages[0].run.truth.held_out)
        self.held = gui.add_checkbox("Compare with a held-out view", False, disabled=not count)
        if not count:
            gui.add_markdown("The data set holds no view out.")
        self.view = gui.add_dropdown("View", ("-",), visible=False)
        self.stand = gui.add_button("Look from there", visible=False)
        self.truth = gui.add_image(BLANK, label="Held-out image", visible=False)
        self.renders = [gui.add_image(BLANK, label=stage.run.name, visible=False) for stage in stages]
        self.scale = gui.add_markdown(f"Difference: black is 0, the brightest {BRIGHTEST:g} and more.", visible=False)

    def show_comparison(self, shown: bool) -> None:
        """Show or hide what belongs to the held-out view."""
        elements: list[Any] = [self.view, self.stand, self.truth, self.scale, *self.renders]
        for element in elements:
            element.visible = shown

    def chosen(self) -> tuple[Shape, Paint]:
        """Return what is to be shown, and in which colours."""
        return cast(Shape, self.shape.value), cast(Paint, self.paint.value)

    def say(self, sentence: str) -> None:
        """Show a sentence at the top of the panel, in every tab; "" takes it away."""
        self.notice.content, self.notice.visible = (f"**{sentence}**" if sentence else ""), bool(sentence)

    def show_play(self) -> None:
        """Name the button by what it does next."""
        self.play.label = "Pause" if self.playing else "Play"
        self.play.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY

    def _toggle(self, _: Any) -> None:
        self.playing = not self.playing
        self.show_play()
        self._changed()

    def _tell(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:  # else the page itself has set it
            self._changed()


SHAPE_HINT = (
    "deformed: as the method answers; posed: by the joints alone; canonical: at rest; what a run lacks stays deformed"
)
PAINT_HINT = "parts: by the bone of largest skinning weight"


def _all(choices: Any) -> tuple[str, ...]:
    """Return what any run offers, in order, once each."""
    return tuple(dict.fromkeys(choice for offered in choices for choice in offered))
