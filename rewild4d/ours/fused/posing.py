"""Poses of codes: the pose network in one forward and one backward pass."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rewild4d.kernels.arrays import array
from rewild4d.kernels.compiling import inlined, kernel
from rewild4d.kernels.simd import take_ticket
from rewild4d.kernels.switch import Kernel
from rewild4d.kernels.threads import run_tickets, thread_count
from rewild4d.ours.fused.pose_layers import Sizes, backward_unit, forward_unit, outputs
from rewild4d.ours.fused.quaternions import unit, unit_grad

POSE_NETWORK = Kernel(
    "pose network",
    "d507591a9f4b",
    "rewild4d.ours.pose:PoseNetwork.__init__",
    "rewild4d.ours.pose:PoseNetwork._plain",
    "rewild4d.ours.pose:PoseNetwork.forward",
    "rewild4d.ours.pose:Block.__init__",
    "rewild4d.ours.pose:Block.forward",
    "rewild4d.ours.pose:time_code",
    reads_layers=True,
)


@kernel
def _codes(time: np.ndarray, group: np.ndarray, view: np.ndarray, frequencies: int, code: np.ndarray) -> None:
    last = 1 + 2 * frequencies
    for item in range(len(time)):
        tau = time[item] * np.float32(group[item])
        code[item, 0], code[item, last] = tau, view[item]
        for octave in range(frequencies):
            angle = tau * 2.0**octave
            code[item, 1 + octave], code[item, 1 + frequencies + octave] = math.sin(angle), math.cos(angle)
        if code.shape[1] > last + 1:
            code[item, last + 1] = group[item]


def codes(time: Tensor, group: Tensor, view: Tensor, frequencies: int, explicit_group: bool) -> Tensor:
    """Compute the time codes of `pose.time_code`, without gradients; float32 on the CPU."""
    code = np.empty((len(time), 2 + 2 * frequencies + explicit_group), np.float32)
    _codes(time.numpy(), group.numpy(), view.numpy(), frequencies, code)
    return torch.from_numpy(code)


@inlined
def _rotation(out: np.ndarray, wide: int, lane: int) -> tuple:
    """Return the normalised sum of identity and first four outputs, and one over its length."""
    return unit((1 + out[lane], out[wide + lane], out[2 * wide + lane], out[3 * wide + lane]))


@kernel
def _finish(
    s: Sizes, out: np.ndarray, tokens_first: np.ndarray, flipped: np.ndarray, mirror: np.ndarray, quats: np.ndarray,
    shifts: np.ndarray, features: np.ndarray,
) -> None:  # fmt: skip
    """Convert outputs [8, wide] and features [tokens, width] to the poses of a unit, mirrored where flipped."""
    for item in range(len(quats)):
        for joint in range(s.joints):
            other = mirror[joint] if flipped[item] else joint
            sign = -1.0 if flipped[item] else 1.0
            lane = item * s.joints + other
            rotation = _rotation(out, s.wide, lane)
            quats[item, joint, 0], quats[item, joint, 1] = rotation[0], rotation[1]
            quats[item, joint, 2], quats[item, joint, 3] = sign * rotation[2], sign * rotation[3]
            shifts[item, joint, 0] = sign * s.shift_scale * out[4 * s.wide + lane]
            shifts[item, joint, 1] = s.shift_scale * out[5 * s.wide + lane]
            shifts[item, joint, 2] = s.shift_scale * out[6 * s.wide + lane]
            features[item, joint] = tokens_first[lane * s.width : (lane + 1) * s.width]


@kernel
def _finish_back(
    s: Sizes, out: np.ndarray, flipped: np.ndarray, mirror: np.ndarray, g_quats: np.ndarray, g_shifts: np.ndarray,
    g_features: np.ndarray, on_out: np.ndarray, tokens_first: np.ndarray,
) -> None:  # fmt: skip
    """Compute the gradient of `_finish`."""
    on_out[:] = 0
    tokens_first[: s.wide * s.width] = 0
    for item in range(len(g_quats)):
        for joint in range(s.joints):
            other = mirror[joint] if flipped[item] else joint
            sign = -1.0 if flipped[item] else 1.0
            lane = item * s.joints + other
            rotation = _rotation(out, s.wide, lane)
            g = g_quats[item, joint]
            grad = unit_grad(rotation, (1.0 * g[0], 1.0 * g[1], sign * g[2], sign * g[3]))
            for i in range(4):
                on_out[i * s.wide + lane] += grad[i]
            on_out[4 * s.wide + lane] += sign * s.shift_scale * g_shifts[item, joint, 0]
            on_out[5 * s.wide + lane] += s.shift_scale * g_shifts[item, joint, 1]
            on_out[6 * s.wide + lane] += s.shift_scale * g_shifts[item, joint, 2]
            tokens_first[lane * s.width : (lane + 1) * s.width] += g_features[item, joint]


@kernel
def _forward(
    tickets: np.ndarray, s: Sizes, addresses: np.ndarray, starts: np.ndarray, code: np.ndarray, flipped: np.ndarray,
    mirror: np.ndarray, kept: np.ndarray, quats: np.ndarray, shifts: np.ndarray, features: np.ndarray,
) -> None:  # fmt: skip
    tokens_first = np.empty(s.wide * s.width, np.float32)
    while True:
        unit = take_ticket(tickets)
        begin, end = unit * s.items, min((unit + 1) * s.items, len(code))
        if begin >= len(code):
            return
        out = forward_unit(s, addresses, starts, code[begin:end], kept[min(unit, len(kept) - 1)], tokens_first)
        own = quats[begin:end], shifts[begin:end], features[begin:end]
        _finish(s, out, tokens_first, flipped[begin:end], mirror, own[0], own[1], own[2])


@kernel
def _backward(
    tickets: np.ndarray, s: Sizes, addresses: np.ndarray, starts: np.ndarray, flipped: np.ndarray, mirror: np.ndarray,
    kept: np.ndarray, g_quats: np.ndarray, g_shifts: np.ndarray, g_features: np.ndarray, gradients: np.ndarray,
) -> None:  # fmt: skip
    tokens_first, on_out = np.empty(s.wide * s.width, np.float32), np.empty(8 * s.wide, np.float32)
    while True:
        unit = take_ticket(tickets)
        if unit >= len(gradients):
            return
        begin, end = unit * s.items, min((unit + 1) * s.items, len(g_quats))
        own = g_quats[begin:end], g_shifts[begin:end], g_features[begin:end]
        _finish_back(
            s, outputs(kept[unit], s), flipped[begin:end], mirror, own[0], own[1], own[2], on_out, tokens_first
        )
        gradients[unit] = 0
        backward_unit(s, addresses, starts, end - begin, kept[unit], on_out, tokens_first, gradients[unit])


@cache
def _starts(counts: tuple[int, ...]) -> np.ndarray:
    """Return where each parameter's gradient begins, and where the last one ends."""
    return np.cumsum((0, *counts))


def poses(
    sizes: Sizes, parameters: Sequence[Tensor], code: Tensor, flipped: np.ndarray, mirror: np.ndarray
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute quats [B, J, 4], shifts [B, J, 3] and features [B, J, K] of codes [B, E]; float32 on the CPU.

    Only the parameters, in the network's own order, get gradients; ``flipped`` [B] poses are mirrored.
    """
    return _Poses.apply(sizes, code, flipped, mirror, torch.is_grad_enabled(), *parameters)


def _placed(parameters: Sequence[Tensor]) -> tuple[list[Tensor], np.ndarray]:
    """Return packed parameters, to be held while a kernel reads them, and their addresses."""
    flat = [parameter.contiguous() for parameter in parameters]
    return flat, np.array([parameter.data_ptr() for parameter in flat])


class _Poses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, sizes: Sizes, code: Tensor, flipped: np.ndarray, mirror: np.ndarray, keep: bool, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        batch, units = len(code), -(-len(code) // sizes.items)
        made = tuple(np.empty((batch, sizes.joints, size), np.float32) for size in (4, 3, sizes.width))
        kept = np.empty((units if keep else 1, sizes.kept), np.float32)
        flat, addresses = _placed(parameters)
        starts = _starts(tuple(parameter.numel() for parameter in parameters))
        given, threads = (sizes, addresses, starts, array(code), flipped, mirror), min(thread_count(), len(kept))
        run_tickets(_forward, *given, kept, *made, threads=threads)
        ctx.save_for_backward(*parameters)
        ctx.given = sizes, starts, flipped, mirror, kept
        return tuple(map(torch.from_numpy, made))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        parameters = ctx.saved_tensors
        flat, addresses = _placed(parameters)
        sizes, starts, flipped, mirror, kept = ctx.given
        gradients = np.empty((len(kept), starts[-1]), np.float32)
        given, threads = (sizes, addresses, starts, flipped, mirror, kept), min(thread_count(), len(kept))
        run_tickets(_backward, *given, *map(array, grads), gradients, threads=threads)
        total = torch.from_numpy(gradients[0] if len(kept) == 1 else gradients.sum(axis=0))
        pieces = total.split([parameter.numel() for parameter in parameters])
        shaped = (
            piece if parameter.dim() == 1 else piece.view(parameter.shape)
            for piece, parameter in zip(pieces, parameters, strict=True)
        )
        return None, None, None, None, None, *shaped
