"""The Gaussian competitors: the contract of all four at tiny size, resuming after a kill, and what they share."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from dying import Killed, kill_late

from rewild4d.baselines.common.splatting import STATE, reset_opacities, surface_gaussians
from rewild4d.baselines.common.volume import SCENE_HALF, common_volume, random_points, scene_frame
from rewild4d.baselines.d3dgs import D3dgs, D3dgsConfig, D3dgsStar, D3dgsStarConfig, random_gaussians
from rewild4d.baselines.d3dgs_network import DeformationNetwork, NetworkShape, octave_code
from rewild4d.baselines.gart import Gart, GartStar
from rewild4d.baselines.gart_config import GartConfig, GartStarConfig
from rewild4d.config import load_preset, preset_names
from rewild4d.errors import UserError
from rewild4d.kernels.halves import available
from rewild4d.ours.canonical import NAMES, Gaussians
from rewild4d.ours.config import Canonical
from rewild4d.ours.motion import Root
from rewild4d.registry import load_method
from rewild4d.running.conformance import check_method, tiny_case
from rewild4d.transforms import camera_in_object
from rewild4d.types import Case

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = torch.device("cpu")
SHORT: dict[str, Any] = {
    "image_size": 64,
    "iterations": 12,
    "checkpoint_every": 5,
    "canonical": {"samples": 150, "sh_degree": 1},
    "density": {"every": 0.25, "start": 0.0, "end": 0.8, "cap": 180, "gradient": 0.0},
    "resets": {"every": 0.5},
}
NETWORK = {"network": {"width": 16, "time_width": 8, "time_features": 4}, "motion": {"warm_up": 0.2}}
GRID = {"skinning": {"resolution": 8, "neighbours": 4, "sweeps": 1}, "poses": {"rate": 1e-2}}
TINY = {
    "d3dgs": msgspec.convert(SHORT | NETWORK, D3dgsConfig),
    "d3dgs-star": msgspec.convert(SHORT | NETWORK, D3dgsStarConfig),
    "gart": msgspec.convert(SHORT | GRID, GartConfig),
    "gart-star": msgspec.convert(SHORT | GRID | {"refine": {"steps": 3}}, GartStarConfig),
}


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def quiet(step: int, total: int, values: object) -> None:
    """Log nothing."""


def fitted(name: str, case: Case, **given: Any) -> Any:
    options = {"config": TINY[name], "seed": 0, "device": CPU, "log": quiet, "workdir": None} | given
    return load_method(name).fit(case.clip, case.prior, **options)


@pytest.mark.parametrize("name", TINY)
def test_the_contract_is_kept(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rewild4d.running.conformance.load_preset", lambda *_: TINY[name])
    assert [finding.message for finding in check_method(name, "quick")] == ["kept"] * 5


@pytest.mark.parametrize("name", TINY)
def test_a_killed_fit_resumes_to_the_same_bits(name: str, case: Case, tmp_path: Path) -> None:
    whole = fitted(name, case)
    with pytest.raises(Killed):
        fitted(name, case, log=kill_late, workdir=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    resumed = fitted(name, case, workdir=tmp_path)
    other = fitted(name, case, seed=1)
    for time in (0.0, 0.17):
        a, b, c = (each.at(time) for each in (whole, resumed, other))
        assert all(torch.equal(getattr(a, key), getattr(b, key)) for key in ("means", "quats", "scales", "colors"))
        assert not torch.equal(a.colors[:50], c.colors[:50])
    assert len(whole.at(0.0)) == SHORT["density"]["cap"]


@pytest.mark.parametrize("name", TINY)
def test_a_state_that_does_not_fit_is_one_sentence(name: str, case: Case, tmp_path: Path) -> None:
    fitted(name, case).save(tmp_path)
    state = torch.load(tmp_path / STATE)
    for change in ({"model": {}}, {"root": None}, {"model": dict.fromkeys(state["model"])}):
        torch.save(state | change, tmp_path / STATE)
        with pytest.raises(UserError, match=f"expected a reconstruction by '{name}', but what it holds does not fit"):
            load_method(name).load(tmp_path, CPU)


@pytest.mark.parametrize("name", TINY)
def test_every_preset_keeps_what_it_does_not_name(name: str) -> None:
    method = load_method(name)
    assert preset_names(name) == ["quick", "standard", "paper", "paper-short"]
    defaults = method.Config()
    for preset in preset_names(name):
        config = load_preset(name, method.Config, preset)
        assert type(config.canonical) is type(defaults.canonical)
        assert (config.rates.quats, config.loss.l1) == (defaults.rates.quats, defaults.loss.l1)
    paper = load_preset(name, method.Config, "paper")
    assert paper.image_size == 512 and paper.canonical.sh_degree == 3


@pytest.mark.parametrize("name", TINY)
def test_a_reset_is_not_a_sentence_to_death(name: str) -> None:
    """What a reset leaves is above the limit under which Gaussians are pruned, wherever there are resets."""
    method = load_method(name)
    configs = [method.Config(), *(load_preset(name, method.Config, preset) for preset in preset_names(name))]
    assert any(config.resets.every for config in configs)
    for config in configs:
        if config.resets.every:
            assert config.resets.opacity > config.density.prune_opacity


def test_losing_every_gaussian_is_said(case: Case) -> None:
    harsh = msgspec.convert(SHORT | GRID | {"density": SHORT["density"] | {"prune_opacity": 1.0}}, GartConfig)
    with pytest.raises(
        FloatingPointError, match="iteration 2: no Gaussian is left; every opacity fell below the limit"
    ):
        fitted("gart", case, config=harsh)


def test_what_tables_say_of_them() -> None:
    said = {method.info.title: method.info for method in (D3dgs(), D3dgsStar(), Gart(), GartStar())}
    assert [title for title, info in said.items() if info.mark] == ["GART* (20 bones)"]
    assert [title for title, info in said.items() if not info.uses_prior] == ["D-3DGS"]


def test_an_unreadable_reconstruction_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"expected a reconstruction by 'gart', but it has no state\.pt"):
        Gart().load(tmp_path, CPU)
    (tmp_path / "state.pt").write_bytes(b"no state")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="expected a saved reconstruction, but it is cut off or another file"):
        D3dgsStar().load(tmp_path, CPU)


def test_a_fit_on_other_cameras_moves_with_the_world(case: Case) -> None:
    """D-3DGS knows nothing but the clip: the same pictures in a world shifted and turned give the same picture."""
    frame = scene_frame(case.clip, case.prior)
    center, half = common_volume([each.camera for each in case.clip.frames])  # type: ignore[misc]
    scene = frame.object_to_world[0]
    torch.testing.assert_close(scene[:3, 3], center)
    assert float(scene[0, 0]) == pytest.approx(half / SCENE_HALF)
    assert torch.equal(frame.object_to_world[0], frame.object_to_world[-1])
    # The ring of cameras looks at the animal's root.
    torch.testing.assert_close(center, case.prior.object_to_world[0, :3, 3], atol=0.05, rtol=0)
    seen = frame.cameras[1].project(torch.zeros(1, 3))[0]
    expected = case.clip.frames[1].camera.project(center[None].float())[0]  # type: ignore[union-attr]
    torch.testing.assert_close(seen, expected, atol=1e-3, rtol=0)


def test_without_world_cameras_the_priors_are_taken(case: Case) -> None:
    blind = replace(case.clip, frames=tuple(replace(frame, camera=None) for frame in case.clip.frames))
    known, guessed = (scene_frame(clip, case.prior) for clip in (case.clip, blind))
    torch.testing.assert_close(known.object_to_world, guessed.object_to_world)
    for a, b in zip(known.cameras, guessed.cameras, strict=True):
        torch.testing.assert_close(a.world_to_camera, b.world_to_camera)


def test_random_points_lie_in_every_image(case: Case) -> None:
    frame = scene_frame(case.clip, case.prior)
    points = random_points(100, frame.cameras, torch.Generator().manual_seed(0))
    for camera in frame.cameras:
        pixels, depth = camera.project(points)
        assert (depth > 0).all() and (pixels >= 0).all()
        assert (pixels[:, 0] <= camera.width).all() and (pixels[:, 1] <= camera.height).all()
    values = random_gaussians(points, Canonical(opacity=0.1))
    distance = torch.cdist(points, points).topk(4, largest=False).values[:, 1:]
    torch.testing.assert_close(values["log_scales"][:, 0].exp(), distance.square().mean(1).sqrt(), atol=1e-4, rtol=1e-3)
    assert float(values["logit_opacities"][0].sigmoid()) == pytest.approx(0.1)


def test_one_fixed_camera_takes_the_origins_depth(case: Case) -> None:
    camera = case.clip.frames[0].camera
    assert camera is not None
    center, _ = common_volume([camera, camera])
    sight = torch.nn.functional.normalize(camera.world_to_camera[2, :3], dim=0)
    # The foot of the perpendicular from the origin on the line of sight (the image centre is the principal point).
    foot = camera.center - sight * (camera.center @ sight)
    torch.testing.assert_close(center, foot, atol=2e-3 * float(foot.norm() + 1), rtol=0)


def test_the_star_starts_as_the_prior_looks(case: Case) -> None:
    values = surface_gaussians(
        case.prior, case.clip, case.prior.transforms[0], Canonical(samples=400), torch.Generator().manual_seed(0)
    )
    target, camera = case.clip.frames[0], case.prior.cameras[0]
    pixels, _ = camera.project(values["means"])
    column, row = pixels.long().unbind(-1)
    inside = target.mask[0, row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    assert float((inside > 0.3).float().mean()) > 0.95


def test_the_octave_code() -> None:
    values = torch.tensor([[0.3, -0.2]])
    expected = [0.3, -0.2]
    expected += [math.sin(2**k * x) for k in range(3) for x in (0.3, -0.2)]
    expected += [math.cos(2**k * x) for k in range(3) for x in (0.3, -0.2)]
    torch.testing.assert_close(octave_code(values, 3)[0], torch.tensor(expected))


def test_the_network_is_the_originals() -> None:
    """Against the layers written out one by one, with the input joined to the fifth layer's output."""
    shape = NetworkShape(width=12, time_width=7, time_features=5, place_octaves=2, time_octaves=3, half=False)
    network = DeformationNetwork(shape, torch.Generator().manual_seed(0))
    torch.nn.init.normal_(network.heads.weight, generator=torch.Generator().manual_seed(1))
    points, time = torch.randn(6, 3, generator=torch.Generator().manual_seed(2)), torch.tensor(-0.4)
    moment = network.time_out(torch.relu(network.time_in(octave_code(time.reshape(1), 3))))
    given = torch.cat((octave_code(points, 2), moment.expand(6, -1)), dim=1)
    hidden = torch.relu(network.first(given))
    for index in range(7):
        joined = torch.cat((hidden, given), dim=1) if index == 4 else hidden
        weight = torch.cat((network.layers[index].weight, network.again.weight), dim=1) if index == 4 else None
        layer = network.layers[index]
        if weight is None:
            hidden = torch.relu(layer(joined))
        else:
            hidden = torch.relu(joined @ weight.T + layer.bias + network.again.bias)
    expected = network.heads(hidden)
    torch.testing.assert_close(torch.cat(network(points, time), dim=1), expected, atol=1e-5, rtol=1e-5)
    sizes = [tuple(layer.weight.shape) for layer in DeformationNetwork(NetworkShape(), torch.Generator()).layers]
    assert sizes == [(256, 256)] * 7


@pytest.mark.skipif(not available(), reason="this CPU does not multiply bfloat16 pairs")
def test_the_network_in_bfloat16_is_that_of_single_precision() -> None:
    """But for what eight bits of a number lose: a percent of the outputs; gradients point the same way."""
    points, time = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) * 2 - 1, torch.tensor(-0.4)
    results = []
    for half in (True, False):
        network = DeformationNetwork(NetworkShape(width=64, half=half), torch.Generator().manual_seed(0))
        torch.nn.init.normal_(network.heads.weight, generator=torch.Generator().manual_seed(1))
        made = torch.cat(network(points, time), dim=1)
        assert made.dtype == torch.float32
        made.square().mean().backward()
        results.append([made.detach(), *(each.grad for each in network.parameters())])
    errors = [float((rounded - exact).norm() / exact.norm()) for rounded, exact in zip(*results, strict=True)]
    assert 1e-4 < errors[0] < 0.01
    assert max(errors[1:]) < 0.15


def test_flips_are_seen_at_negative_times(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    times: dict[str, set[int]] = {}

    def spy(name: str) -> None:
        seen = times.setdefault(name, set())
        forward = DeformationNetwork.forward

        def watched(self: DeformationNetwork, points: torch.Tensor, time: torch.Tensor) -> Any:
            seen.add(1 if float(time) > 0 else -1)
            return forward(self, points, time)

        with monkeypatch.context() as patch:
            patch.setattr(DeformationNetwork, "forward", watched)
            fitted(name, case)

    for name in ("d3dgs", "d3dgs-star"):
        spy(name)
    assert times == {"d3dgs": {1}, "d3dgs-star": {1, -1}}


def test_a_reset_lowers_opacities_and_forgets_moments() -> None:
    values = {
        "means": torch.zeros(3, 3), "quats": torch.ones(3, 4), "log_scales": torch.zeros(3, 3),
        "logit_opacities": torch.tensor((-6.0, 0.0, 4.0)), "colors": torch.zeros(3, 1, 3),
    }  # fmt: skip
    own = Gaussians(values, 0.05)
    optimizer = torch.optim.Adam([{"params": [getattr(own, name)]} for name in NAMES], lr=0.0)
    own.opacities().sum().backward()
    optimizer.step()
    reset_opacities(own, optimizer, 0.05)
    expected = torch.tensor((1 / (1 + math.exp(6)), 0.05, 0.05))
    torch.testing.assert_close(own.opacities().detach(), expected)
    assert optimizer.state[own.logit_opacities]["exp_avg"].abs().max() == 0


def test_the_frame_of_reference_between_frames(case: Case) -> None:
    root = Root.of(case.clip, case.prior)
    assert root.position(0.15) == pytest.approx(1.5)
    again = Root.from_state(root.state())
    assert torch.equal(again.object_to_world, root.object_to_world)
    found, wanted = again.camera(0.1), case.clip.frames[1].camera
    assert found is not None and wanted is not None and torch.equal(found.world_to_camera, wanted.world_to_camera)
    world = camera_in_object(wanted, root.object_to_world[1])
    torch.testing.assert_close(world.world_to_camera, case.prior.cameras[1].world_to_camera)
