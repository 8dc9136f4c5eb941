"""`bench rasterizer`: forward and backward of our rasterizer, of its peers, and the arithmetic lower bound."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from rewild4d.benchmarks import floor, probes
from rewild4d.benchmarks.peers import PEERS, SAME_PSNR, NotTimed, Peer, Render, psnr
from rewild4d.benchmarks.results import BOTH, FLOOR, FORWARD, OURS, Row, single_row, timed_row
from rewild4d.benchmarks.scenes import SplatScene, splat_scene
from rewild4d.benchmarks.timing import measure, per
from rewild4d.ours.graphs import CudaRecorder, room_for
from rewild4d.rasterizer import rooms

Contenders = dict[tuple[str, str], Callable[[], object]]
"""Calls to time, by subject and quantity."""
RECORDED = f"{OURS} in a CUDA graph"
QUEUED = 10
"""Consecutive calls on a GPU before it is waited for, since it works while the next call is prepared."""
CPU = torch.device("cpu")


def bench_rasterizer(
    counts: Sequence[int],
    sizes: Sequence[int],
    repeats: int,
    peers: Sequence[Peer] = PEERS,
    probe: bool = True,
    device: torch.device = CPU,
) -> list[Row]:
    """Time every number of Gaussians at every image side in pixels, on the CPU or a CUDA GPU.

    ``probe`` adds peak memory (of the largest scene) and, on the CPU, start-up, in their own processes.
    """
    scenes = [(count, size) for count in counts for size in sizes]
    rows: list[Row] = []
    for index, (count, size) in enumerate(scenes, 1):
        title = f"[{index}/{len(scenes)}] {count:,} at {size}²"
        rows += scene_rows(splat_scene(count, size), repeats, peers, title, device)
    if not probe:
        return rows
    if device.type == "cuda":
        return [*rows, probes.gpu_memory_row(splat_scene(max(counts), max(sizes)).to(device))]
    return rows + probes.raster_rows(max(counts), max(sizes))


def scene_rows(
    scene: SplatScene, repeats: int, peers: Sequence[Peer], title: str, device: torch.device = CPU
) -> list[Row]:
    """Measure one scene, given on the CPU."""
    count, size = len(scene), scene.size
    blends, placed = floor.count_blends(scene), scene.to(device)
    rows = [single_row("scene", "useful blends", blends, "1", count, size)]
    admitted = {peer: _admit(peer, placed) for peer in peers}
    contenders = _calls(OURS, lambda gaussians: placed.render(gaussians)[0], placed)
    if device.type == "cuda":
        contenders |= _recorded(contenders, device)
    for calls, _ in admitted.values():
        contenders |= calls
    arithmetic, flops = _arithmetic(device)
    samples = measure({name: _queued(call, device) for name, call in (contenders | arithmetic).items()}, repeats, title)
    if device.type == "cuda":
        samples = {name: per(sample, QUEUED) for name, sample in samples.items()}

    def timed(subject: str, note: str = "") -> list[Row]:
        return [timed_row(*key, samples[key], count, size, note) for key in contenders if key[0] == subject]

    gflops = max(flops[key] / samples[key].median / 1e6 for key in arithmetic)
    rows.append(single_row(FLOOR, "multiply-adds", gflops, "GFLOP/s", count, size))
    for quantity, each in ((FORWARD, floor.FLOPS_FORWARD), (BOTH, floor.FLOPS_BOTH)):
        rows.append(single_row(FLOOR, quantity, floor.floor_ms(blends, each, gflops), "ms", count, size))
    rows += timed(OURS) + timed(RECORDED, "replayed, with room for 1.4 times its pairs")
    for peer, (_, found) in admitted.items():
        rows += [*found, *timed(peer.name, peer.note)]
    return rows


def _recorded(calls: Contenders, device: torch.device) -> Contenders:
    """Record our calls as CUDA graphs, as training steps on a GPU are."""
    recorder, made = CudaRecorder(device), dict[tuple[str, str], Callable[[], object]]()
    for (_, quantity), call in calls.items():
        with recorder.stream():
            with rooms.measured() as found:
                call()
            with rooms.given([room_for(int(pairs)) for pairs in found.pairs]):
                (made[RECORDED, quantity],) = recorder.record(call)
    return made


def _arithmetic(device: torch.device) -> tuple[Contenders, dict[tuple[str, str], int]]:
    """Return the multiply-adds to time, and the operations of each call."""
    if device.type == "cuda":
        from rewild4d.benchmarks import floor_cuda  # needs Triton

        key = (FLOOR, str(floor_cuda.CHAINS))
        return {key: partial(floor_cuda.multiply_adds, device)}, {key: floor_cuda.multiply_adds_flops(device)}
    keys = {chains: (FLOOR, str(chains)) for chains in floor.CHAINS}
    calls: Contenders = {key: partial(floor.multiply_adds, chains) for chains, key in keys.items()}
    return calls, {key: floor.multiply_adds_flops(chains) for chains, key in keys.items()}


def _queued(call: Callable[[], object], device: torch.device) -> Callable[[], object]:
    """Return the timed unit: a call, or on a GPU `QUEUED` of them and the wait for the last."""
    if device.type != "cuda":
        return call

    def queued() -> None:
        for _ in range(QUEUED):
            call()
        torch.cuda.synchronize(device)

    return queued


def _admit(peer: Peer, scene: SplatScene) -> tuple[Contenders, list[Row]]:
    """Return the calls of a peer that renders our image, and rows with its PSNR or the reason why it is not timed."""
    sizes = len(scene), scene.size

    def untimed(reason: str) -> list[Row]:
        return [single_row(peer.name, quantity, None, "ms", *sizes, reason) for quantity in (FORWARD, BOTH)]

    try:
        render = peer.prepare(scene)
        with torch.no_grad():
            alike = psnr(render(scene.gaussians), scene.render()[0])
    except Exception as error:
        if not (peer.package or isinstance(error, NotTimed)):
            raise
        # foreign code of another version may fail in any way: a line in the table, not the end of the run
        return {}, untimed(str(error) if isinstance(error, NotTimed) else f"failed: {type(error).__name__}: {error}")
    # equal images have no finite PSNR
    parity = single_row(peer.name, "PSNR against rewild4d", min(alike, 200.0), "dB", *sizes)
    if alike < SAME_PSNR:
        return {}, [parity, *untimed(f"not timed: another image ({alike:.0f} dB)")]
    return _calls(peer.name, render, scene), [parity]


def _calls(name: str, render: Render, scene: SplatScene) -> Contenders:
    leaves = tuple(tensor.clone().requires_grad_() for tensor in scene.gaussians)
    gradient = torch.rand(3, scene.size, scene.size, generator=torch.Generator().manual_seed(0)).to(leaves[0].device)

    def forward() -> Tensor:
        with torch.no_grad():
            return render(scene.gaussians)

    def both() -> tuple[Tensor, ...]:
        return torch.autograd.grad(render(leaves), leaves, gradient)

    return {(name, FORWARD): forward, (name, BOTH): both}
