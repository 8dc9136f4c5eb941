"""The exported GLB in a browser's own viewer (three.js, as viser's page has it): it is seen, and its motion plays."""

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
import viser
from browser import browser, needs_chromium
from toys import FRAMES, camera, make_toy, swing

from rewild4d.baselines.floors_config import PriorOnlyConfig
from rewild4d.baselines.prior_only import PriorOnly
from rewild4d.io.export import export
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.posed import posed_prior

pytestmark = [needs_chromium, pytest.mark.usefixtures("one_thread")]


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The template swings its legs."""
    clip, _ = make_toy()
    cameras, still = [camera(index) for index in range(FRAMES)], torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    times = torch.arange(FRAMES, dtype=torch.float64) / 10
    prior = posed_prior(
        QUADRUPED.build(), swing(0.6), still, cameras, times, name="toy", provenance="toy", digest="toy"
    )
    made = PriorOnly().fit(
        clip, prior, config=PriorOnlyConfig(gaussians=400), seed=0, device=torch.device("cpu"), log=lambda *_: None,
        workdir=None,
    )  # fmt: skip
    (path,) = export(made, clip, ["glb"], tmp_path_factory.mktemp("glb"))
    return Path(path).read_bytes()


@pytest.fixture
def tab(glb: bytes) -> Iterator[Any]:
    """A page that shows the file from the animal's side."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server.scene.set_up_direction("+y")
    server.scene.add_glb("/animal", glb)

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        client.camera.position, client.camera.look_at = (9.0, 1.0, 0.0), (0.0, 0.0, 0.0)

    with browser() as opened:
        page = opened.new_page(viewport={"width": 1000, "height": 400})
        page.goto(f"http://127.0.0.1:{server.get_port()}/")
        yield page
    server.stop()


def animal(page: Any) -> np.ndarray:
    """Where the picture is red, as the animal's front is, bool, [h, w], between what the page lays over its sides."""
    shown = imageio.imread(BytesIO(page.screenshot(timeout=120_000)))[:, 290:660].astype(int)
    return shown[..., 0] - shown[..., 2] > 60


def test_it_is_seen_and_its_motion_plays(tab: Any) -> None:
    found: list[np.ndarray] = []
    for _ in range(120):
        tab.wait_for_timeout(500)
        seen = animal(tab)
        if 0.005 < seen.mean() < 0.5:
            found.append(seen)
        # the camera moves at first
        if len(found) > 3 and (found[2] ^ found[-1]).sum() > 0.1 * found[2].sum():
            return
    assert found, "nothing is seen"
    raise AssertionError("nothing moves")
