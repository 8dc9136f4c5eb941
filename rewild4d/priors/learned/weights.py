"""Weights of the network as safetensors, half precision."""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from rewild4d.errors import UserError
from rewild4d.files import atomic
from rewild4d.priors.learned.network import PointNetwork


def save_weights(network: PointNetwork, path: Path) -> None:
    """Write the weights in half precision."""
    state = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    with atomic(path) as scratch:
        save_file(state, scratch)


def load_weights(path: Path) -> PointNetwork:
    """Return the network with a file's weights.

    Raises:
        UserError: no such file, or not one of this network.
    """
    if not path.is_file():
        raise UserError(f"{path}: expected weights of the learned prior (`prior train` writes them), got no such file.")
    network = PointNetwork()
    try:
        state = load_file(path)
        network.load_state_dict({name: value.float() for name, value in state.items()})
    except (SafetensorError, RuntimeError) as error:
        raise UserError(
            f"{path}: expected weights of the learned prior, but: {str(error).splitlines()[0][:200]}"
        ) from error
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]
