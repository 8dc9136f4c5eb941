"""What a saved reconstruction promises, held against what its file holds."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch

from rewild4d.errors import UserError, reason, shown

R = TypeVar("R")
Shape = tuple[str | int, ...]


def require_tensors(path: Path, held: Any, wanted: Mapping[str, Shape], sizes: dict[str, int]) -> None:
    """Refuse a state without the tensors that it should hold.

    Args:
        path: the file, for the error.
        held: tensors by name, as they were read.
        wanted: the shape of each; a letter stands for the size seen first.
        sizes: sizes by letter; those seen here are added.

    Raises:
        UserError: it is no dictionary, a tensor is missing or of another shape, or any of those held is not finite.
    """
    if not isinstance(held, dict):
        raise UserError(f"{path}: expected tensors by name, got {type(held).__name__}.")
    for name, shape in wanted.items():
        tensor = held.get(name)
        if not isinstance(tensor, torch.Tensor):
            raise UserError(f"{path}: expected a tensor '{name}', got {shown(type(tensor).__name__)}.")
        fits = tensor.ndim == len(shape) and all(
            size == (want if isinstance(want, int) else sizes.setdefault(want, size))
            for want, size in zip(shape, tensor.shape, strict=True)
        )
        if not fits or 0 in tensor.shape:
            written = ", ".join(f"{want}={sizes[want]}" if want in sizes else str(want) for want in map(str, shape))
            raise UserError(f"{path}: expected '{name}' of shape [{written}], got {shown(list(tensor.shape))}.")
    for name, tensor in held.items():
        if isinstance(tensor, torch.Tensor) and not _is_finite(tensor):
            raise UserError(f"{path}: expected finite numbers in '{shown(name)}', got others.")


def _is_finite(tensor: torch.Tensor) -> bool:
    plain = tensor.layout == torch.strided and not tensor.is_complex() and not tensor.is_quantized
    return plain and bool(torch.isfinite(tensor).all())


def require_skeleton(path: Path, parents: torch.Tensor, mirror: torch.Tensor) -> None:
    """Refuse a skeleton whose bones do not exist.

    Args:
        path: the file, for the error.
        parents: of each bone, -1 for a root, [J].
        mirror: bone on the other side, [J].

    Raises:
        UserError: numbers that are not integers from -1 (``parents``) or 0 (``mirror``) to J - 1.
    """
    for name, rows, least in (("parents", parents, -1), ("mirror", mirror, 0)):
        whole = not rows.is_floating_point() and rows.dtype != torch.bool
        if not whole or int(rows.min()) < least or int(rows.max()) >= len(rows):
            raise UserError(f"{path}: expected integers from {least} to {len(rows) - 1} in '{name}', got others.")


@contextmanager
def read_as(folder: Path, method: str) -> Iterator[None]:
    """Take a saved state apart in the block: one that does not fit ends in one sentence.

    Args:
        folder: of the reconstruction.
        method: whose it should be.

    Raises:
        UserError: something is missing or of another kind or shape.
    """
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError, OverflowError) as error:
        raise UserError(
            f"{folder}: expected a reconstruction by '{method}', but what it holds does not fit ({reason(error)})."
        ) from error
