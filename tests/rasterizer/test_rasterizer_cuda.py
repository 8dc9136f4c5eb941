"""The CUDA backends: Triton kernels in the interpreter and through the compiler, gsplat's adapter, who picks what."""

import importlib
import logging
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import splats
import torch
from splats import NAMES, hard_scene, outcome, render, scene, spoilt_scenes
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.rasterizer import backends, pick_rasterizer, reference, set_default
from rewild4d.rasterizer.conventions import RasterInput

WIDTH, HEIGHT = 20, 18
"""Nine tiles, five of them cut by the frame."""
FAR = 600
"""Pixels from the corner, where one number in single precision has steps that gradients of 1e-5 feel."""
KERNELS = ["project", "project_backward", "list_entries", "start_tiles", "gather", "blend", "blend_backward"]
CPU, CUDA = torch.device("cpu"), torch.device("cuda")
needs_triton = pytest.mark.skipif(bool(backends._missing("triton")), reason="triton is not installed here")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")

Case = tuple[dict[str, Tensor], int, int, dict[str, Any]]


def cases() -> dict[str, Case]:
    """Tiny scenes by name: inputs in double precision, image size, options."""
    made: dict[str, Case] = {}
    for channels, views, antialias in ((3, 1, False), (1, 2, True), (5, 2, False), (17, 1, True)):
        inputs = scene(40, channels, views, WIDTH, HEIGHT, seed=channels)
        made[f"{channels} channels"] = (inputs, WIDTH, HEIGHT, {"antialias": antialias})
    for kind in ("needles", "sub-pixel", "behind", "opaque", "faint", "huge", "tied"):
        inputs = hard_scene(kind, 1, 40, 3, 1, WIDTH, HEIGHT)
        made[kind] = (inputs, WIDTH, HEIGHT, {"antialias": kind == "needles"})
    plain = scene(40, 3, 2, WIDTH, HEIGHT, seed=4)
    made["no background"] = ({name: plain[name] for name in NAMES[:-1]}, WIDTH, HEIGHT, {})
    made["other options"] = (plain, WIDTH, HEIGHT, {"near": 4.5, "eps2d": 1.5})
    far = {name: value.float().double() for name, value in hard_scene("sub-pixel", 2, 40, 3, 1, WIDTH, HEIGHT).items()}
    far["intrinsics"][:, 0, 2] += FAR
    made["far from the corner"] = (far, WIDTH + FAR, HEIGHT, {})
    made["one pixel"] = (scene(4, 3, 1, 1, 1, seed=0), 1, 1, {})
    return made


CASES, SPOILT = cases(), spoilt_scenes()


@pytest.fixture(scope="module")
def interpreted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Tensor]]]:
    """Each case twice through the interpreter, which has to be asked for before Triton is imported: in a process."""
    folder = tmp_path_factory.mktemp("interpreted")
    empty = {f"empty, {count}": (nothing(count), WIDTH, HEIGHT, {}) for count in (0, 5)}
    spoilt = {name: (inputs, WIDTH, HEIGHT, {}) for name, (inputs, _) in SPOILT.items()}
    torch.save(CASES | empty | spoilt, folder / "cases.pt")
    words = [sys.executable, splats.__file__, str(folder / "cases.pt"), str(folder / "made.pt")]
    done = subprocess.run(words, env=os.environ | {"TRITON_INTERPRET": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return torch.load(folder / "made.pt")


def nothing(count: int) -> dict[str, Tensor]:
    """Gaussians that are all behind the camera, or none."""
    inputs = scene(count, 3, 2, WIDTH, HEIGHT, seed=0)
    return inputs | {"means": inputs["means"] - torch.tensor([0.0, 0, 100])}


def compare(name: str, found: dict[str, Tensor], tolerance: float) -> None:
    """Against the reference in double precision: 70 dB, and gradients of that relative error."""
    inputs, width, height, options = CASES[name]
    expected = outcome(inputs, width, height, backend="reference", **options)
    for key in ("image", "alpha"):
        error = (found[key].cpu() - expected[key]).square().mean().item()
        assert error <= 1e-7, f"{key}: PSNR {-10 * math.log10(error):.1f} dB"
    assert torch.allclose(found["radii"].cpu().double(), expected["radii"], rtol=1e-5)
    for key in (key for key in expected if key.startswith("d ")):
        relative = (found[key].cpu() - expected[key]).norm() / expected[key].norm().clamp_min(1e-30)
        assert relative <= tolerance, f"{key}: {relative:.1e}"


@needs_triton
@pytest.mark.parametrize("name", CASES)
def test_interpreted_kernels_equal_the_reference(name: str, interpreted: dict[str, list[dict[str, Tensor]]]) -> None:
    once, again = interpreted[name]
    compare(name, once, tolerance=1e-5)
    assert all(torch.equal(once[key], again[key]) for key in once), "not the same bits twice"


@needs_triton
@pytest.mark.parametrize("count", [0, 5])
def test_interpreted_kernels_draw_the_background_of_an_empty_scene(
    count: int, interpreted: dict[str, list[dict[str, Tensor]]]
) -> None:
    made, background = interpreted[f"empty, {count}"][0], nothing(count)["background"].float()
    assert torch.equal(made["image"], background[:, :, None, None].expand(2, 3, HEIGHT, WIDTH))
    assert made["alpha"].abs().sum() == 0 and made["radii"].abs().sum() == 0
    assert all(made[f"d {name}"].abs().sum() == 0 for name in NAMES[:-1])


@needs_triton
@pytest.mark.parametrize("name", SPOILT)
def test_the_kernels_themselves_find_bad_numbers(name: str, interpreted: dict[str, Any]) -> None:
    said = SPOILT[name][1]
    assert isinstance(interpreted[name], str) and re.match(said, interpreted[name]), interpreted[name]


@needs_triton
@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize("name", KERNELS)
def test_kernels_compile_without_a_gpu(
    name: str, capability: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    compiled = compile_kernel(name, capability)
    assert f".target sm_{capability}" in compiled.asm["ptx"]
    assert compiled.asm["cubin"][:4] == b"\x7fELF"
    # A sum over channels that Triton turns into a product runs in TF32; the interpreter cannot see that.
    assert "tt.dot" not in compiled.asm["ttir"] and "mma" not in compiled.asm["ptx"]
    tool = Path(importlib.import_module("triton").__file__ or "").parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    if tool.is_file():
        (tmp_path / "kernel.cubin").write_bytes(compiled.asm["cubin"])
        usage = subprocess.check_output([tool, "-res-usage", tmp_path / "kernel.cubin"], text=True)
        registers, stack = map(int, re.findall(r"REG:(\d+) STACK:(\d+)", usage)[0])
        print(f"{name}, sm_{capability}: {registers} registers, {stack} bytes spilt")
        assert stack <= 64


TYPES = {
    **dict.fromkeys(("keys", "first_keys", "starts", "slots", "ends"), "*i64"),
    **dict.fromkeys(("wides", "owners", "entries"), "*i32"),
    **{"v_cameras": "*fp64", "eps2d": "fp32", "near": "fp32"},
}
"""Of all arguments that are neither sizes nor single precision arrays."""
CONSTANTS = {"CHANNELS": 3, "PART": 4, "ANTIALIAS": True, "CAMERAS": True, "KEEP": True}


def compile_kernel(name: str, capability: int) -> Any:
    from triton import compile
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from rewild4d.rasterizer import cuda, triton_blend, triton_project, triton_tiles

    modules = (triton_project, triton_tiles, triton_blend)
    module = next(module for module in modules if hasattr(module, name))
    kernel, launch = getattr(module, name), cuda.LAUNCHES[name]
    if not hasattr(kernel, "cache_key"):
        pytest.skip("TRITON_INTERPRET is set: there is nothing to compile")
    constants = CONSTANTS | {word: value for word, value in launch.items() if word.isupper()}
    used = {word: value for word, value in constants.items() if word in kernel.arg_names}
    types = TYPES | ({} if name == "blend_backward" else {"tiles": "*i32"})
    types = types | {size: "i32" for size in module.SIZES if size not in types}
    signature = {word: "constexpr" if word in used else types.get(word, "*fp32") for word in kernel.arg_names}
    options = {word: value for word, value in launch.items() if not word.isupper()}
    return compile(ASTSource(kernel, signature, used), GPUTarget("cuda", capability, 32), options=options)


@needs_gpu
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("backend", ["triton", "gsplat"])
def test_gpu_equals_the_reference(name: str, backend: str) -> None:
    if reason := backends._unfit(backend, CUDA, torch.float32):
        pytest.skip(reason)
    inputs, width, height, options = CASES[name]
    single = {key: tensor.float().to(CUDA) for key, tensor in inputs.items()}
    if backend == "triton":
        once, again = (outcome(single, width, height, backend=backend, **options) for _ in range(2))
        compare(name, once, tolerance=1e-4)
        assert all(torch.equal(once[key], again[key]) for key in once), "not the same bits twice"
    else:
        if name == "opaque":
            pytest.skip("gsplat caps alpha at 0.999, not at 0.99")
        image = render(single, width, height, backend=backend, **options)[0].cpu()
        expected = render(inputs, width, height, backend="reference", **options)[0]
        assert (image - expected).square().mean() <= 1e-6, "below 60 dB"


@needs_gpu
@pytest.mark.parametrize("name", SPOILT)
def test_bad_numbers_on_a_gpu_are_named(name: str) -> None:
    inputs, said = SPOILT[name]
    with pytest.raises(ValueError, match=said):
        render({key: tensor.to(CUDA) for key, tensor in inputs.items()}, WIDTH, HEIGHT)


class StubGsplat(ModuleType):
    """Takes what gsplat.rasterization takes, gives what it gives, and leaves the drawing to the reference."""

    def rasterization(self, *arrays: Any, near_plane: float, eps2d: float, backgrounds: Tensor | None,
                      rasterize_mode: str, packed: bool, sh_degree: None) -> tuple[Tensor, Tensor, dict]:  # fmt: skip
        assert not packed and sh_degree is None and rasterize_mode in ("classic", "antialiased")
        antialias = rasterize_mode == "antialiased"
        image, alpha, info = reference.rasterize(RasterInput(*arrays, backgrounds, eps2d, antialias, near_plane))
        boxes = info.radii.ceil().int()[..., None] * torch.tensor([1, 0], dtype=torch.int32)
        return image.movedim(1, -1), alpha.movedim(1, -1), {"means2d": info.means2d, "radii": boxes}


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """The adapter's `rasterize` over the stub."""
    name = "rewild4d.rasterizer.gsplat_backend"
    monkeypatch.setitem(sys.modules, "gsplat", StubGsplat("gsplat"))
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module(name).rasterize
    sys.modules.pop(name, None)


@pytest.mark.parametrize("name", ["3 channels", "1 channels", "no background", "other options"])
def test_gsplat_gets_and_gives_what_the_reference_does(name: str, adapter: Callable[..., Any]) -> None:
    inputs, width, height, options = CASES[name]
    options = {"eps2d": 0.3, "antialias": False, "near": 0.01} | options
    results = []
    for function in (reference.rasterize, adapter):
        leaves = {key: tensor.clone().requires_grad_(key != "intrinsics") for key, tensor in inputs.items()}
        arrays = (leaves[key] for key in NAMES[:-1])
        image, alpha, info = function(RasterInput(*arrays, width, height, leaves.get("background"), **options))
        (image.square().sum() + alpha.sum()).backward()
        results.append([image, alpha, info.radii.ceil(), info.means2d.grad, leaves["means"].grad])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_gsplat_refuses_to_differentiate_the_intrinsics(adapter: Callable[..., Any]) -> None:
    inputs = {name: tensor.requires_grad_() for name, tensor in scene(4, 3, 1, 8, 8, 0).items()}
    with pytest.raises(ValueError, match="gsplat.* no gradient for them"):
        adapter(RasterInput(*(inputs[name] for name in NAMES[:-1]), 8, 8, None, 0.3, False, 0.01))


def test_gsplat_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    inputs = {name: tensor.float() for name, tensor in scene(4, 3, 1, 8, 8, 0).items()}
    with pytest.raises(ValueError, match=r"backend 'gsplat': gsplat is not installed here \(pip install"):
        render(inputs, 8, 8, backend="gsplat")
    with pytest.raises(UserError, match="--rasterizer gsplat: gsplat is not installed here"):
        pick_rasterizer("gsplat", CPU)


@needs_triton
def test_triton_without_a_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    inputs = {name: tensor.float() for name, tensor in scene(4, 3, 1, 8, 8, 0).items()}
    with pytest.raises(ValueError, match="expected float32 on a CUDA GPU, or TRITON_INTERPRET=1"):
        render(inputs, 8, 8, backend="triton")
    with pytest.raises(UserError, match=r"--rasterizer triton: expected float32 on a CUDA GPU.* on cpu\.$"):
        pick_rasterizer("triton", CPU)
    with pytest.raises(UserError, match=r"--rasterizer numba: expected float32 on the CPU, .* on cuda\.$"):
        pick_rasterizer("numba", CUDA)


@pytest.mark.parametrize(
    ("there", "picked", "said"),
    [
        ({"triton", "gsplat"}, "triton", "torch.float32 on cuda renders with triton"),
        ({"gsplat"}, "gsplat", "torch.float32 on cuda renders with gsplat"),
        (set(), "reference", "for small scenes only: no triton; no gsplat"),
    ],
)
def test_auto_on_a_gpu_takes_the_first_that_is_there(
    there: set[str], picked: str, said: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(backends, "_unfit", lambda name, *_: "" if name in there else f"no {name}")
    backends._automatic.cache_clear()
    with caplog.at_level(logging.INFO):
        assert [pick_rasterizer("auto", CUDA) for _ in range(3)] == [picked] * 3
    backends._automatic.cache_clear()
    assert [record.levelname for record in caplog.records] == ["INFO" if there else "WARNING"], "said more than once"
    assert said in caplog.text


def test_auto_on_the_cpu_is_numba_or_the_reference() -> None:
    assert backends.resolve("auto", CPU, torch.float32) == "numba" == pick_rasterizer("auto", CPU)
    assert backends.resolve("auto", CPU, torch.float64) == "reference"
    assert backends.resolve("auto", CUDA, torch.float64) == "reference"


@pytest.fixture
def restored() -> Iterator[None]:
    yield
    set_default("auto")


def test_the_default_holds_where_it_takes_the_tensors(restored: None) -> None:
    inputs = {name: tensor.float() for name, tensor in scene(60, 3, 1, 24, 20, 0).items()}
    expected = {name: render(inputs, 24, 20, backend=name)[0] for name in ("numba", "reference")}
    assert not torch.equal(expected["numba"], expected["reference"]), "the scene cannot tell them apart"
    set_default("reference")
    assert torch.equal(render(inputs, 24, 20)[0], expected["reference"])
    assert torch.equal(render(inputs, 24, 20, backend="numba")[0], expected["numba"])
    set_default("numba")
    assert torch.equal(render(inputs, 24, 20)[0], expected["numba"])
    assert backends.resolve("auto", CPU, torch.float64) == "reference"
    with pytest.raises(UserError, match="unknown rasterizer 'tritn'. Did you mean 'triton'?"):
        set_default("tritn")
