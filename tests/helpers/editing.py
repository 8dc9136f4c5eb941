"""The editor of masks on a small film, served to a test; red things stand out to its network."""

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import urlsplit

import cv2
import moving
import numpy as np
import pytest

from rewild4d.datasets.masking import tracking
from rewild4d.datasets.masking.editor.app import open_editor
from rewild4d.datasets.masking.editor.editor import Editor
from rewild4d.datasets.masking.editor.server import Server
from rewild4d.datasets.masking.makers import MaskMaker, Unmasked
from rewild4d.datasets.masking.tracking import track_masks

SIZE = (192, 128)
COUNT = 8
BOX = (8.0, 40.0, 64.0, 56.0)
"""Around the animal in the first frame."""


def red(image: np.ndarray) -> np.ndarray:
    """A network to which red things stand out."""
    return cv2.GaussianBlur((image[..., 0] > 150).astype(np.float32), (0, 0), 1.0)


def stub_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let red things stand out, without any weights."""
    monkeypatch.setattr(tracking, "is_here", lambda _: True)
    monkeypatch.setattr(tracking, "load_weights", lambda _: None)
    monkeypatch.setattr(tracking, "Saliency", lambda _: red)


def walking(number: int) -> np.ndarray:
    """A frame of the film, with something for flow to hold on to, which stands still."""
    noise = np.random.default_rng(0).integers(0, 30, SIZE[::-1])[..., None]
    return np.clip(moving.image(number, SIZE).astype(int) + noise, 0, 255).astype(np.uint8)


def film(count: int = COUNT) -> Unmasked:
    """Frames 100, 101, ... of an animal that walks."""
    stems = tuple(f"{100 + number:05d}" for number in range(count))
    return Unmasked("film.mp4", stems, SIZE, lambda: map(walking, range(count)), {})


@contextmanager
def served(folder: Path, source: Unmasked | None = None, maker: MaskMaker = track_masks) -> Iterator["Served"]:
    """Serve an editor whose masks go into a folder."""
    editor = open_editor(source or film(), folder, maker, f"rewild4d-bench check --masks {folder}")
    server = Server()
    server.editor = editor
    thread = Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield Served(editor, server)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        editor.close()


class Served:
    """An editor and what asks it for things."""

    def __init__(self, editor: Editor, server: Server) -> None:
        self.editor, self.server, self.address = editor, server, server.address

    def ask(
        self, path: str = "", body: bytes | None = None, method: str | None = None, **headers: str
    ) -> tuple[int, bytes, http.client.HTTPMessage]:
        """Send a request; a path that begins with "/" is the whole one. Underscores in headers stand for hyphens."""
        connection = http.client.HTTPConnection("127.0.0.1", self.server.server_port, timeout=20)
        whole = path if path.startswith("/") else urlsplit(self.address).path + path
        sent = {"Content-Type": "application/json"} | {name.replace("_", "-"): value for name, value in headers.items()}
        try:
            connection.request(method or ("GET" if body is None else "POST"), whole, body, sent)
            reply = connection.getresponse()
            return reply.status, reply.read(), reply.headers
        finally:
            connection.close()

    def do(self, **request: Any) -> tuple[int, dict[str, Any]]:
        """Post a request and return the status and the answer."""
        status, answer, _ = self.ask("do", json.dumps(request).encode())
        return status, json.loads(answer)

    def decide(self, kind: str, **more: Any) -> tuple[int, dict[str, Any]]:
        """Post a decision on the newest state."""
        return self.do(kind=kind, version=self.state()["version"], **more)

    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.ask("state")[1])
        return found

    def mask(self, place: int) -> np.ndarray:
        """A frame's mask as a page gets it, bool [h, w]."""
        status, data, _ = self.ask(f"mask/{place}?v=1")
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert status == 200 and image is not None
        return image > 127
