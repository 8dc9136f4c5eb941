"""The editor's page in Chromium: mouse, keys, fingers, reload, a second tab, a lost connection."""

import io
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import moving
import numpy as np
import pytest
from browser import browser, needs_chromium
from editing import BOX, COUNT, SIZE, Served, served, stub_network
from films import iou
from PIL import Image

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


@pytest.fixture
def editor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    stub_network(monkeypatch)
    with served(tmp_path / "masks") as found:
        yield found


class Tab:
    """A page with the editor, whose faults fail the test."""

    def __init__(self, chromium: Any, editor: Served, size: tuple[int, int] = (1280, 800), **kind: Any) -> None:
        self.context = chromium.new_context(viewport={"width": size[0], "height": size[1]}, **kind)
        self.page = self.context.new_page()
        self.page.set_default_timeout(20_000)
        self.fingers = self.context.new_cdp_session(self.page)
        self.faults: list[str] = []
        self.expected: tuple[str, ...] = ()  # words of faults that a test provokes
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", lambda said: said.type == "error" and self.faults.append(said.text))
        self.page.goto(editor.address)
        self.editor = editor
        self.shown()

    def shown(self) -> None:
        """Wait until what the editor has is on the screen."""
        self.until(f"at.version >= {self.editor.state()['version']} && at.waiting === '0'")
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def until(self, condition: str) -> None:
        """Wait for a condition in JavaScript, in which ``at`` is what the page tells tests and text(id) an element's.

        Playwright's own way evaluates text in the page, which its policy forbids.
        """
        wanted = "(() => { const at = document.body.dataset, text = (id) => document.getElementById(id).textContent; "
        wanted += f"return {condition} }})()"
        end = time.monotonic() + 20
        while not self.page.evaluate(wanted):
            assert time.monotonic() < end, f"not in 20 s: {condition}"
            self.page.wait_for_timeout(20)

    def until_step(self, which: str, title: str) -> None:
        """Wait until a step can be undone or redone."""
        self.until(f"document.getElementById('{which}').title.toLowerCase().startsWith('{which}: {title}')")

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a pixel of the frame lies on the page, while the whole frame is shown."""
        at = self.page.locator("#canvas").bounding_box()
        scale = min(at["width"] / SIZE[0], at["height"] / SIZE[1])
        left, top = (at["width"] - SIZE[0] * scale) / 2, (at["height"] - SIZE[1] * scale) / 2
        return at["x"] + left + x * scale, at["y"] + top + y * scale

    def drag(self, *points: tuple[float, float]) -> None:
        """Draw along pixels of the frame."""
        self.page.mouse.move(*self.place(*points[0]))
        self.page.mouse.down()
        for point in points[1:]:
            self.page.mouse.move(*self.place(*point), steps=4)
        self.page.mouse.up()
        self.until("at.waiting === '0'")
        self.shown()

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)
        self.shown()

    def color(self, x: float, y: float) -> np.ndarray:
        """The colour of a pixel of the frame on the screen."""
        self.page.mouse.move(2, 2)
        self.shown()
        image = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        across, down = self.place(x, y)
        ratio = image.width / self.page.viewport_size["width"]
        return np.asarray(image)[int(down * ratio), int(across * ratio)].astype(int)

    def close(self) -> None:
        self.context.close()
        assert not [fault for fault in self.faults if not any(word in fault for word in self.expected)]


@pytest.fixture
def tab(chromium: Any, editor: Served) -> Iterator[Tab]:
    opened = Tab(chromium, editor)
    yield opened
    opened.close()


def follow(tab: Tab, key: str = "p") -> None:
    """Press a key that follows the animal, and wait until it is through."""
    tab.page.keyboard.press(key)
    tab.until("text('notice-text').startsWith('Followed through')")
    tab.shown()


def test_a_box_and_p_give_masks_that_are_seen_kept_and_saved(tab: Tab, editor: Served, tmp_path: Path) -> None:
    assert tab.page.locator("#badge").inner_text().split("\n") == ["frame 100", "no mask yet"]
    plain = tab.color(40, 60)
    tab.press("b")
    tab.drag((8, 40), (72, 96))
    assert editor.state()["boxes"]["0"] == pytest.approx(BOX, abs=1)
    follow(tab)
    for place in (0, COUNT - 1):
        assert iou(editor.mask(place), moving.mask(place, SIZE) > 0) > 0.9
    tinted = tab.color(40, 60)
    assert tinted[2] > plain[2] + 40, "the mask is blue on the animal"
    assert np.abs(tab.color(150, 20) - np.array((25, 105, 38))).max() < 35, "and nowhere else"
    tab.press("ArrowRight", "ArrowRight")
    assert tab.page.locator("#frame-is").inner_text() == "102"
    tab.page.keyboard.press("Control+s")
    tab.page.wait_for_selector("#notice.saved")
    assert tab.page.locator("#notice-code").inner_text() == f"rewild4d-bench check --masks {tmp_path}/masks"
    assert tab.page.locator("#saved").inner_text() == "saved"
    assert len(list((tmp_path / "masks").iterdir())) == COUNT
    tab.page.reload()
    tab.shown()
    assert tab.page.locator("#frame-is").inner_text() == "102", "a reload looks at the same frame"
    assert tab.color(44, 60)[2] > plain[2] + 40


def test_a_stroke_changes_the_overlay_undo_takes_it_back_and_a_second_tab_sees_it(
    tab: Tab, editor: Served, chromium: Any
) -> None:
    other = Tab(chromium, editor)
    plain = tab.color(40, 56)
    tab.press("a")
    tab.drag((30, 60), (50, 60))
    stroke = tab.color(40, 60)
    assert stroke[1] > stroke[0] + 60, "the stroke is green"
    assert tab.color(40, 56)[2] > plain[2] + 40, "the mask around it blue"
    other.until_step("undo", "stroke in frame 100")
    assert (other.color(40, 60) == stroke).all()
    tab.page.keyboard.press("Control+z")
    tab.until_step("redo", "stroke")
    assert np.abs(tab.color(40, 56) - plain).max() <= 2 and np.abs(tab.color(40, 60) - plain).max() < 30
    tab.page.keyboard.press("Control+Shift+Z")
    tab.until_step("undo", "stroke")
    assert (tab.color(40, 60) == stroke).all()
    tab.press("s")
    tab.drag((40, 75), (40, 90))
    red = tab.color(40, 82)
    assert red[0] > red[1] + 60
    tab.press("e")
    tab.drag((40, 70), (40, 95))
    erased = tab.color(40, 90)
    assert not erased[0] > erased[1] + 60
    other.close()


def test_strokes_are_kept_while_the_connection_is_lost(tab: Tab, editor: Served) -> None:
    tab.press("a")
    tab.expected = ("ERR_INTERNET_DISCONNECTED",)
    tab.context.set_offline(True)
    tab.page.mouse.move(*tab.place(30, 60))
    tab.page.mouse.down()
    tab.page.mouse.move(*tab.place(50, 60), steps=4)
    tab.page.mouse.up()
    tab.page.wait_for_selector("#offline:not([hidden])")
    tab.until("text('offline').includes('1 drawing waits here')")
    assert editor.state()["frames"][0][1] == ""
    tab.context.set_offline(False)
    tab.page.wait_for_selector("#offline", state="hidden")
    tab.until("at.waiting === '0'")
    assert editor.state()["frames"][0][1] == "strokes"


def test_a_tab_that_lags_behind_is_told_and_shows_the_newest_state(tab: Tab, editor: Served) -> None:
    tab.press("a")
    tab.drag((30, 60), (50, 60))
    tab.expected = ("ERR_FAILED", "409")
    tab.page.route("**/state?*", lambda route: route.abort())  # it learns nothing more by itself
    editor.do(kind="box", id="other", place=0, box=BOX)
    tab.page.keyboard.press("Control+z")
    tab.page.wait_for_selector("#notice.bad")
    assert "not up to date" in tab.page.locator("#notice-text").inner_text()
    assert tab.page.locator("#undo").get_attribute("title") == "Undo: box in frame 100 (ctrl+z)"
    assert editor.state()["boxes"] and editor.state()["frames"][0][1] == "strokes", "nothing was taken back unseen"


def test_keys_choose_tools_sizes_and_frames(tab: Tab) -> None:
    chosen = tab.page.locator('[data-tool][aria-checked="true"]')
    for key, tool in (("a", "animal"), ("s", "surroundings"), ("e", "eraser"), ("h", "hand"), ("b", "box")):
        tab.page.keyboard.press(key)
        assert chosen.get_attribute("data-tool") == tool
    before = tab.page.locator("#size").input_value()
    tab.page.keyboard.press("]")
    assert int(tab.page.locator("#size").input_value()) > int(before)
    tab.page.keyboard.press("[")
    assert tab.page.locator("#size").input_value() == before
    frame = tab.page.locator("#frame-is")
    for key, name in (
        ("ArrowRight", "101"),
        ("Shift+ArrowRight", "107"),
        ("ArrowLeft", "106"),
        ("Home", "100"),
        ("End", "107"),
    ):
        tab.page.keyboard.press(key)
        assert frame.inner_text() == name
    tab.page.keyboard.press("Home")
    tab.page.keyboard.press(" ")
    tab.until("text('frame-is') > 101")
    tab.page.keyboard.press(" ")
    tab.page.keyboard.press("?")
    assert tab.page.locator("#help-box").is_visible()
    tab.page.keyboard.press("Escape")
    assert not tab.page.locator("#help-box").is_visible()


def test_zoom_keeps_the_pixel_under_the_mouse_and_strokes_fall_where_they_are_drawn(tab: Tab, editor: Served) -> None:
    tab.press("a", "[", "[", "[", "[", "[", "[")
    point = tab.place(100, 30)
    tab.page.mouse.move(*point)
    for _ in range(6):
        tab.page.mouse.wheel(0, -200)
    tab.page.mouse.down()
    tab.page.mouse.up()
    tab.until_step("undo", "stroke")
    said = editor.editor.work.marks(0)
    rows, columns = np.nonzero(said)
    assert abs(rows.mean() + 0.5 - 30) < 1 and abs(columns.mean() + 0.5 - 100) < 1


def test_done_asks_before_work_is_lost_and_ends_the_editor(tab: Tab, editor: Served, tmp_path: Path) -> None:
    tab.press("a")
    tab.drag((30, 60), (50, 60))
    tab.page.click("#done")
    tab.page.get_by_text("Go on", exact=True).click()
    assert not editor.editor.ended.is_set()
    tab.page.click("#done")
    tab.page.get_by_text("Save and end").click()
    tab.page.wait_for_selector("#ended:not([hidden])")
    assert editor.editor.ended.is_set() and len(list((tmp_path / "masks").iterdir())) == COUNT


def touch(tab: Tab, kind: str, *points: tuple[float, float]) -> None:
    """Send fingers as a phone does."""
    fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    tab.fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})


def test_on_a_phone_one_finger_draws_two_zoom_and_buttons_are_large(chromium: Any, editor: Served) -> None:
    tab = Tab(chromium, editor, (390, 844), has_touch=True, is_mobile=True, device_scale_factor=2)
    for button in tab.page.locator("button:visible").all():
        at = button.bounding_box()
        assert at["width"] >= 44 and at["height"] >= 44, button.inner_text()
        assert at["x"] >= 0 and at["x"] + at["width"] <= 390 and at["y"] + at["height"] <= 844
    tab.page.locator('[data-tool="animal"]').tap()
    touch(tab, "touchStart", tab.place(30, 60))
    for x in (35, 40, 45, 50):
        touch(tab, "touchMove", tab.place(x, 60))
    touch(tab, "touchEnd")
    tab.until_step("undo", "stroke")
    tab.shown()
    assert (editor.editor.work.marks(0)[60, 32:48] == 1).all()
    stroke = tab.color(40, 60)
    assert stroke[1] > stroke[0] + 60
    version = editor.state()["version"]
    one, two = tab.place(60, 64), tab.place(130, 64)
    touch(tab, "touchStart", one)
    touch(tab, "touchStart", one, two)
    touch(tab, "touchMove", (one[0] - 60, one[1]), (two[0] + 60, two[1]))
    touch(tab, "touchEnd")
    assert tab.color(100, 20)[0] != 0 and editor.state()["version"] == version, "two fingers draw nothing"
    assert float(tab.page.locator("body").get_attribute("data-scale")) > 1.4 * 390 / SIZE[0]
    tab.page.locator("#track").tap()
    tab.until("text('notice-text').startsWith('Followed through')")
    assert all(mask == "mask" for _, _, mask in editor.state()["frames"])
    tab.close()
