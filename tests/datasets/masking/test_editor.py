"""The editor of masks without a browser: what it keeps, what undo takes back, files, following in the background."""

import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import moving
import numpy as np
import pytest
from calling import output
from editing import BOX, COUNT, SIZE, Served, film, served, stub_network, walking
from films import iou
from PIL import Image

from rewild4d.datasets.masking.editor.drawing import drawn, mask_of
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.marks import read_marks
from rewild4d.errors import UserError


@pytest.fixture
def editor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    stub_network(monkeypatch)
    with served(tmp_path / "masks") as found:
        yield found


def stroke(number: int = 0, place: int = 0, tool: str = "animal", **more: object) -> dict[str, object]:
    points = [[30.0 + number, 60.0], [50.0 + number, 60.0]]
    return {"kind": "stroke", "id": f"s{number}", "place": place, "tool": tool, "radius": 4.0, "points": points} | more


def box(place: int = 0, value: tuple[float, ...] | None = BOX, name: str = "b") -> dict[str, object]:
    return {"kind": "box", "id": name, "place": place, "box": value}


def wait(editor: Served, seconds: float = 30) -> dict[str, object]:
    """Wait until nothing is followed, and return the state."""
    end = time.monotonic() + seconds
    while (state := editor.state())["job"] is not None:
        assert time.monotonic() < end, "it still follows"
        time.sleep(0.02)
    return state


def test_a_box_and_following_make_masks_of_all_frames_and_one_undo_takes_them_back(editor: Served) -> None:
    assert editor.do(**box())[0] == 200
    assert iou(editor.mask(0), moving.mask(0, SIZE) > 0) > 0.9, "the frame's own mask is there at once"
    status, answer = editor.decide("track")
    assert status == 200 and answer["state"]["undo"] == "box in frame 100"
    state = wait(editor)
    assert state["notice"][1:] == ["good", f"Followed through {COUNT} frames, 0 of them without the animal."]
    for place in range(COUNT):
        assert iou(editor.mask(place), moving.mask(place, SIZE) > 0) > 0.9, place
    assert [mask for _, _, mask in state["frames"]] == ["mask"] * COUNT
    assert editor.decide("undo")[1]["state"]["undo"] == "box in frame 100"
    assert not editor.mask(3).any() and editor.state()["frames"][3][2] == ""
    assert editor.decide("redo")[1]["state"]["undo"] == "propagation"
    assert editor.mask(3).any()


def test_strokes_correct_a_mask_at_once_by_the_edges_and_erased_ones_no_longer(editor: Served) -> None:
    true = moving.mask(0, SIZE) > 0
    editor.do(**stroke())
    grown = editor.mask(0)
    assert iou(grown, true) > 0.6 and grown.sum() > 2 * 25 * 8, "the stroke grew to the animal's edges"
    editor.do(**stroke(1, tool="surroundings", points=[[40.0, 75.0], [40.0, 95.0]]))
    assert not editor.mask(0)[76:95, 40].any(), "what is said not to be the animal is no part of its mask"
    editor.do(**stroke(2, tool="eraser", radius=200.0))
    assert editor.state()["frames"][0][1:] == ["", ""], "without marks there is no mask again"
    assert editor.decide("undo")[1]["look"] == 0 and editor.state()["frames"][0][1] == "strokes"


def test_a_true_mask_is_painted_pixel_by_pixel_until_it_is_let_go(editor: Served) -> None:
    assert editor.decide("fix", place=0)[1]["error"] == "This frame has no mask yet that could be true."
    editor.do(**stroke())
    before = editor.mask(0)
    editor.decide("fix", place=0)
    assert editor.state()["frames"][0][1] == "true" and (editor.mask(0) == before).all()
    editor.do(**stroke(1, points=[[150.5, 20.5]], radius=3.0))
    changed = editor.mask(0) != before
    assert changed[20, 150] and 20 < changed.sum() < 60, "a tap paints a disc and nothing else"
    status, answer = editor.do(**stroke(2, tool="eraser"))
    assert status == 400 and "Press f to let it go" in answer["error"]
    editor.decide("fix", place=0)
    assert editor.state()["frames"][0][1] == ""


def test_a_drawing_that_is_sent_twice_is_drawn_once_and_a_page_that_lags_behind_is_told(editor: Served) -> None:
    version = editor.state()["version"]
    editor.do(**stroke())
    once = editor.do(**stroke())[1]["state"]
    assert once["undo"] == "stroke in frame 100"
    status, answer = editor.do(kind="undo", version=version)
    assert status == 409 and "not up to date" in answer["error"] and answer["state"] == once
    assert editor.do(**stroke(5))[0] == 200, "a stroke of a page that lags behind is not lost"
    editor.decide("undo"), editor.decide("undo")
    assert editor.decide("undo")[1]["error"] == "Nothing to undo."
    assert editor.state()["frames"][0][1] == ""
    editor.decide("redo"), editor.decide("redo")
    assert editor.decide("redo")[1]["error"] == "Nothing to redo."


def test_from_here_on_leaves_the_frames_before_and_starts_at_this_mask(editor: Served) -> None:
    editor.do(**box(3, (14.0, 40.0, 64.0, 56.0)))
    editor.decide("track", place=3)
    state = wait(editor)
    assert [mask for _, _, mask in state["frames"]] == [""] * 3 + ["mask"] * 5
    assert iou(editor.mask(7), moving.mask(7, SIZE) > 0) > 0.9


class Slow:
    """A maker whose second mask waits until it may come."""

    def __init__(self) -> None:
        self.may, self.seen = Event(), Event()

    def __call__(self, source: Unmasked) -> Iterator[np.ndarray]:
        for number, _ in enumerate(source.images()):
            if number == 1:
                self.seen.set()
                assert self.may.wait(20)
            yield np.full(source.size[::-1], 255, np.uint8)


def test_while_it_follows_nothing_is_drawn_masks_appear_as_they_come_and_it_can_be_cancelled(tmp_path: Path) -> None:
    slow = Slow()
    with served(tmp_path / "masks", maker=slow) as editor:
        editor.decide("track")
        assert slow.seen.wait(20)
        state = editor.state()
        assert state["job"] == {
            "done": 1, "share": 1 / COUNT, "total": COUNT, "first": 0, "left": None, "stopping": False
        }  # fmt: skip
        assert state["frames"][0][2] == "mask" and state["frames"][1][2] == ""
        for request in (stroke(), {"kind": "save"}, {"kind": "undo", "version": state["version"]}):
            status, answer = editor.do(**request)
            assert status == 423 and answer["error"].startswith("The animal is being followed")
        assert editor.do(kind="cancel")[1]["state"]["job"]["stopping"]
        slow.may.set()
        state = wait(editor)
        assert state["notice"][2] == f"Stopped after 1 of {COUNT} frames."
        assert editor.do(**stroke())[0] == 200
        editor.decide("undo"), editor.decide("undo")
        assert editor.state()["frames"][0][2] == "", "undo takes the masks that came back"


def failing(source: Unmasked) -> Iterator[np.ndarray]:
    yield np.zeros(source.size[::-1], np.uint8)
    raise ZeroDivisionError("oh")


def unwilling(source: Unmasked) -> Iterator[np.ndarray]:
    yield from ()
    raise UserError("film: nothing in it stands out; give a box: --box frame:left,top,width,height.")


def test_what_goes_wrong_while_following_is_told_on_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = "film: nothing in it stands out; give a box: --box frame:left,top,width,height."
    for maker, said in (
        (failing, "Following failed (ZeroDivisionError: oh); the terminal has the details."),
        (unwilling, f"{nothing} In this page: draw a box around the animal."),
    ):
        with served(tmp_path / "masks", maker=maker) as editor:
            editor.decide("track")
            assert wait(editor)["notice"][1:] == ["bad", said]
            assert editor.do(**stroke())[0] == 200, "the work goes on"
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_saving_writes_masks_marks_and_boxes_and_the_next_sitting_goes_on_from_them(
    editor: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    editor.do(**box())
    editor.decide("track")
    wait(editor)
    editor.do(**stroke(3, place=2, tool="surroundings"))
    assert not editor.state()["saved"]
    answer = editor.do(kind="save")[1]
    assert answer["state"]["saved"]
    said = answer["state"]["notice"][2]
    assert said.startswith(f"{COUNT} masks written into {tmp_path}/masks; marks and boxes into {tmp_path}/masks-marks.")
    assert said.endswith(f"Next: rewild4d-bench check --masks {tmp_path}/masks")
    names = [f"{100 + place:05d}.png" for place in range(COUNT)]
    assert sorted(path.name for path in (tmp_path / "masks").iterdir()) == names
    assert (np.asarray(Image.open(tmp_path / "masks" / names[2])) == editor.mask(2) * 255).all()
    assert sorted(path.name for path in (tmp_path / "masks-marks").iterdir()) == ["00102.png", "boxes.txt"]
    assert (tmp_path / "masks-marks" / "boxes.txt").read_text() == "00100:8,40,64,56\n"
    colors = {color for _, color in Image.open(tmp_path / "masks-marks" / "00102.png").getcolors()}
    assert colors == {(0, 0, 0), (255, 0, 0)}
    with served(tmp_path / "masks") as again:
        state = again.state()
        assert state["saved"] and state["boxes"] == {"0": list(BOX)} and state["undo"] == ""
        assert [marks for _, marks, _ in state["frames"]] == ["", "", "strokes"] + [""] * 5
        assert all((again.mask(place) == editor.mask(place)).all() for place in range(COUNT))
        again.decide("clear", place=2), again.do(**box(0, None, "x"))
        again.do(kind="save")
        assert not list((tmp_path / "masks-marks").iterdir()), "what is no longer marked has no file"


def test_frames_without_a_mask_are_written_empty_and_the_page_says_so(editor: Served, tmp_path: Path) -> None:
    editor.do(**stroke())
    said = editor.do(kind="save")[1]["state"]["notice"][2]
    assert "8 masks written" in said and "(7 without the animal, 7 of these because no mask was made yet)" in said
    assert not np.asarray(Image.open(tmp_path / "masks" / "00107.png")).any()


def test_masks_and_marks_that_do_not_fit_are_one_sentence(tmp_path: Path) -> None:
    moving.save(tmp_path / "numbers" / "00100.png", np.repeat(np.uint8([[1, 2]]), 96, 1).repeat(128, 0))
    with (
        pytest.raises(UserError, match="numbers of 2 objects, which the editor would write over; choose another"),
        served(tmp_path / "numbers"),
    ):
        pass
    marks = {0: np.ones(SIZE[::-1], np.int8)}
    moving.save(tmp_path / "masks-marks" / "00100.png", moving.mask(0, SIZE))
    source = film()
    given = Unmasked(source.title, source.stems, source.size, source.images, {}, marks)
    with pytest.raises(UserError, match="holds marks of an earlier sitting"), served(tmp_path / "masks", given):
        pass


def test_boxes_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "masks-marks").mkdir()
    for text, said in (("00100:1,2,3\n", r"boxes\.txt: expected boxes, one a line\. --box: expected left,top"),
                       ("00300:1,2,3,4", "in a frame from 00100 to 00107")):  # fmt: skip
        (tmp_path / "masks-marks" / "boxes.txt").write_text(text)
        with pytest.raises(UserError, match=said), served(tmp_path / "masks"):
            pass


def test_a_film_that_ends_early_is_one_sentence(tmp_path: Path) -> None:
    source = film()
    short = Unmasked("short.mp4", source.stems, SIZE, lambda: map(walking, range(3)), {})
    with pytest.raises(UserError, match=r"short\.mp4: expected 8 frames, but 3 could be read"), served(tmp_path, short):
        pass


def test_strokes_lie_where_they_are_drawn() -> None:
    said = drawn(np.zeros((40, 60), np.int8), "animal", 5.0, [(20.5, 10.5)])
    rows, columns = np.nonzero(said)
    assert rows.mean() == pytest.approx(10, abs=0.25) and columns.mean() == pytest.approx(20, abs=0.25)
    assert said.sum() == pytest.approx(np.pi * 25, rel=0.15)
    line = drawn(said, "surroundings", 2.0, [(-50.0, 30.5), (200.0, 30.5)])
    assert (line[29:32] == -1).all() and not line[34:].any() and (line[:20] == said[:20]).all()
    assert drawn(said, "eraser", 0.5, [(20.2, 10.9)])[10, 20] == 0, "the thinnest brush marks a pixel"


def test_a_mask_keeps_its_own_edge_away_from_strokes() -> None:
    base = moving.mask(0, SIZE)
    assert (mask_of(walking(0), base, np.zeros(SIZE[::-1], np.int8)) == base).all()
    said = drawn(np.zeros(SIZE[::-1], np.int8), "surroundings", 4.0, [(150.0, 20.0)])
    assert (mask_of(walking(0), base, said) == base).all()
    assert mask_of(walking(0), None, np.zeros(SIZE[::-1], np.int8)) is None


def test_the_command_makes_the_same_masks_from_what_was_saved(
    editor: Served, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in range(COUNT):
        moving.save(tmp_path / "film" / f"{100 + place:05d}.png", walking(place))
    editor.do(**box())
    editor.do(**stroke(3, place=4))
    editor.decide("track")
    wait(editor)
    editor.do(kind="save")
    boxes = (tmp_path / "masks-marks" / "boxes.txt").read_text().split()
    marks = tmp_path / "masks-marks"
    words = ("masks", "--video", tmp_path / "film", "--out", tmp_path / "again", "--marks", marks, "--box", *boxes)
    output(capsys, *words)
    for path in sorted((tmp_path / "masks").iterdir()):
        assert (np.asarray(Image.open(path)) == np.asarray(Image.open(tmp_path / "again" / path.name))).all()


def test_red_strokes_alone_in_masks_from_elsewhere_start_from_the_mask_that_they_correct(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub_network(monkeypatch)
    for place in range(COUNT):
        moving.save(tmp_path / "masks" / f"{100 + place:05d}.png", moving.mask(place, SIZE))
    with served(tmp_path / "masks") as editor:
        assert (editor.mask(3) == (moving.mask(3, SIZE) > 0)).all()
        editor.do(**stroke(0, tool="surroundings", points=[[40.0, 80.0], [40.0, 92.0]]))
        editor.decide("track")
        assert wait(editor)["notice"][1] == "good"
        assert iou(editor.mask(5), moving.mask(5, SIZE) > 0) > 0.8


def test_a_frame_that_is_said_to_hold_no_animal_is_read_again(tmp_path: Path, editor: Served) -> None:
    editor.do(**stroke(tool="surroundings"))
    editor.decide("fix", place=0)
    editor.do(kind="save")
    said = read_marks(tmp_path / "masks-marks", film().stems, SIZE)
    assert (said[0] == -1).all()


def test_crumbs_that_a_stroke_leaves_of_a_mask_are_swept_away() -> None:
    picture = np.full((*SIZE[::-1], 3), 90, np.uint8)
    picture[10:40, 20:80] = (200, 40, 30)
    picture[24:27, 70:73] = 90  # of another colour, so the change does not reach it
    base = np.zeros(SIZE[::-1], np.uint8)
    base[10:40, 20:80] = base[60:120, 20:180] = 255
    said = drawn(np.zeros(SIZE[::-1], np.int8), "surroundings", 3.0, [(25.0, 15.0), (60.0, 15.0)])
    mask = mask_of(picture, base, said)
    assert mask is not None and not mask[:50].any() and (mask[60:] == base[60:]).all()
