"""Records and pictures by anybody: nothing from outside of their folder is published, and nothing that acts."""

import base64
import hashlib
import os
import re
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from browser import browser, needs_chromium
from calling import call
from media_files import film, picture
from PIL import Image, PngImagePlugin
from records_for_tests import PROTOCOL, psnr, record

from rewild4d.errors import UserError
from rewild4d.leaderboard.collect import collect
from rewild4d.leaderboard.formats import latex, markdown, plain
from rewild4d.leaderboard.media import publish
from rewild4d.leaderboard.records import FILE, find_records, write_record
from rewild4d.leaderboard.site import Part, build_site
from rewild4d.leaderboard.tables import standings

SECRET = b"root:x:0:0:a file of the system"
CODE = b"<script>alert(1)</script>"
ID = "a" * 16


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of one run, without pictures."""
    (tmp_path / "runs" / "run").mkdir(parents=True)
    (tmp_path / "secret").write_bytes(SECRET)
    return tmp_path / "runs" / "run"


def built(run: Path, tmp_path: Path, *pictures: str, licence: str = "CC0") -> tuple[Path, list[str]]:
    """The folder of the run's page, and what was said."""
    write_record(record(run_id=ID, pictures=list(pictures), data={"licence": licence}), run)
    said: list[str] = []
    build_site([Part("Runs", find_records(run.parent))], tmp_path / "page", said.append)
    return tmp_path / "page" / "runs" / ID, said


def nothing_holds(folder: Path, content: bytes) -> bool:
    return not any(content in path.read_bytes() for path in folder.rglob("*") if path.is_file())


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
@pytest.mark.parametrize("name", ["comparison.png", "comparison.webp", "orbit.mp4"])
def test_a_link_out_of_the_folder_is_not_published(run: Path, tmp_path: Path, name: str) -> None:
    (run / name).symlink_to(tmp_path / "secret")
    page, said = built(run, tmp_path, name)
    assert said == [f"left out: {run / name}: expected a file inside {run}, got a link that leads out of it."]
    assert sorted(path.name for path in page.iterdir()) == ["index.html", FILE]
    with pytest.raises(UserError, match=f"{name}: expected a file inside .*, got a link that leads out of it"):
        collect(find_records(run.parent), tmp_path / "kept", title="", limit=1e9)
    assert nothing_holds(tmp_path / "page", SECRET) and not (tmp_path / "kept").exists()


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_picture_that_links_to_a_good_one_elsewhere_is_not_published_either(run: Path, tmp_path: Path) -> None:
    picture(tmp_path / "private.png")
    (run / "comparison.png").symlink_to(tmp_path / "private.png")
    picture(run / "own.png")
    (run / "canonical.png").symlink_to(run / "own.png")
    page, said = built(run, tmp_path, "comparison.png", "canonical.png")
    assert len(said) == 1 and (page / "canonical.png").is_file() and not (page / "comparison.png").exists()
    assert not (page / "canonical.png").is_symlink()


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_record_is_a_file_of_its_folder(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_record(record(run_id=ID), tmp_path)
    (run / FILE).symlink_to(tmp_path / FILE)
    words = ("--runs", run.parent, "--out", tmp_path / "out")
    for command in ("build", "collect"):
        assert call("leaderboard", command, *words) == 2
        assert f"{run / FILE}: expected a file inside {run.parent}, got a link that" in capsys.readouterr().err
    (run / FILE).unlink()
    os.mkfifo(run / FILE)
    assert call("leaderboard", "build", *words) == 2
    assert f"{run / FILE}: expected a regular file, got something else." in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_only_pictures_and_films_are_published(run: Path, tmp_path: Path) -> None:
    for name in ("page.html", "drawing.svg", "run.js", "notes.txt", "film.webm"):
        (run / name).write_bytes(CODE)
    (run / "false.png").write_bytes(CODE)
    (run / "false.webp").write_bytes(b"RIFF" + struct.pack("<I", 100) + b"WEBPVP8 " + CODE)
    (run / "false.mp4").write_bytes(CODE)
    (run / "folder.png").mkdir()
    names = sorted(path.name for path in run.iterdir())
    page, said = built(run, tmp_path, *names, "absent.png", "x" * 300 + ".png", "a\0b.png", "")
    assert len(said) == len(names), said
    assert f"left out: {run / 'drawing.svg'}: expected a picture or a film (.png, .webp, .mp4), got another kind" in (
        "\n".join(said)
    )
    assert sorted(path.name for path in page.iterdir()) == ["index.html", FILE]
    assert nothing_holds(tmp_path / "page", CODE)


def test_a_name_is_no_scheme(run: Path, tmp_path: Path) -> None:
    name = "javascript:alert(1);'\".png"
    picture(run / name)
    page, said = built(run, tmp_path, name)
    text = (page / "index.html").read_text()
    assert said == [] and (page / name).is_file()
    links = re.findall(r'(?:href|src)="([^"]*)"', text)
    assert links[2:] == ["javascript%3Aalert%281%29%3B%27%22.png"] * 2


def test_a_picture_is_drawn_anew_and_nothing_else_comes_with_it(run: Path, tmp_path: Path) -> None:
    pixels = picture(run / "comparison.png")
    about = PngImagePlugin.PngInfo()
    about.add_text("comment", CODE.decode())
    Image.open(run / "comparison.png").save(run / "canonical.png", pnginfo=about)
    for name in ("comparison.png", "canonical.png"):
        with (run / name).open("ab") as file:
            file.write(CODE)
    page, said = built(run, tmp_path, "comparison.png", "canonical.png")
    assert said == [] and nothing_holds(page, CODE)
    for name in ("comparison.png", "canonical.png"):
        assert (np.asarray(Image.open(page / name)) == pixels).all()


def test_a_coded_picture_is_copied_alone(run: Path, tmp_path: Path) -> None:
    picture(run / "bare.webp")
    bare = (run / "bare.webp").read_bytes()
    Image.open(run / "bare.webp").save(run / "comparison.webp", exif=b"Exif\0\0" + CODE)
    with (run / "comparison.webp").open("ab") as file:
        file.write(CODE)
    (run / "orbit.webp").write_bytes(bare + CODE)
    Image.new("RGBA", (8, 8), (255, 0, 0, 99)).save(run / "clear.webp", exif=b"Exif\0\0" + CODE)
    page, said = built(run, tmp_path, "comparison.webp", "orbit.webp", "clear.webp")
    assert said == [] and nothing_holds(page, CODE)
    assert (page / "orbit.webp").read_bytes() == bare, "no loss"
    assert Image.open(page / "clear.webp").mode == "RGBA"


def test_a_film_is_decoded_and_its_images_are_copied_alone(run: Path, tmp_path: Path) -> None:
    film(run / "orbit.mp4")
    with (run / "orbit.mp4").open("ab") as file:
        file.write(struct.pack(">I4s", 8 + len(CODE), b"free") + CODE)
    cut = bytearray((run / "orbit.mp4").read_bytes())
    start = cut.index(b"mdat") + 1000
    cut[start : start + 1500] = bytes(1500)
    (run / "cut.mp4").write_bytes(cut)
    (run / "list.mp4").write_text(f"ffconcat version 1.0\nfile '{tmp_path / 'private.mp4'}'\n")
    (run / "hls.mp4").write_text(f"#EXTM3U\n#EXTINF:1,\n{tmp_path / 'private.mp4'}\n#EXT-X-ENDLIST\n")
    film(tmp_path / "private.mp4")
    page, said = built(run, tmp_path, "orbit.mp4", "cut.mp4", "list.mp4", "hls.mp4")
    assert [re.search(r"(\w+\.mp4): expected an H.264 film in MP4, but ffmpeg says: ", line)[1] for line in said] == [  # type: ignore[index]
        "cut.mp4", "list.mp4", "hls.mp4",
    ]  # fmt: skip
    assert sorted(path.name for path in page.iterdir()) == ["index.html", "orbit.mp4", FILE]
    assert nothing_holds(page, CODE)


def test_a_report_is_published_only_where_somebody_says_so(run: Path, tmp_path: Path) -> None:
    (run / "report.html").write_bytes(CODE)
    page, said = built(run, tmp_path)
    (sentence,) = said
    assert f"{run / 'report.html'}: it has a script of its own; --reports" in sentence
    assert nothing_holds(tmp_path / "page", CODE) and "report.html" not in (page / "index.html").read_text()
    build_site([Part("Runs", find_records(run.parent))], tmp_path / "page", said.append, reports=True)
    assert (page / "report.html").read_bytes() == CODE and '<a href="report.html">' in (page / "index.html").read_text()
    (run / "report.html").unlink()
    (run / "report.html").symlink_to(tmp_path / "secret")
    build_site([Part("Runs", find_records(run.parent))], tmp_path / "page", said.append, reports=True)
    assert "got a link that leads out of it" in said[-1] and nothing_holds(tmp_path / "page", SECRET)


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_bombs_are_told_from_their_headers(tmp_path: Path) -> None:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    side = 12_000
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    rows = zlib.compress(bytes(side * (3 * side + 1) // 40))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    begin = time.monotonic()
    with pytest.raises(UserError, match="a.png: expected at most 67 million pixels, got 12000 x 12000"):
        publish(tmp_path / "a.png", tmp_path, tmp_path / "b.png")
    with (tmp_path / "c.png").open("wb") as file:
        file.truncate(65 << 20)
    with pytest.raises(UserError, match="c.png: expected at most 64 MiB, got 65 MiB"):
        publish(tmp_path / "c.png", tmp_path, tmp_path / "b.png")
    assert time.monotonic() - begin < 1 and not (tmp_path / "b.png").exists()
    (tmp_path / "run").mkdir()
    with (tmp_path / "run" / FILE).open("wb") as file:
        file.truncate(65 << 20)
    with pytest.raises(UserError, match="record.json: expected a run record of at most 64 MiB, got 65 MiB"):
        find_records(tmp_path / "run")


def test_a_score_says_which_way_is_better(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text((write_record(record(), tmp_path)).read_text().replace('"higher"', '"<b>"'))
    with pytest.raises(UserError, match="expected 'higher', 'lower' or nothing in `scores`, got '<b>' of psnr"):
        find_records(tmp_path)


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("<img src=x onerror=alert(1)>", "&lt;img src=x onerror=alert(1)>"),
        ("F < 2 & G", "F &lt; 2 & G"),
        ("&lt;b&#62;", "&amp;lt;b&amp;#62;"),
        ("[go](javascript:alert(1))", r"\[go](javascript:alert(1))"),
        (r"\[go](javascript:x)", r"\\\[go](javascript:x)"),
        ("[x]: javascript:x", r"\[x]: javascript:x"),
        ("from 1 [2] to 3", "from 1 [2] to 3"),
        ("`--a <b>` and `<c>", r"`--a <b>` and \`&lt;c>"),
        ("`` ` <b> ` ``", r"\`\` \` &lt;b> \` \`\`"),
        ("one\n\n# two\x1b[31m", "one  # two [31m"),
        (r"C:\data\x and \|", r"C:\data\x and \\|"),
        ("D-3DGS*, PSNR, dB", "D-3DGS*, PSNR, dB"),
    ],
)
def test_markdown_is_text(text: str, left: str) -> None:
    assert plain(text) == left


def test_no_table_lets_a_record_speak(tmp_path: Path) -> None:
    nasty = f"{CODE.decode()} [a](javascript:x)\n\n<b>"
    protocol = {**PROTOCOL, "name": "p}\\input{/etc/passwd}", "title": nasty, "description": nasty}
    made = record(method=nasty, case=nasty, marks=[nasty], protocol=protocol, scores=psnr(None, nasty))
    (table,) = standings([made])
    shown = markdown(table)
    assert not re.search(r"<(script|b)>|(?<!\\)\[a\]", shown) and shown.count("&lt;script>") >= 3
    assert all(line.startswith(("|", "**", "[", "")) for line in shown.splitlines()) and "\n<" not in shown
    source = latex(table)
    assert r"\label{tab:p-input-etc-passwd-}" in source and r"\input" not in source


def test_pages_forbid_what_they_do_not_use(run: Path, tmp_path: Path) -> None:
    page, _ = built(run, tmp_path)
    for path in (page / "index.html", tmp_path / "page" / "index.html"):
        text = path.read_text()
        (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        for name in ("style", "script"):
            (body,) = re.findall(f"<{name}>(.*?)</{name}>", text, re.DOTALL)
            digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
            assert rules[f"{name}-src"] == f"'sha256-{digest}'"
        assert rules["default-src"] == "'none'" and rules["base-uri"] == "'none'" and rules["form-action"] == "'none'"
        assert not re.search(r"<[^>]+\s(on\w+|style)=", text), "no handler and no style that the policy would refuse"
        assert text.index("Content-Security-Policy") < text.index("<style>")


@needs_chromium
def test_a_browser_shows_the_pictures_and_runs_no_other_script(run: Path, tmp_path: Path) -> None:
    picture(run / "comparison.png")
    page, _ = built(run, tmp_path, "comparison.png")
    code = 'document.title = "ran";'
    text = (page / "index.html").read_text().replace("</main>", f"</main><script>{code}</script>")
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    titles = []
    with browser() as opened:
        for name, policy in (("refused", ""), ("allowed", f" 'sha256-{digest}'")):
            (page / f"{name}.html").write_text(text.replace("script-src", f"script-src{policy}"))
            shown = opened.new_page()
            shown.goto((page / f"{name}.html").as_uri())
            titles.append(shown.title())
            image = shown.locator("img").first
            image.scroll_into_view_if_needed()  # it is loaded when it comes near
            assert image.evaluate("image => image.decode().then(() => image.naturalWidth)") == 8
    assert titles == ["ours on wolf/Run", "ran"]
