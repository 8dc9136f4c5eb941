"""Who may ask the editor, and what it says to requests that make no sense; the command."""

import json
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import moving
import pytest
from calling import call, refusal
from editing import BOX, COUNT, Served, served

from rewild4d.datasets.masking.editor.app import serve
from rewild4d.datasets.masking.editor.requests import LARGEST
from rewild4d.datasets.masking.editor.server import Server
from rewild4d.errors import UserError


@pytest.fixture
def editor(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path / "masks") as found:
        yield found


def test_without_the_token_nothing_is_answered(editor: Served) -> None:
    for path in ("/", "/state", "/index.html", "/x/state", "//", f"/{editor.server.token[:-1]}/state", "/%00/", "/?"):
        status, body, _ = editor.ask(path)
        assert status == 403 and editor.server.token.encode() not in body, path
    assert editor.ask("/do", b'{"kind": "cancel"}')[0] == 403
    assert editor.ask("")[0] == editor.ask("state")[0] == 200
    assert len(editor.server.token) >= 32


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:{port}"},
        {"Host": "127.0.0.1"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://127.0.0.1:{port}"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_pages_of_other_sites_reach_nothing_even_with_the_token(editor: Served, headers: dict[str, str]) -> None:
    sent = {name: value.format(port=editor.server.server_port) for name, value in headers.items()}
    assert editor.ask("state", **sent)[0] == 403
    assert editor.ask("do", b'{"kind": "cancel"}', **sent)[0] == 403


def test_its_own_pages_and_links_to_it_are_answered_with_a_strict_policy(editor: Served) -> None:
    port = editor.server.server_port
    assert editor.ask("state", Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    assert editor.ask("", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200
    for path in ("", "state", "style.css", "main.js", "frame/0", "mask/0?v=1", "nothing"):
        headers = editor.ask(path)[2]
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'") and "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff" and headers["Referrer-Policy"] == "no-referrer"
        assert "Access-Control-Allow-Origin" not in headers
    assert editor.ask("", method="OPTIONS")[0] == 501, "no other site is let in"
    assert editor.ask("state")[2]["Cache-Control"] == "no-store"
    assert editor.server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "path",
    [
        "../server.py", "..%2fserver.py", "page/main.js", "/etc/passwd", "main.js/", "frame/8", "frame/-1",
        "frame/0/..", "frame/1e3", "frame/99999999999", "mask/", "mask/a", "../../../../etc/passwd",
        "%2e%2e/app.py", "__init__.py",
    ],
)  # fmt: skip
def test_paths_that_name_nothing_are_not_there(editor: Served, path: str) -> None:
    status, body, _ = editor.ask(f"/{editor.server.token}/{path}")
    assert status == 404 and json.loads(body) == {"error": "There is no such thing."}


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"[]",
        b'{"kind": "nothing"}',
        b'{"kind": "cancel", "more": 1}',
        b'{"kind": "undo"}',
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"kind": "stroke", "id": "a", "place": 8, "tool": "animal", "radius": 3, "points": [[1, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": -1, "tool": "animal", "radius": 3, "points": [[1, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "knife", "radius": 3, "points": [[1, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 0, "points": [[1, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 1e9, "points": [[1, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 3, "points": []}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 3, "points": [[1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 3, "points": [[NaN, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 3, "points": [[1e300, 1]]}',
        b'{"kind": "stroke", "id": "a", "place": 0, "tool": "animal", "radius": 3, "points": [[1e999, 1]]}',
        b'{"kind": "box", "id": "a", "place": 0, "box": [1, 1, 0, 5]}',
        b'{"kind": "box", "id": "a", "place": 0, "box": [500, 1, 5, 5]}',
        b'{"kind": "clear", "place": 99, "version": 1}',
    ],
)
def test_requests_that_make_no_sense_change_nothing(editor: Served, body: bytes) -> None:
    before = editor.state()
    found, answer, _ = editor.ask("do", body)
    assert found == 400 and json.loads(answer)["error"]
    assert editor.state() == before


def test_a_body_has_a_length_and_is_json(editor: Served) -> None:
    assert editor.ask("do", b"{}", Content_Type="text/plain")[0] == 415
    assert editor.ask("do", b"{}", Content_Length="x")[0] == 411
    assert editor.ask("do", b"{}", Content_Length="-5")[0] == 411
    assert editor.ask("do", b"{}", Content_Length=str(LARGEST + 1))[0] == 413
    assert editor.ask("do", method="POST", Transfer_Encoding="chunked")[0] == 411
    assert editor.ask("else", b"{}")[0] == 404


def test_a_connection_that_says_nothing_does_not_stop_the_others(editor: Served) -> None:
    with socket.create_connection(("127.0.0.1", editor.server.server_port)):
        assert editor.ask("state")[0] == 200


def test_a_page_that_is_up_to_date_gets_no_state_again(editor: Served) -> None:
    version = editor.state()["version"]
    assert json.loads(editor.ask(f"state?seen={version}")[1]) == {"version": version}
    assert len(json.loads(editor.ask("state?seen=x")[1])["frames"]) == COUNT


def test_it_ends_when_a_page_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command itself, in a thread; a page saves nothing and says that it is done."""
    moving.frames(tmp_path / "clip", 4)
    words = ("masks", "--edit", "--video", str(tmp_path / "clip"), "--out", str(tmp_path / "my masks"), "--fps", "5")
    addresses: list[str] = []
    saved = Server.__init__

    def spy(server: Server, *given: object) -> None:
        saved(server, *given)  # type: ignore[arg-type]
        addresses.append(server.address)

    monkeypatch.setattr(Server, "__init__", spy)
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(call(*words, "--box", "2:5,20,30,26")))
    thread.start()
    while not addresses:
        time.sleep(0.05)
        assert thread.is_alive()

    def ask(body: dict[str, object] | None = None) -> dict[str, object]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            addresses[0] + ("do" if body else "state"), data, {"Content-Type": "application/json"}
        )
        with urllib.request.urlopen(request, timeout=20) as reply:
            found: dict[str, object] = json.loads(reply.read())
            return found

    state = ask()
    assert state["boxes"] == {"2": [5, 20, 30, 26]} and state["saved"]
    ask({"kind": "box", "id": "a", "place": 0, "box": BOX})
    ask({"kind": "done", "version": ask()["version"]})
    thread.join(20)
    assert codes == [0]
    out, err = capsys.readouterr()
    assert addresses[0] in out and "work that was not saved is lost" in err
    assert not list((tmp_path / "my masks").iterdir())


def test_ctrl_c_ends_it_and_says_whether_work_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> bool:
        raise KeyboardInterrupt

    with served(tmp_path / "masks") as editor:
        monkeypatch.setattr(editor.editor.ended, "wait", stop)
        serve(Server(), editor.editor)
        assert "the editor ended; no work is lost" in capsys.readouterr().err


def test_a_port_in_use_and_flags_that_do_not_fit_are_one_sentence(
    editor: Served, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = editor.server.server_port
    with pytest.raises(UserError, match=f"--port: expected a port of this machine that is free, got {port}: Address"):
        Server(port)
    for wrong in (-1, 99999):
        with pytest.raises(UserError, match=f"expected a port of this machine that is free, got {wrong}"):
            Server(wrong)
    moving.frames(tmp_path / "clip", 4)
    words = ("masks", "--edit", "--video", str(tmp_path / "clip"), "--out", str(tmp_path / "m"))
    assert "--edit: expected --tool track, which it follows with, got rough." in refusal(
        capsys, *words, "--tool", "rough"
    )
    assert "--edit: expected --video FILE, got --dataset aptv2." in refusal(
        capsys, "masks", "--edit", "--dataset", "aptv2", "--data", str(tmp_path), "--out", str(tmp_path / "m")
    )
    assert f"got {port}: Address already in use" in refusal(capsys, *words, "--port", str(port))
    assert "there is no such thing" in refusal(
        capsys, "masks", "--edit", "--video", str(tmp_path / "no.mp4"), "--out", str(tmp_path / "m")
    )


def test_a_fault_of_the_editor_is_told_and_the_work_goes_on(
    editor: Served, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(editor.editor.work, "marks", lambda _: 1 / 0)
        status, answer = editor.do(kind="stroke", id="a", place=0, tool="animal", radius=3, points=[[20, 20]])
    assert status == 500 and answer["error"].startswith("The editor failed (ZeroDivisionError: division by zero)")
    assert "Traceback" in capsys.readouterr().err
    assert editor.do(kind="box", id="b", place=0, box=BOX)[0] == 200
