"""A standard error that tells a test when another thread says something."""

import io
from threading import Event


class Errors(io.StringIO):
    """Stands for ``sys.stderr``; read by `capsys` instead, what is said at that moment would be lost."""

    def __init__(self, awaited: str):
        super().__init__()
        self.awaited, self.said = awaited, Event()

    def write(self, text: str) -> int:
        if self.awaited in text:
            self.said.set()
        return super().write(text)
