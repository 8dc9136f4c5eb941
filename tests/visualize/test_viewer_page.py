"""The page as a browser shows it: time, cameras, reload, a second tab, a lost connection, downloads."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from browser import browser, needs_chromium
from signposts import Signpost, seen_from

from rewild4d.types import Clip, Frame, Splats, Truth
from rewild4d.visualize.pictures import over
from rewild4d.visualize.viewer.page import Page
from rewild4d.visualize.viewer.serving import close_server, open_server
from rewild4d.visualize.viewer.staging import Run, set_stage

pytestmark = [needs_chromium, pytest.mark.usefixtures("one_thread")]
WIDTH, HEIGHT = 780, 400
# The browser's warning of its slow WebGL covers what is looked at.
HIDE = """document.addEventListener("DOMContentLoaded", () => document.head.insertAdjacentHTML("beforeend",
    "<style>.mantine-Notification-root { display: none }</style>"))"""


class Thick(Signpost):
    """The same, each ball of three Gaussians: of few, viser's sorting by depth may leave one out."""

    def at(self, time: float) -> Splats:
        return Splats(*(part.repeat_interleave(3, 0) for part in vars(super().at(time)).values()))


def post_run(name: str, step: float) -> Run:
    """A signpost that walks ahead, seen from its right by a camera that stands still; one view of it is held out."""
    cameras = seen_from((-1.0, 0.2, 0.0), count=5)
    post = Thick(cameras, step)

    def frame(time: float, view: int, camera: Any) -> Frame:
        image = over(post.at(time), camera)
        return Frame(time, camera, image, torch.ones(1, 64, 64), view)

    frames = tuple(frame(time, 0, camera) for time, camera in cameras.items())
    held = [frame(time, 7, camera) for time, camera in seen_from((0.4, 0.3, 1.0), count=5).items()]
    up = torch.tensor((0.0, 1.0, 0.0)).double()
    return Run(name, post, Clip("post/walk", "", frames, 10.0, "", ""), Truth(held, None, "", up=up))


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


@pytest.fixture
def page() -> Iterator[Page]:
    server = open_server("127.0.0.1", 0)
    yield Page(server, [set_stage(post_run("post", 0.3))])
    close_server(server)


def open_tab(chromium: Any, page: Page, **size: int) -> Any:
    """A tab that shows the page as it is drawn."""
    tab = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT, **size})
    tab.add_init_script(HIDE)
    before = {*page.server.get_clients()}
    tab.goto(f"http://127.0.0.1:{page.server.get_port()}/")
    until(tab, page, lambda: bool({*page.server.get_clients()} - before))
    until(tab, page, lambda: place(tab, 0) is not None)
    return tab


def until(tab: Any, page: Page, holds: Callable[[], bool], draws: bool = True) -> None:
    """Let the page draw and the browser work until something holds."""
    end = time.monotonic() + 90
    while time.monotonic() < end:
        if draws:
            page.draw()
        if holds():
            return
        tab.wait_for_timeout(200)
    raise AssertionError("it does not come")


def place(tab: Any, channel: int, image: np.ndarray | None = None) -> tuple[float, float] | None:
    """Column and row of the middle of the red (0), green (1) or blue (2) ball in the scene, or None."""
    shown = imageio.imread(BytesIO(tab.screenshot())) if image is None else image
    pixels = shown[:, : WIDTH - 320, :3].astype(int)
    rows, columns = np.nonzero((pixels[..., channel] > 150) & (np.delete(pixels, channel, 2).max(2) < 100))
    return (columns.mean(), rows.mean()) if len(rows) > 20 else None


def settled(tab: Any, page: Page) -> np.ndarray:
    """Places of the three balls once they no longer move."""
    before, end = None, time.monotonic() + 90
    while time.monotonic() < end:
        page.draw()
        found = [place(tab, channel) for channel in range(3)]
        if None not in found and found == before:
            return np.array(found)
        before = found
        tab.wait_for_timeout(600)
    raise AssertionError("it does not settle")


def test_the_slider_moves_time_and_a_reload_and_a_lost_connection_keep_it(chromium: Any, page: Page) -> None:
    tab = open_tab(chromium, page)
    red, green, blue = before = settled(tab, page)
    assert green[1] < min(red[1], blue[1]), "upright"
    assert red[0] > blue[0] + 20, "from its right, it looks to the right"
    thumb = tab.get_by_role("slider").first.bounding_box()
    tab.mouse.move(thumb["x"] + thumb["width"] / 2, thumb["y"] + thumb["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(thumb["x"] + 250, thumb["y"] + thumb["height"] / 2, steps=5)
    tab.mouse.up()
    until(tab, page, lambda: page.controls.moment.value == 4, draws=False)  # no moment between is shown
    page.draw()
    assert page.controls.clock.content == "4.00 s of 4.00 s"
    until(tab, page, lambda: place(tab, 1) != tuple(before[1]))
    moved = settled(tab, page)
    assert (moved[:, 0] > before[:, 0] + 15).all(), "all walk ahead"
    for lose in (tab.reload, page.server._websock_server.disconnect_all_clients):
        gone = {*page.server.get_clients()}
        lose()
        until(tab, page, lambda gone=gone: bool({*page.server.get_clients()} - gone))  # type: ignore[misc]
        until(tab, page, lambda: bool(np.abs(np.subtract(place(tab, 1) or (0, 0), moved[1])).max() < 2))
        np.testing.assert_allclose(settled(tab, page), moved, atol=3)
        assert page.controls.moment.value == 4
    tab.close()


def test_two_tabs_share_the_time_and_each_has_its_camera(chromium: Any, page: Page) -> None:
    first, second = open_tab(chromium, page), open_tab(chromium, page)
    before = settled(first, page)
    second.get_by_role("tab", name="Look").click()
    second.get_by_role("button", name="front", exact=True).click()
    until(second, page, lambda: place(second, 1) != tuple(before[1]))
    seen = settled(second, page)
    assert seen[2][0] > seen[1][0] + 10, "facing us, its left is on our right"
    np.testing.assert_allclose(settled(first, page), before, atol=1)
    second.get_by_label("Follow the film's camera").check()
    until(second, page, lambda: bool(page._followed))
    assert len(page._followed) == 1
    first.get_by_role("button", name="Play").click()
    until(first, page, lambda: page.controls.playing)
    until(first, page, lambda: page.controls.moment.value >= 2)
    second.get_by_role("button", name="Pause").click()
    until(second, page, lambda: not page.controls.playing)
    number = str(page.controls.moment.value)
    for tab in (first, second):
        until(tab, page, lambda tab=tab: tab.get_by_role("textbox").first.input_value() == number)  # type: ignore[misc]
    first.close(), second.close()
    until_closed = chromium.new_page()
    until(until_closed, page, lambda: not page.server.get_clients() and not page._follow)
    until_closed.close()


def test_the_films_camera_shows_what_our_rasterizer_renders(chromium: Any, page: Page) -> None:
    tab = open_tab(chromium, page)
    tab.get_by_role("tab", name="Look").click()
    before = settled(tab, page)
    tab.get_by_role("button", name="film", exact=True).click()
    until(tab, page, lambda: place(tab, 1) != tuple(before[1]))
    settled(tab, page)
    with tab.expect_download(timeout=90_000) as saved:
        tab.get_by_role("tab", name="Save").click()
        tab.get_by_role("button", name="Picture of this view").click()
    drawn = imageio.imread(saved.value.path()).astype(float)
    assert saved.value.suggested_filename == "post-walk-0-00s.png"
    height, width = drawn.shape[:2]
    camera = page.actors[0].stage.run.clip.frames[0].camera
    assert camera is not None and width < WIDTH and height == HEIGHT
    scale = min(height, width) / 64
    side = camera.resized(round(64 * scale), round(64 * scale)).shifted(
        (64 * scale - width) / 2, (64 * scale - height) / 2, width, height
    )
    ours = over(page.actors[0].stage.run.reconstruction.at(0.0), side).permute(1, 2, 0).numpy() * 255
    body = ours.max(2) - ours.min(2) > 220  # the browser cuts off their faint rims
    assert body.sum() > 200 and np.abs(drawn[..., :3] - ours)[body].mean() < 10
    for channel in (0, 1):  # the grey ball is before the blue one
        np.testing.assert_allclose(place(tab, channel, drawn), place(tab, channel, ours), atol=2)
    tab.close()


def test_shapes_colours_held_out_views_and_films_of_two_runs(chromium: Any, tmp_path: Path) -> None:
    server = open_server("127.0.0.1", 0)
    try:
        worse = replace(post_run("worse", 0.0), truth=post_run("", 0.3).truth)
        page = Page(server, [set_stage(post_run("post", 0.3)), set_stage(worse)])
        tab = open_tab(chromium, page, height=900)
        reds = imageio.imread(BytesIO(tab.screenshot()))
        assert page.actors[1].offset[0] == 5 and (reds[..., 0] > 150).any()
        page.controls.moment.value = 3
        tab.get_by_role("tab", name="Held out").click()
        tab.get_by_label("Compare with a held-out view").check()
        until(tab, page, lambda: page.controls.held.value and page.controls.view.options == ("7",))
        until(tab, page, lambda: page.controls.truth.label == "Held-out image, 3.00 s")
        figures = [float(shown.label.split(", ")[1].split()[0]) for shown in page.controls.renders]
        assert figures[0] > 90 and 5 < figures[1] < 40, page.controls.renders[1].label
        page.controls.draw.value = "points"
        until(tab, page, lambda: page.actors[0]._points.visible and not page.actors[0]._splats.visible)
        page.controls.frustum.value = True
        page.draw()
        assert page.actors[0]._frustum is not None and page.actors[0]._frustum.visible
        tab.get_by_role("tab", name="Save").click()
        with tab.expect_download(timeout=90_000) as saved:
            tab.get_by_role("button", name="Film once around").click()
        film = list(iter(imageio.get_reader(saved.value.path(), "mp4").iter_data()))
        assert len(film) == 72 and film[0].shape == (320, 640, 3) and film[0].min() < 100 < film[0].max()
        tab.close()
    finally:
        close_server(server)


def test_a_phone_shows_the_animal_above_the_panel_and_nothing_is_fetched_from_elsewhere(
    chromium: Any, page: Page
) -> None:
    tab = chromium.new_page(viewport={"width": 390, "height": 844})
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(f"http://127.0.0.1:{page.server.get_port()}/")
    until(tab, page, lambda: place(tab, 1) is not None)
    tab.wait_for_timeout(1000)
    spot = place(tab, 1)
    assert spot is not None and spot[1] < 844 / 2 and tab.get_by_role("button", name="Play").is_visible()
    here = f"http://127.0.0.1:{page.server.get_port()}/"
    assert asked and all(url.startswith((here, "data:", "blob:")) for url in asked)
    assert page.server.request_share_url() is None
    tab.close()
