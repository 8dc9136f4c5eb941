"""`masks --edit`: open a film and what is known of it, serve the editor, end it."""

import sys
from collections.abc import Mapping
from pathlib import Path
from threading import Thread

import numpy as np

from rewild4d.datasets.masking.editor.editor import Editor
from rewild4d.datasets.masking.editor.film import Film
from rewild4d.datasets.masking.editor.saving import marks_folder, read_drawn, read_masks
from rewild4d.datasets.masking.editor.server import Server
from rewild4d.datasets.masking.editor.work import Work
from rewild4d.datasets.masking.makers import MaskMaker, Unmasked
from rewild4d.datasets.masking.masks import list_images
from rewild4d.datasets.masking.saliency import NAME
from rewild4d.errors import UserError
from rewild4d.metrics.weights import FETCH, is_here
from rewild4d.progress import Progress


def open_editor(source: Unmasked, folder: Path, maker: MaskMaker, command: str = "") -> Editor:
    """Read the frames, the masks that the folder holds, and the marks and boxes beside it.

    Args:
        source: the frames; its boxes and marks come before those beside the folder.
        folder: for masks.
        maker: of masks.
        command: what to run after saving.

    Raises:
        UserError: frames, masks or marks that cannot be read, or marks from two places.
    """
    beside = marks_folder(folder)
    if source.marks and beside.is_dir() and list_images(beside):
        raise UserError(
            f"--marks: {beside} holds marks of an earlier sitting, which the editor goes on from; leave --marks out, "
            "or remove that folder."
        )
    marks, boxes = read_drawn(beside, source)
    masks, note = read_masks(folder, source)
    if note:
        print(f"{folder}: {note}", file=sys.stderr)
    work = Work(len(source.stems), source.size)
    work.load(boxes | source.boxes, marks or source.marks, _with_true(masks, marks or source.marks))
    progress = Progress("frames")
    try:
        film = Film(source, progress)
    finally:
        progress.close()
    return Editor(source, film, work, maker, folder, command, lacking)


def serve(server: Server, editor: Editor) -> None:
    """Serve an editor until a page says that it is done, or Ctrl-C."""
    server.editor = editor
    answering = Thread(target=server.serve_forever, args=(0.1,), name="rewild4d-editor", daemon=True)
    answering.start()
    print(f"{server.address}\nopen this address in a browser on this machine; Ctrl-C ends the editor", flush=True)
    try:
        while not editor.ended.wait(0.5):
            pass
    except KeyboardInterrupt:
        print(file=sys.stderr)
    finally:
        server.shutdown()
        server.server_close()
        editor.close()
    lost = "no work is lost" if editor.work.is_saved else "work that was not saved is lost"
    print(f"the editor ended; {lost}", file=sys.stderr)


def lacking() -> str:
    """Return a sentence where the network is not here, so that masks are rough."""
    if is_here(NAME):
        return ""
    made = "following gives rough masks, from boxes and true masks alone"
    return f"The network {NAME} is not here: {made}. To have it, run: {FETCH} {NAME}"


def _with_true(masks: Mapping[int, np.ndarray], marks: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Return masks, and true ones from marks where there are no others."""
    true = {place: np.where(said > 0, 255, 0).astype(np.uint8) for place, said in marks.items() if said.all()}
    return true | dict(masks)
