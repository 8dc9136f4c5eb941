"""The page of a run, in a browser: it opens from disk, decodes what was packed and draws what the rasterizer draws."""

import base64
import hashlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from browser import browser, needs_chromium
from calling import call, refusal
from media_files import picture
from PIL import Image
from records_for_tests import PROTOCOL, psnr, record
from swarm import HEIGHT, MOMENTS, WIDTH, Colors, Growing, Swarm, film

from rewild4d.baselines.empty import EmptyReconstruction
from rewild4d.leaderboard.records import RunRecord, write_record
from rewild4d.types import Camera, Splats
from rewild4d.visualize.pictures import over
from rewild4d.visualize.report.layout import unpack
from rewild4d.visualize.report.page import write_report
from rewild4d.visualize.report.scene import Scene, make_scene

UP = torch.tensor((0.0, 1.0, 0.0))
SLOWLY = 60_000
"""Milliseconds: WebGL on a busy CPU."""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


def scene_of(swarm: Swarm, most: int = 100) -> Scene:
    made = make_scene(swarm, film(), UP, most)
    assert made is not None
    return made


def written(folder: Path, swarm: Swarm, **changes: Any) -> Path:
    """The page of a run whose reconstruction is a swarm."""
    write_report(record(**changes), folder, folder / "report.html", scene_of(swarm))
    return folder / "report.html"


def opened(chromium: Any, page: Path, **options: Any) -> tuple[Any, list[str]]:
    """A page whose player is ready and stands still, and what it complained of."""
    said: list[str] = []
    shown = chromium.new_page(reduced_motion="reduce", **{"viewport": {"width": 1280, "height": 800}, **options})
    shown.on("console", lambda message: said.append(message.text))
    shown.on("pageerror", lambda error: said.append(str(error)))
    shown.goto(page.as_uri())
    shown.locator("html[data-player]").wait_for(state="attached", timeout=SLOWLY)
    return shown, said


def pixels(address: str) -> np.ndarray:
    """RGB of a data address in [0, 1], [h, w, 3]."""
    data = base64.b64decode(address.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255


DRAWN = """async moment => {
  const { player } = rewild4d;
  await player.seek(moment);
  player.renderer.render(player.scene, player.shot);
  return player.canvas.toDataURL();
}"""


def off(drawn: np.ndarray, splats: Splats, camera: Camera) -> tuple[float, float]:
    """Mean difference to the rasterizer's picture, and to its mirror image."""
    height, width = drawn.shape[:2]
    true = over(splats, camera.resized(width, height)).permute(1, 2, 0).numpy()
    return float(np.abs(drawn - true).mean()), float(np.abs(drawn[:, ::-1] - true).mean())


@needs_chromium
@pytest.mark.parametrize("colors", ["rgb", "world", "own"])
def test_the_player_draws_what_the_rasterizer_draws_from_the_films_camera(
    chromium: Any, tmp_path: Path, colors: Colors
) -> None:
    swarm = Swarm(colors)
    page, said = opened(chromium, written(tmp_path, swarm))
    for moment, frame in enumerate(film().frames):
        camera = swarm.camera(frame.time)
        assert camera is not None
        drawn = pixels(page.evaluate(DRAWN, moment))
        assert drawn.shape[1] / drawn.shape[0] == pytest.approx(WIDTH / HEIGHT, abs=0.01)
        difference, mirrored = off(drawn, swarm.at(frame.time), camera)
        assert difference < 0.004 < 0.04 < mirrored, moment
    assert said == []


@needs_chromium
def test_pictures_of_a_playing_film_are_in_their_order_of_depth(chromium: Any, tmp_path: Path) -> None:
    """Discs change places between moments: a picture in an older order would show the wrong one before the other."""
    swarm = Swarm()
    page, _ = opened(chromium, written(tmp_path, swarm))
    page.evaluate("""() => {
      const { player } = rewild4d, before = player.drawn;
      globalThis.pictures = [];
      player.drawn = moment => { before(moment); pictures.push([moment, player.canvas.toDataURL(), film.src]); };
    }""")
    page.select_option("#speed", "0.1")
    page.click("#play")
    page.wait_for_timeout(8000)
    page.click("#play")
    found = page.evaluate("pictures")
    assert len({moment for moment, *_ in found}) >= 4
    for moment, drawn, frame in found:
        camera = swarm.camera(moment / 24)
        assert camera is not None
        assert off(pixels(drawn), swarm.at(moment / 24), camera)[0] < 0.004, moment
        assert pixels(frame).mean() == pytest.approx(moment / (MOMENTS - 1), abs=0.02), "the film is in step"


@needs_chromium
def test_gaussians_that_come_and_go_are_drawn_while_they_are_there(chromium: Any, tmp_path: Path) -> None:
    swarm = Growing()
    page, said = opened(chromium, written(tmp_path, swarm))
    for moment in (0, 4, 5, 1):
        camera = swarm.camera(moment / 24)
        assert camera is not None
        drawn = pixels(page.evaluate(DRAWN, moment))
        assert off(drawn, swarm.at(moment / 24), camera)[0] < 0.004, moment
        assert (drawn.min() == 1) == (moment == 5)
    assert said == []


@needs_chromium
@pytest.mark.parametrize("colors", ["rgb", "own", "changing"])
def test_the_page_decodes_what_python_decodes(chromium: Any, tmp_path: Path, colors: Colors) -> None:
    page, _ = opened(chromium, written(tmp_path, Swarm(colors)))
    clouds = page.evaluate("""() => rewild4d.clouds.map(({ count, moments, frame, tracks }) => ({
      count, moments, frame, tracks: Object.entries(tracks).map(([name, { moments, low, step, codes }]) =>
        [name, moments, Array.from(codes, (code, i) => {
          const k = Math.floor(i / count) % low.length;
          return low[k] + code * step[k];
        })]),
    }))""")
    wanted = unpack(scene_of(Swarm(colors)).splats)
    assert [(c["count"], c["moments"], c["frame"]) for c in clouds] == [(len(c), c.moments, c.frame) for c in wanted]
    for cloud, true in zip(clouds, wanted, strict=True):
        for name, moments, values in cloud["tracks"]:
            values = np.reshape(values, (moments, -1, len(true))).transpose(0, 2, 1)
            np.testing.assert_allclose(values, true.tracks[name], atol=1e-9, err_msg=name)


@needs_chromium
def test_the_page_asks_for_nothing_and_runs_no_other_script(chromium: Any, tmp_path: Path) -> None:
    page = written(tmp_path, Swarm())
    asked: list[str] = []
    context = chromium.new_context(reduced_motion="reduce")
    shown = context.new_page()
    shown.on("request", lambda request: asked.append(request.url.partition(",")[0][:80]))
    code = "<script>document.title = 'ran'</script><img src='data:,' onerror=\"document.title = 'ran'\">"
    page.write_text(page.read_text().replace("<h2>Scores", f"{code}<h2>Scores"))
    shown.goto(page.as_uri())
    shown.locator("html[data-player=ready]").wait_for(state="attached", timeout=SLOWLY)
    assert shown.title() == "ours on wolf/Run"
    assert {url for url in asked if not url.startswith(("data:", "blob:"))} == {page.as_uri()[:80]}


@needs_chromium
def test_the_controls_do_what_they_say_on_a_phone(chromium: Any, tmp_path: Path) -> None:
    page, said = opened(chromium, written(tmp_path, Swarm()), viewport={"width": 390, "height": 844}, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390

    def pressed(name: str) -> bool:
        return page.get_attribute(name, "aria-pressed") == "true"

    first = page.evaluate(DRAWN, 0)
    assert pressed("#film-camera") and not pressed("#turntable")
    page.click("#turntable")
    page.wait_for_timeout(1000)
    assert pressed("#turntable") and not pressed("#film-camera")
    page.click("#film-camera")
    assert pressed("#film-camera") and not pressed("#turntable")
    assert page.evaluate(DRAWN, 0) == first
    page.locator("#time").fill("2")
    page.wait_for_timeout(1000)
    assert page.text_content("#clock") == f"{2 / 24:.2f} s, 3 of {MOMENTS}"
    page.locator("#view").scroll_into_view_if_needed()
    box = page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 180, box["y"] + 120, steps=4)
    page.mouse.up()
    page.wait_for_timeout(1000)
    assert not pressed("#film-camera")
    assert np.abs(pixels(page.evaluate(DRAWN, 0)) - pixels(first)).mean() > 0.01
    assert said == []


@needs_chromium
def test_without_cameras_the_player_looks_from_a_side(chromium: Any, tmp_path: Path) -> None:
    page, said = opened(chromium, written(tmp_path, Swarm(film=False)))
    drawn = pixels(page.evaluate(DRAWN, 0))
    assert page.is_disabled("#film-camera") and page.get_by_text("The film's cameras are not known.").is_visible()
    edge = np.concatenate((drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]))
    assert drawn.mean() < 0.99 < edge.mean() and said == [], "the cloud is in the picture, with white around it"


@needs_chromium
def test_a_browser_without_webgl_says_so(chromium: Any, tmp_path: Path) -> None:
    page = written(tmp_path, Swarm())
    shown = chromium.new_page()
    shown.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    shown.goto(page.as_uri())
    shown.locator("html[data-player=failed]").wait_for(state="attached", timeout=SLOWLY)
    assert shown.get_by_text("The player does not run in this browser").is_visible()
    assert shown.get_by_text("Where it comes from").is_visible()


def test_a_long_film_is_shown_at_evenly_spaced_moments() -> None:
    assert scene_of(Swarm(), 3).facts["times"] == pytest.approx([0, 2 / 24, 5 / 24])
    assert len(scene_of(Swarm(), 1).facts["film"]) == 1


def test_without_gaussians_there_is_no_scene() -> None:
    assert make_scene(EmptyReconstruction(), film(), UP, 100) is None


def test_a_failed_run_has_a_page_without_player_and_script(tmp_path: Path) -> None:
    nasty = "<script>alert(1)</script></script>"
    made = record(status="failed", error=nasty, case=nasty, scores={}, marks=[nasty], prior={"provenance": nasty})
    assert call("report", write_record(made, tmp_path).parent) == 0
    text = (tmp_path / "report.html").read_text()
    assert "<script" not in text and "<canvas" not in text and "No player: the run failed before there was one." in text
    assert "Failed: &lt;script&gt;alert(1)" in text
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy.startswith("default-src 'none'; img-src data:;") and "script-src" not in policy


def test_the_policy_names_the_only_script_and_what_a_record_says_is_text(tmp_path: Path) -> None:
    nasty = "</script><script>alert(1)</script>"
    text = written(tmp_path, Swarm(), case=nasty, scores=psnr(None, nasty), config={nasty: nasty}).read_text()
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    for name in ("style", "script"):
        (body,) = re.findall(f"<{name}>(.*?)</{name}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        allowed = " 'wasm-unsafe-eval'" if name == "script" else ""
        assert rules[f"{name}-src"] == f"'sha256-{digest}'{allowed}"
    assert rules["default-src"] == "'none'" and rules["worker-src"] == "blob:" and rules["img-src"] == "data:"
    assert "connect-src" not in rules
    head = text.partition("<script>")[0]
    assert "alert(1)" in head and "<script>alert" not in text
    assert not re.search(r"<[^>]+\s(on\w+|style)=", head), "no handler and no style that the policy would refuse"


def test_scores_say_why_they_are_not_there_and_facts_what_the_record_knows(tmp_path: Path) -> None:
    page = written(
        tmp_path, Swarm(), scores=psnr(None, "no held-out frame"), marks=["upper bound: made from the truth"],
        prior={"name": "template", "quality": {"mask_iou": 0.8125}, "left_out": [3, 4]},
        data={"root": "/home/somebody/data", "licence": "CC BY 4.0"}, machine={"processor": "a CPU", "torch": "2.9"},
    )  # fmt: skip
    text = page.read_text()
    for said in (
        "not computed", "no held-out frame", "upper bound: made from the truth", "0.812", "CC BY 4.0", "a CPU",
        "2: the prior does not know their cameras", "270; 30 more are invisible", "three 0.1", "MIT",
    ):  # fmt: skip
        assert said in text, said
    assert "somebody" not in text, "a page is handed on: no user names"


def test_pictures_of_the_run_are_in_the_page_and_what_is_none_is_left_out(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    picture(run / "comparison.png")
    (run / "orbit.png").write_bytes(b"<script>")
    (tmp_path / "private.png").write_bytes((run / "comparison.png").read_bytes())
    (run / "canonical.png").symlink_to(tmp_path / "private.png")
    made = record(
        pictures=["orbit.png", "comparison.png", "canonical.png", "../private.png", "absent.png", "input.mp4"]
    )
    left = write_report(made, run, run / "report.html", None, "why not.")
    assert [re.sub(r".*/(\w+\.png):.*", r"\1", sentence) for sentence in left] == ["canonical.png", "orbit.png"]
    (image,) = re.findall(r'<img src="(data:image/jpeg;base64,[^"]*)"', (run / "report.html").read_text())
    assert pixels(image).shape == (6, 8, 3)


def test_an_older_page_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("older")
    made = record(status="failed", error="out of memory")
    assert call("report", write_record(made, tmp_path).parent) == 0
    assert "out of memory" in (tmp_path / "report.html").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["record.json", "report.html"]


def test_what_cannot_be_opened_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"{tmp_path}/record.json: expected a run record" in refusal(capsys, "report", tmp_path)
    run = write_record(record(), tmp_path / "run")
    assert "--moments: expected a number of at least 1" in refusal(capsys, "report", run.parent, "--moments", 0)
    assert "but it is a folder" in refusal(capsys, "report", run.parent, "--out", tmp_path)
    (run.parent / "reconstruction").mkdir()
    write_record(record(protocol={**PROTOCOL, "name": "artemis-sweep-256-v4"}), run.parent)
    assert "expected a record that names the folder of its data" in refusal(capsys, "report", run.parent)
    assert sorted(path.name for path in run.parent.iterdir()) == ["reconstruction", "record.json"]


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    made = record(status="failed", error="e")
    write_record(made, tmp_path)
    assert call("report", tmp_path, "--out", tmp_path / "elsewhere" / "page.html") == 0
    assert (tmp_path / "elsewhere" / "page.html").is_file() and not (tmp_path / "report.html").exists()
    assert msgspec.json.decode((tmp_path / "record.json").read_bytes(), type=RunRecord) == made
