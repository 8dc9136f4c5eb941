"""The leaderboard's page: complete, self-contained, escaped, sortable; curves by hand."""

import base64
import hashlib
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import pytest
from browser import browser, needs_chromium
from calling import call
from media_files import film, picture
from PIL import Image
from records_for_tests import PROTOCOL, psnr, record

from rewild4d.errors import UserError
from rewild4d.leaderboard.curves import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, curve, moments
from rewild4d.leaderboard.records import RunRecord, find_records, write_record
from rewild4d.leaderboard.site import MARKER, Part, build_site
from rewild4d.metrics.score import Score

NASTY = "<script>alert('x')</script> & \"y\""
VOID = {"meta", "link", "img", "input", "br", "hr"}


class Page(HTMLParser):
    """Collects links and checks that tags close in order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.feed(path.read_text())
        assert not self.open, f"{path}: not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("href", "src")]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        return None

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] not in (["script"], ["style"]):
            self.text += data


def keep(folder: Path, made: RunRecord, *pictures: str) -> None:
    write_record(made, folder)
    for name in pictures:
        (picture if name.endswith(".png") else film)(folder / name)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Three runs: one with pictures and curves, one that failed, one of a method with an odd name."""
    items = [f"view {view} at {time:.4f} s" for time in (0.0, 0.5) for view in (1, 2)]
    scores = {"psnr": Score(20.0, "dB", "higher", 4, [10.0, 20.0, 20.0, 30.0])}
    whole = record(
        run_id="a" * 16, scores=scores, items=items, pictures=["orbit.mp4", "comparison.png", "canonical.png"],
        config={"loss": {"ssim": 0.2}}, data={"clip": "c1", "licence": "CC0 1.0"}, machine={"processor": "abacus"},
        diagnostics={"joint_angle_mean": [1.5, 2.5]},
    )  # fmt: skip
    keep(tmp_path / "runs" / "a", whole, "comparison.png", "orbit.mp4")
    failed = record(run_id="b" * 16, method="gart", status="failed", error=f"it diverged {NASTY}", scores={})
    keep(tmp_path / "runs" / "b", failed)
    keep(tmp_path / "runs" / "c", record(run_id="c" * 16, method=NASTY, case=NASTY, marks=["upper bound: rotated"]))
    return tmp_path / "runs"


def test_every_link_leads_to_a_file_of_the_page(runs: Path, tmp_path: Path) -> None:
    first = build_site([Part("Runs", find_records(runs))], tmp_path / "page")
    shutil.move(str(tmp_path / "page"), str(tmp_path / "elsewhere"))
    first = tmp_path / "elsewhere" / first.name
    pages = [first, *sorted((tmp_path / "elsewhere" / "runs").glob("*/index.html"))]
    assert len(pages) == 4
    for path in pages:
        for link in Page(path).links:
            assert not re.match(r"[a-z]+:|/", link), f"{link} leaves the folder"
            assert link.startswith("#") or (path.parent / link).is_file(), f"{path}: {link}"
        assert "http" not in path.read_text().replace("http-equiv", "")
        assert 'name="viewport"' in path.read_text()


def test_a_run_shows_what_it_was(runs: Path, tmp_path: Path) -> None:
    build_site([Part("Runs", find_records(runs))], tmp_path / "page")
    page = Page(tmp_path / "page" / "runs" / ("a" * 16) / "index.html")
    for text in ("loss.ssim", "0.2", "c1", "CC0 1.0", "abacus", "joint_angle_mean", "1.5, 2.5", "20.00", "p-v1"):
        assert text in page.text, text
    assert [link for link in page.links if "." in link][2:] == ["comparison.png", "comparison.png", "orbit.mp4"]
    assert "canonical" not in page.text, "a picture that was not kept is not shown"
    assert page.text.count("PSNR, dB") == 1, "one curve"
    other = Page(tmp_path / "page" / "runs" / ("c" * 16) / "index.html")
    assert "No pictures were kept beside this record." in other.text and "upper bound: rotated" in other.text


def test_runs_with_pictures_stand_in_tables_with_a_small_one(runs: Path, tmp_path: Path) -> None:
    first = Page(build_site([Part("Runs", find_records(runs))], tmp_path / "page"))
    small = f"runs/{'a' * 16}/thumbnail.webp"
    assert [link for link in first.links if "thumbnail" in link] == [small], "the others have no picture"
    with Image.open(tmp_path / "page" / small) as image, Image.open(runs / "a" / "comparison.png") as whole:
        assert image.width == 320 and image.height == round(320 * whole.height / whole.width)


def test_names_and_messages_are_text(runs: Path, tmp_path: Path) -> None:
    first = build_site([Part("Runs", find_records(runs))], tmp_path / "page")
    for path in (first, *(tmp_path / "page" / "runs").glob("*/index.html")):
        assert "<script>alert" not in path.read_text()
    assert NASTY in Page(first).text
    assert f"Failed: it diverged {NASTY}" in Page(tmp_path / "page" / "runs" / ("b" * 16) / "index.html").text


def test_an_older_page_is_replaced_and_anything_else_is_not(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "page"
    build_site([Part("Runs", find_records(runs))], out)
    (out / "runs" / "old").mkdir()
    build_site([Part("Runs", find_records(runs))], out)
    assert not (out / "runs" / "old").exists()
    (out / MARKER).unlink()
    with pytest.raises(UserError, match="page: expected an empty folder or an earlier leaderboard, but it holds some"):
        build_site([Part("Runs", find_records(runs))], out)
    assert (out / "index.html").is_file()


@pytest.mark.parametrize("name", ["../../outside", "", "a/b", "x" * 65])
def test_a_run_id_is_no_path(runs: Path, tmp_path: Path, name: str) -> None:
    keep(runs / "d", record(run_id=name))
    with pytest.raises(UserError, match="expected a run id of letters and digits"):
        build_site([Part("Runs", find_records(runs))], tmp_path / "page")
    assert not (tmp_path / "page").exists() and not list(tmp_path.glob(".page*")), "nothing half-written"


def test_the_command(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("leaderboard", "build", "--runs", str(runs), "--out", str(tmp_path / "page")) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "page" / "index.html")
    assert call("leaderboard", "biuld") == 2
    assert "unknown leaderboard command 'biuld'. Did you mean 'build'?" in capsys.readouterr().err
    (tmp_path / "none").mkdir()
    assert call("leaderboard", "build", "--runs", str(tmp_path / "none"), "--out", str(tmp_path / "p2")) == 2
    assert "expected run records, found none" in capsys.readouterr().err
    assert not (tmp_path / "p2").exists()


def test_moments_of_images_and_of_shapes() -> None:
    items = ["view 1 at 0.5000 s", "view 1 at 0.0000 s", "view 2 at 0.5000 s", "view 2 at 0.0000 s"]

    def score(*values: float | None) -> Score:
        return Score(1.0, "1", "higher", len(values), list(values))

    assert moments(score(5.0, 1.0, 7.0, None), items) == [(0.0, [1.0]), (0.5, [5.0, 7.0])]
    assert moments(score(3.0, 4.0), items) == [(0.0, [3.0]), (0.5, [4.0])], "one value a moment"
    assert moments(score(3.0, 4.0, 5.0), items) == [(0.0, [3.0]), (1.0, [4.0]), (2.0, [5.0])]
    assert moments(score(), items) == []


def test_a_curve_by_hand() -> None:
    drawn = curve("a < b", [(0.0, [0.0, 10.0]), (1.0, [10.0, 20.0]), (2.0, [20.0])])
    middle, right, floor = (LEFT + WIDTH - RIGHT) / 2, WIDTH - RIGHT, HEIGHT - BOTTOM
    tall = floor - TOP
    means = [(LEFT, floor - tall * 5 / 20), (middle, floor - tall * 15 / 20), (right, TOP)]
    assert 'points="' + " ".join(f"{x:.1f},{y:.1f}" for x, y in means) + '"' in drawn
    band = [
        (LEFT, floor - tall / 2),
        (middle, TOP),
        (right, TOP),
        (right, TOP),
        (middle, floor - tall / 2),
        (LEFT, floor),
    ]
    assert 'points="' + " ".join(f"{x:.1f},{y:.1f}" for x, y in band) + '"' in drawn
    assert "a &lt; b" in drawn and ">20<" in drawn and ">0<" in drawn
    assert "nan" not in curve("flat", [(0.0, [1.0]), (1.0, [1.0])])


CLICKS = """<script>
const table = document.querySelector("section table"), head = table.querySelectorAll(".heads th")[1];
const names = () => [...table.tBodies[0].rows].map(row => row.cells[0].firstChild.textContent).join(",");
head.click(); const down = names(); head.click();
const input = document.querySelector("[data-filters]"); input.value = "GART"; input.dispatchEvent(new Event("input"));
const shown = [...document.querySelectorAll(".runs tbody tr")].filter(row => !row.hidden).length;
document.title = [down, names(), shown, document.documentElement.scrollWidth <= innerWidth].join(" ; ");
</script>"""


@needs_chromium
def test_a_browser_sorts_filters_and_fits_a_phone(tmp_path: Path) -> None:
    found = (("ours", 20.0), ("gart", 5.0), ("d3dgs", 10.0), ("none", None), ("star", 30.0), ("empty", 15.0))
    for number, (method, value) in enumerate(found):
        protocol = {**PROTOCOL, "description": "A long description. " * 20}
        made = record(
            run_id=str(number) * 16, method=method, scores=psnr(value, "not computed: why"), protocol=protocol,
            marks=["upper bound: rotated"] if method == "star" else [],
        )  # fmt: skip
        keep(tmp_path / "runs" / method, made)
    first = build_site([Part("Runs", find_records(tmp_path / "runs"))], tmp_path / "page")
    code = re.sub("</?script>", "", CLICKS)
    allowed = f"script-src 'sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}'"
    text = first.read_text()
    first.write_text(text.replace("script-src", allowed).replace("</body>", CLICKS + "</body>"))
    with browser() as opened:
        shown = opened.new_page(viewport={"width": 390, "height": 844})
        shown.goto(first.as_uri())
        title = shown.title()
    # What is not ranked and the floor stay below, whatever is sorted by.
    assert title == "ours,d3dgs,gart,none,star,empty ; gart,d3dgs,ours,none,star,empty ; 1 ; true"


def test_folders_of_runs_are_parts_that_are_not_averaged_together(tmp_path: Path) -> None:
    """The same method on one case here and on another there: no mean over both, and no two elements of one id."""
    for number, (folder, case, value) in enumerate((("one", "a", 10.0), ("two", "b", 20.0))):
        keep(tmp_path / folder / "run", record(run_id=str(number) * 16, case=case, scores=psnr(value)))
    parts = [Part(name.title(), find_records(tmp_path / name)) for name in ("one", "two")]
    first = build_site(parts, tmp_path / "page")
    text = first.read_text()
    found = re.findall(r'<table id="(\d-p-v1)">.*?<td data-value="([0-9.]+)">', text, re.DOTALL)
    assert found == [("1-p-v1", "10"), ("2-p-v1", "20")]
    ids = re.findall(r' id="([^"]+)"', text)
    assert len(ids) == len(set(ids)) and "2 runs of 1 methods on 2 cases." in text
    assert all(link[1:] in ids for link in Page(first).links if link.startswith("#"))
    alone = build_site(parts[:1], tmp_path / "alone").read_text()
    assert "<h2>P</h2>" in alone and "One" not in Page(tmp_path / "alone" / "index.html").text


def test_what_keeps_a_row_out_of_the_ranking_is_seen_at_once(runs: Path, tmp_path: Path) -> None:
    text = build_site([Part("Runs", find_records(runs))], tmp_path / "page").read_text()
    assert text.count('<small class="flag">upper bound</small>') == 2, "in the table and among its runs"
    assert re.search(r'<tr class="unranked"><td>.*?<small class="flag">upper bound</small></td>', text)


def test_records_beside_each_other_are_found_with_their_folders(runs: Path) -> None:
    found = find_records(runs)
    assert [folder.name for folder, _ in found] == ["a", "b", "c"]
    assert msgspec.json.decode((found[0][0] / "record.json").read_bytes(), type=RunRecord) == found[0][1]
