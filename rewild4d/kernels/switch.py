"""Switch between the fused CPU kernels and their torch twins.

A fused kernel repeats in numba a torch function of the package: its twin. `--kernels torch` (or the environment
variable `REWILD4D_KERNELS=torch`) runs the twins everywhere. A kernel whose twin was edited, replaced or overridden
since it was written is not used, and one warning says so: a changed method is never computed by the old kernel.
"""

import ast
import hashlib
import importlib
import inspect
import logging
import os
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import CodeType
from typing import Any

import torch
from torch import Tensor, nn

from rewild4d.errors import UserError, unknown_name

logger = logging.getLogger(__name__)

MODES = ("auto", "torch")
VARIABLE = "REWILD4D_KERNELS"
KERNELS: dict[str, "Kernel"] = {}
"""All imported fused kernels by name."""
_without: set[str] = set()
LAYERS = {nn.Linear, nn.LayerNorm, nn.ModuleList}
"""Layers of torch that kernels know; those of this package are in their digests."""


def choose_kernels(mode: str | None) -> None:
    """Choose for this process and for those that it starts.

    Args:
        mode: "auto" runs fused kernels where they fit, "torch" plain torch everywhere; None keeps what is in force.

    Raises:
        UserError: another mode, here or in the environment.
    """
    if mode is not None and mode not in MODES:
        raise unknown_name("mode of --kernels", mode, MODES)
    os.environ[VARIABLE] = mode or kernel_mode()


def kernel_mode() -> str:
    """Return the mode in force.

    Raises:
        UserError: the environment variable holds another word.
    """
    mode = os.environ.get(VARIABLE, "auto")
    if mode not in MODES:
        raise UserError(f"{VARIABLE}: expected {' or '.join(MODES)}, got '{mode}'.")
    return mode


def chosen_kernels() -> dict[str, str]:
    """Return the mode as part of a run's id; empty for the default."""
    return {} if kernel_mode() == "auto" else {"kernels": kernel_mode()}


def describe_kernels() -> str:
    """Describe the kernels of a run for its record: the mode, and the kernels whose twins were edited."""
    edited = sorted(name for name, kernel in KERNELS.items() if not kernel.is_current())
    return kernel_mode() + (f", torch for {', '.join(edited)} (edited)" if edited else "")


@contextmanager
def without_kernels(*names: str) -> Iterator[None]:
    """Run the torch twins of some kernels inside a `with` block, to time or compare them."""
    before = set(_without)
    _without.update(names)
    try:
        yield
    finally:
        _without.clear()
        _without.update(before)


class Kernel:
    """One fused kernel and its torch twins.

    Args:
        name: in records and in `bench step`.
        digest: `source_digest` of the twins that the kernel was written for.
        twins: "module:function" or "module:Class.method" of all torch code that the kernel repeats.
        reads_layers: whether it reads the layers of the network that calls; one with other layers runs in torch.
    """

    def __init__(self, name: str, digest: str, *twins: str, reads_layers: bool = False) -> None:
        self.name, self.digest, self.twins, self.calls = name, digest, twins, 0
        self.reads_layers = reads_layers
        KERNELS[name] = self

    def takes(self, *tensors: Tensor, owner: object = None) -> bool:
        """Tell whether the kernel computes this call: float32 CPU tensors, switched on, twins unchanged.

        Args:
            tensors: all that the kernel reads.
            owner: object whose method calls; a subclass that overrides a twin runs its own code.
        """
        self.calls += 1
        if not all(tensor.is_cpu and tensor.dtype == torch.float32 for tensor in tensors):
            return False
        switched_on = self.name not in _without and kernel_mode() == "auto"
        return switched_on and self.is_current(type(owner)) and (owner is None or not _unknown_layers(self, owner))

    def is_current(self, owner: type = type(None)) -> bool:
        """Tell whether the twins are those that the kernel was written for."""
        return not self.twins or _verdict(self, tuple(_code(twin, owner) for twin in self.twins))


def _unknown_layers(kernel: Kernel, owner: object) -> bool:
    """Tell whether a network has layers that no kernel reads, such as one that was put in the place of another."""
    layers = owner.modules() if isinstance(owner, nn.Module) and kernel.reads_layers else ()
    kinds = dict.fromkeys(type(each) for each in layers if each is not owner and type(each) not in LAYERS)
    return any(
        not kind.__module__.startswith("rewild4d.") and _tell_layer(kernel.name, kind.__name__) for kind in kinds
    )


@cache
def _tell_layer(name: str, kind: str) -> bool:
    logger.warning("the fused kernel of '%s' does not know layers of type %s: torch runs.", name, kind)
    return True


@cache
def _verdict(kernel: Kernel, codes: tuple[CodeType | None, ...]) -> bool:
    """Compare the digest once for each set of functions, and warn where it differs."""
    found = source_digest(codes)
    if found in (kernel.digest, ""):
        return True
    logger.warning(
        "the torch code of '%s' is not the one that its fused kernel was written for (digest %s, not %s): torch runs.",
        kernel.name, found, kernel.digest,
    )  # fmt: skip
    return False


def _code(twin: str, owner: type) -> CodeType | None:
    """Return the code that runs where a twin is called now; None where its module is not loaded."""
    module, _, path = twin.partition(":")
    found: Any = sys.modules.get(module)
    if found is None:
        return None
    for name in path.split("."):
        found = getattr(owner if isinstance(found, type) and issubclass(owner, found) else found, name)
    return getattr(getattr(found, "__wrapped__", found), "__code__", None)


def source_digest(codes: tuple[CodeType | None, ...]) -> str:
    """Digest functions without docstrings, comments, annotations and layout; "" where there is no source."""
    parts = []
    for code in codes:
        if code is None:
            return ""
        try:
            parts.append(ast.unparse(_Bare().visit(ast.parse(textwrap.dedent(inspect.getsource(code))))))
        except (OSError, SyntaxError):
            return ""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


class _Bare(ast.NodeTransformer):
    """Strip what does not change a result."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        if ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
        node.decorator_list, node.returns = [], None
        for argument in (*node.args.args, *node.args.kwonlyargs, *node.args.posonlyargs):
            argument.annotation = None
        return self.generic_visit(node)


def twin_digest(kernel: Kernel) -> str:
    """Digest a kernel's twins as they are now, to write beside an updated kernel."""
    for twin in kernel.twins:
        importlib.import_module(twin.partition(":")[0])
    return source_digest(tuple(_code(twin, type(None)) for twin in kernel.twins))
