"""The `bench` command: what is timed and counted, how tables and data are made from it. No time is ever asserted."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from markdown_lines import cells
from numba import njit

from rewild4d.benchmarks import first_image, floor, peers, probes, raster_bench
from rewild4d.benchmarks.results import BOTH, FLOOR, FORWARD, OURS, Result, Row
from rewild4d.benchmarks.scenes import SplatScene, coverage, splat_scene, step_config, training
from rewild4d.benchmarks.step_bench import REPORTED, loss_period
from rewild4d.benchmarks.tables import markdown
from rewild4d.benchmarks.timing import Sample, measure, summary, threads
from rewild4d.ours.symmetry import Key
from rewild4d.transforms import quat_to_matrix


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tiny tensors on a busy machine: threads only wait for each other."""
    with threads(1):
        yield


@pytest.fixture(scope="module")
def scene() -> SplatScene:
    return splat_scene(200, 32)


@pytest.mark.parametrize(("count", "size"), [(200, 32), (2000, 96)])
def test_the_animal_covers_a_quarter(count: int, size: int) -> None:
    made = splat_scene(count, size)
    assert len(made) == count
    assert 0.20 <= coverage(made) <= 0.30
    again = splat_scene(count, size)
    assert all(torch.equal(a, b) for a, b in zip(made.gaussians, again.gaussians, strict=True))


def brute_force(scene: SplatScene) -> list[tuple[int, int]]:
    """(pixel, Gaussian) of every useful blend, one pixel at a time, from a dense projection in plain torch."""
    means, quats, scales, opacities, _ = (tensor.double() for tensor in scene.gaussians)
    matrix, pinhole = scene.world_to_camera[0].double(), scene.intrinsics[0].double()
    local = means @ matrix[:3, :3].T + matrix[:3, 3]
    turns = quat_to_matrix(quats)
    covariances = []
    for point, turn, scale in zip(local, turns, scales, strict=True):
        jacobian = torch.autograd.functional.jacobian(lambda p: (pinhole @ p)[:2] / p[2], point)
        spread = matrix[:3, :3] @ turn @ torch.diag(scale.square()) @ turn.T @ matrix[:3, :3].T
        covariances.append(jacobian @ spread @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64))
    forms = torch.stack(covariances).inverse()
    centers = (local @ pinhole.T)[:, :2] / local[:, 2:]
    order = local[:, 2].float().argsort(stable=True).tolist()
    found = []
    for pixel in range(scene.size**2):
        offsets = torch.tensor((pixel % scene.size + 0.5, pixel // scene.size + 0.5)) - centers
        alphas = opacities * (-0.5 * torch.einsum("na,nab,nb->n", offsets, forms, offsets)).exp()
        left = 1.0
        for index in order:
            alpha = min(0.99, float(alphas[index]))
            if alpha < 1 / 255:
                continue
            if left * (1 - alpha) <= 1e-4:
                break
            left *= 1 - alpha
            found.append((pixel, index))
    return found


def test_useful_blends_are_counted_exactly(scene: SplatScene) -> None:
    expected = brute_force(scene)
    blends = floor.list_blends(scene)
    assert list(zip(blends.pixels.tolist(), blends.gaussians.tolist(), strict=True)) == expected
    assert floor.count_blends(scene) == len(expected)
    # Transparent Gaussians close no pixel, those under 1/255 blend nowhere.
    means, quats, scales, opacities, colors = scene.gaussians
    thin = replace(scene, gaussians=(means, quats, scales, opacities * 0.2, colors))
    assert 0 < floor.count_blends(thin) == len(brute_force(thin)) != len(expected)
    none = replace(scene, gaussians=(means, quats, scales, torch.full_like(opacities, 0.9 / 255), colors))
    assert floor.count_blends(none) == 0


def test_the_floor_is_its_formula() -> None:
    # 3 million blends x 40 operations at 400 GFLOP/s.
    assert floor.floor_ms(3_000_000, floor.FLOPS_FORWARD, 400) == pytest.approx(3e6 * 40 / 400e9 * 1e3)
    assert (floor.FLOPS_FORWARD, floor.FLOPS_BOTH) == (40, 110)
    with threads(1):
        one = floor.multiply_adds_flops(4)
    assert one == 2 * 16 * 4 * floor.ROUNDS
    with threads(2):
        assert floor.multiply_adds_flops(8) == 4 * one


def test_contenders_take_turns_and_only_the_second_call_counts() -> None:
    now, calls = 0.0, []

    def contender(name: str, seconds: list[float]) -> Callable[[], None]:
        left = iter(seconds)

        def call() -> None:
            nonlocal now
            calls.append(name)
            now += next(left)

        return call

    found = measure(
        {"a": contender("a", [9, 1, 9, 3, 9, 2]), "b": contender("b", [50, 7, 50, 5])},
        3,
        "test",
        budget=100,
        clock=lambda: now,
    )
    assert "".join(calls) == "aabb" * 2 + "aa"  # b has spent its 100 s after two turns
    assert found["a"] == Sample(median=2000, minimum=1000, spread=1000, repeats=3)
    assert found["b"] == Sample(median=6000, minimum=5000, spread=1000, repeats=2)
    assert summary([4.0]) == Sample(4.0, 4.0, 0.0, 1)


def test_peers_draw_our_image(scene: SplatScene) -> None:
    ours = scene.render()[0]
    twin, dense = peers.PEERS
    assert peers.psnr(dense.prepare(scene)(scene.gaussians), ours) > 90
    with pytest.raises(peers.NotTimed, match=r"not timed: 2\.1e\+08 Gaussians x pixels"):
        dense.prepare(replace(scene, size=1024))
    pytest.importorskip("gsplat")
    assert peers.psnr(twin.prepare(scene)(scene.gaussians), ours) > 90


def test_psnr_is_arithmetic() -> None:
    image = torch.zeros(3, 4, 4)
    assert peers.psnr(image + 0.1, image) == pytest.approx(20, abs=1e-5)
    assert peers.psnr(image, image) == math.inf


def test_a_peer_that_cannot_be_timed_gets_a_sentence_and_no_number(
    scene: SplatScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named '{name}'", name=name.split(".")[0])

    def breaks(gaussians: tuple[torch.Tensor, ...]) -> torch.Tensor:
        raise RuntimeError("needs a GPU")

    monkeypatch.setattr(peers, "import_module", missing)
    black = peers.Peer("black", "black", lambda scene: lambda gaussians: torch.zeros(3, scene.size, scene.size))
    broken = peers.Peer("broken", "broken", lambda scene: breaks)
    rows = raster_bench.scene_rows(scene, 1, (peers.PEERS[0], black, broken), "test")
    notes = {row.subject: row.note for row in rows if row.quantity == FORWARD and row.value is None}
    assert notes["gsplat's torch twin"] == "not installed: pip install gsplat"
    assert re.fullmatch(r"not timed: another image \(\d+ dB\)", notes["black"])
    assert notes["broken"] == "failed: RuntimeError: needs a GPU"
    assert {row.subject for row in rows if row.quantity == BOTH and row.value is not None} == {OURS, FLOOR}


def fixed(benchmark: str, rows: list[Row]) -> Result:
    return Result(
        benchmark=benchmark, command=["bench", benchmark], threads=2, settings={}, rows=rows, peers={"gsplat": "9.9"},
        started="2026-01-01T00:00:00+00:00", machine={"processor": "abacus", "system": "Linux", "torch": "1.2"},
        code={"version": "0", "sources": "abc"},
    )  # fmt: skip


def test_the_raster_table_is_arithmetic() -> None:
    def row(subject: str, quantity: str, value: float | None, unit: str = "ms", note: str = "") -> Row:
        return Row(subject=subject, quantity=quantity, value=value, unit=unit, gaussians=10_000, size=256, note=note)

    text = markdown(
        fixed(
            "rasterizer",
            [
                row("scene", "useful blends", 800_000, "1"),
                row(OURS, FORWARD, 2.0),
                row(OURS, BOTH, 5.0),
                row(FLOOR, "multiply-adds", 400, "GFLOP/s"),
                row(FLOOR, FORWARD, 0.08),
                row(FLOOR, BOTH, 0.22),
                row("snail", FORWARD, 30.0, note="starts in the lead"),
                row("snail", BOTH, 60.0),
                row("snail", "PSNR against rewild4d", 81.0, "dB"),
                row("ghost", FORWARD, None, note="not installed: pip install ghost"),
                row("ghost", BOTH, None, note="not installed: pip install ghost"),
                row(OURS, "peak memory", 42.5, "MiB", "above the rest"),
                row(OURS, "kernels compiled", 39, "1"),
            ],
        )
    )
    ratios = [f"{2.0 / 0.08:.1f} x", f"{5.0 / 0.22:.1f} x"]
    assert cells(text, "10,000", "256²", "800,000") == ["2.00", "5.00", "0.0800", "0.220", "400", *ratios]
    against = ["30.0", "60.0", f"{30 / 2:.1f} x", f"{60 / 5:.1f} x", "81.0"]
    assert cells(text, "10,000", "256²", "snail") == against
    assert cells(text, "10,000", "256²", "ghost") == ["not installed: pip install ghost", "", "", "", ""]
    assert cells(text, "kernels compiled")[2] == "39"
    assert cells(text, "peak memory") == ["10,000", "256²", "42.5 MiB", "above the rest"]
    assert "snail: starts in the lead." in text and "ghost: not installed" not in text
    assert text.startswith("**bench rasterizer** on abacus, Linux, 2 threads; torch 1.2, gsplat 9.9; rewild4d 0 (abc)")


def test_the_step_table_is_arithmetic() -> None:
    step = Row(
        subject=OURS, quantity="step", value=40.0, unit="ms", gaussians=20_000, size=512, minimum=38.0, spread=3.0
    )
    share = Row(subject="aten::mm", quantity="share of a step", value=0.125, unit="1", size=512, note="3 calls a step")
    text = markdown(fixed("step", [step, REPORTED, share]))
    assert cells(text, "step", OURS) == ["20,000", "512²", "40.0", "38.0", "3.00", f"{1000 / 40:.1f}"]
    # 13 minutes over 10,000 iterations.
    assert cells(text, "step", "the paper, one A6000")[2] == f"{13 * 60 / 10_000 * 1000:.1f}"
    assert "the paper, one A6000: reported: " in text
    assert cells(text, "aten::mm") == ["12.5 %", "3 calls a step"]


def test_a_step_has_every_loss() -> None:
    trainer, index = training(32, 150, "paper")
    config = trainer.config
    assert (config.image_size, config.canonical.samples, config.iterations) == (32, 150, 20_000)
    figures = trainer.step(index)
    assert figures["gaussians"] == 150
    expected = {"pose_silhouette", "l1", "ssim", "silhouette", "skeleton", "tv", "compact", "smooth"}
    assert expected <= set(figures)
    every = config.density.every * config.iterations
    for late in (index + 1, round((index // every + 1) * every) - 1):
        trainer.step(late)
    assert len(trainer.model.gaussians) == 150, "no densification"
    # The three act in every 4th step under `quick` and in every step under `paper`.
    assert [loss_period(step_config(32, 150, preset)) for preset in ("quick", "paper")] == [4, 1]


def test_a_regulariser_that_acts_in_every_fourth_step_weighs_four_times_as_much() -> None:
    trainer, index = training(32, 150, "quick")
    assert not {"tv", "compact", "smooth"} & set(trainer.step(index + 1)), "the three act in every 4th step"
    key = Key(1, 1, 0)
    seldom, _ = trainer.losses(key, trainer.supervision.target(key), index)
    geometry = msgspec.structs.replace(trainer.config.geometry, tv_every=1, compact_every=1)
    trainer.config = msgspec.structs.replace(trainer.config, geometry=geometry)
    always, _ = trainer.losses(key, trainer.supervision.target(key), index + 1)
    for name in ("tv", "compact"):
        # The two calls differ by the jitter of time too, which moves posed points alone, and by little.
        assert seldom[name].item() == pytest.approx(4 * always[name].item(), rel=0.02), name


def test_a_first_image_tells_time_and_compiled_kernels(
    scene: SplatScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    probes._save(scene, tmp_path / "scene.pt")
    before = first_image.compiled_kernels()

    def plus_one(x: int) -> int:
        return x + 1

    plus_one.__module__ = "rewild4d.rasterizer.imagined"
    made = njit(plus_one)
    made.stats.cache_misses["int64"] += 1
    first_image.main(str(tmp_path / "scene.pt"))
    found = json.loads(capsys.readouterr().out)
    assert found["compiled"] >= before + 1
    seconds, alone, after, image, compiled = probes._start_rows("cold start", found | {"seconds": 7.0})
    assert (seconds.value, seconds.unit) == (7.0, "s")
    assert (alone.quantity, after.quantity) == ("cold start: torch", "cold start: after torch")
    assert after.value is not None and image.value is not None and after.value >= image.value
    assert (image.quantity, image.value) == ("cold start: first image", found["first_image"])
    assert (compiled.quantity, compiled.value) == ("cold start: kernels compiled", found["compiled"])


def test_peak_memory_is_above_what_was_held() -> None:
    # In a process of its own, as `bench` measures it: from this one the system may take pages back meanwhile.
    program = """
import json, torch
from rewild4d.benchmarks import probes
print(json.dumps(probes._peak(lambda: torch.ones(2**24))))  # 64 MiB
"""
    found = json.loads(subprocess.check_output([sys.executable, "-c", program], text=True))
    if not found:
        pytest.skip("this system does not tell a process its peak")
    assert 60 <= found["peak"] - found["before"] <= 90
    row = probes._memory_row({"before": 100.0, "peak": 142.0}, 1000, 64)
    assert (row.value, row.unit, row.repeats) == (42.0, "MiB", 1)
    assert probes._memory_row({}, 1000, 64).value is None
