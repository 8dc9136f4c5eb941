"""Weights of networks as safetensors, half precision."""

from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from rewild4d.errors import UserError
from rewild4d.files import atomic
from rewild4d.priors.learned.network import PointNetwork

N = TypeVar("N", bound=nn.Module)


def save_weights(network: nn.Module, path: Path) -> None:
    """Write the weights in half precision."""
    state = {name: _stored(value).contiguous() for name, value in network.state_dict().items()}
    with atomic(path) as scratch:
        save_file(state, scratch)


def _stored(value: Tensor) -> Tensor:
    return value.half() if value.is_floating_point() else value


def read_weights(network: N, path: Path) -> N:
    """Give a network a file's weights.

    Raises:
        UserError: no such file, or not one of this network.
    """
    if not path.is_file():
        raise UserError(f"{path}: expected weights of the learned prior (`prior train` writes them), got no such file.")
    try:
        state = load_file(path)
        network.load_state_dict(
            {name: value.float() if value.is_floating_point() else value for name, value in state.items()}
        )
    except (SafetensorError, RuntimeError) as error:
        raise UserError(
            f"{path}: expected weights of the learned prior, but: {str(error).splitlines()[0][:200]}"
        ) from error
    return network.eval()


def load_weights(path: Path) -> PointNetwork:
    """Return the network of points with a file's weights; a `UserError` as `read_weights` raises it."""
    network = read_weights(PointNetwork(), path)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]
