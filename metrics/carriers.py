"""Read weights as others publish them, and name their tensors as this package does.

Nothing here runs code from a file. Pickles are read by an unpickler that knows three names of NumPy, PyTorch's files
with `weights_only`. A TorchScript file, which only PyTorch's own reader understands, is opened after its SHA-256 was
checked (by `rewild4d.metrics.weights`), and only its tensors are read.
"""

import io
import pickle
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError

Tensors = dict[str, Tensor]


class ArraysOnly(pickle.Unpickler):
    """Unpickler of NumPy arrays and plain containers that refuses every other name."""

    ADMITTED = {
        ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],  # old files say so; NumPy 2 moved it
        ("numpy._core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
    }

    def find_class(self, module: str, name: str) -> Any:
        """Return the class or function of a name; UnpicklingError unless NumPy needs it to rebuild arrays."""
        if (module, name) not in self.ADMITTED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return self.ADMITTED[module, name]


def read_pickle(data: bytes, label: str) -> Tensors:
    """Read arrays of a pickled tree of dictionaries, by their path in it ("a/b/kernel")."""
    flat: Tensors = {}

    def walk(node: Any, path: tuple[str, ...]) -> None:
        if isinstance(node, dict):
            for key, value in node.items():
                walk(value, (*path, str(key)))
        elif isinstance(node, np.ndarray) and node.dtype == np.float32:
            flat["/".join(path)] = torch.from_numpy(node.copy())
        else:
            raise pickle.UnpicklingError(f"it holds a {type(node).__name__}")

    try:
        walk(ArraysOnly(io.BytesIO(data)).load(), ())
    except Exception as error:  # a damaged pickle can raise anything
        raise UserError(
            f"{label}: expected a pickle of float32 arrays only, but {error}; nothing was loaded."
        ) from error
    return flat


def read_torch(data: bytes, label: str) -> Tensors:
    """Read the tensors of a state dict that `torch.save` wrote; UserError where it holds more."""
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        return {str(name): value for name, value in state.items() if isinstance(value, Tensor)}
    except Exception as error:
        raise UserError(
            f"{label}: expected a state dict of tensors that torch.load reads with weights_only."
        ) from error


def read_torchscript(data: bytes, label: str) -> Tensors:
    """Read the tensors of a TorchScript file without calling its code. Only for files whose SHA-256 is known."""
    try:
        module = torch.jit.load(io.BytesIO(data), map_location="cpu")
    except Exception as error:
        raise UserError(f"{label}: expected a TorchScript file.") from error
    return {name: value.detach() for name, value in module.state_dict().items()}


def from_flax_lpips(source: Tensors) -> Tensors:
    """Rename LPIPS with trunk and heads, kernels [h, w, in, out]."""
    made: Tensors = {}
    for path, value in source.items():
        block, layer, part = path.split("/")
        index = re.findall(r"\d+", layer if "NetLin" not in block else block)[0]
        if "NetLin" in block:
            made[f"head.{index}"] = value.reshape(-1)
        elif part == "kernel":
            made[f"trunk.{index}.weight"] = value.permute(3, 2, 0, 1)
        else:
            made[f"trunk.{index}.bias"] = value
    return made


def from_torchvision(source: Tensors) -> Tensors:
    """Rename the convolutions of a torchvision AlexNet or VGG-16 in order, without the classifier.

    Examples:
        >>> list(from_torchvision({"features.0.weight": torch.ones(1), "features.0.bias": torch.ones(1)}))
        ['trunk.0.weight', 'trunk.0.bias']
    """
    layers = sorted({int(name.split(".")[1]) for name in source if name.startswith("features.")})
    return {
        f"trunk.{index}.{part}": source[f"features.{layer}.{part}"]
        for index, layer in enumerate(layers)
        for part in ("weight", "bias")
    }


def from_lpips_heads(source: Tensors) -> Tensors:
    """Rename the learned weights of the stages, [1, channels, 1, 1] each.

    Examples:
        >>> from_lpips_heads({"lin0.model.1.weight": torch.ones(1, 2, 1, 1)})
        {'head.0': tensor([1., 1.])}
    """
    return {f"head.{name[3]}": value.reshape(-1) for name, value in source.items() if re.match(r"lin\d\.", name)}


def from_flax_i3d(source: Tensors) -> Tensors:
    """Rename I3D, kernels [t, h, w, in, out]."""
    made: Tensors = {}
    for path, value in source.items():
        _, *unit, layer, part = path.split("/")
        name = _i3d_unit(unit)
        if part == "kernel":
            made[f"{name}.weight"] = value.permute(4, 3, 0, 1, 2)
        else:
            kind = {"mean": "mean", "var": "variance", "bias": "bias" if layer.startswith("Conv") else "beta"}[part]
            made[f"{name}.{kind}"] = value.reshape(-1)
    return made


def _i3d_unit(path: list[str]) -> str:
    """Rename TensorFlow's unit: Mixed_3b/Branch_1/Conv3d_0a_1x1 -> Mixed_3b.1a."""
    if path[0].startswith("Mixed"):
        return f"{path[0]}.{path[1][-1]}{path[2][len('Conv3d_0')]}"
    return path[0]


def from_ordered_i3d(source: Tensors) -> Tensors:
    """Rename I3D under any names by the order of its units; the one with 400 outputs is the last layer."""
    units: dict[str, Tensors] = {}
    for name, value in source.items():
        if value.ndim in (1, 5):
            units.setdefault(re.sub(r"[._][^._]*\.[^.]*$", "", name), {})[name] = value
    order = ["Conv3d_1a_7x7", "Conv3d_2b_1x1", "Conv3d_2c_3x3"]
    for block in ("3b", "3c", "4b", "4c", "4d", "4e", "4f", "5b", "5c"):
        order += [f"Mixed_{block}.{unit}" for unit in ("0a", "1a", "1b", "2a", "2b", "3b")]
    hidden = [unit for unit in units.values() if not _is_last(unit)]
    made: Tensors = {}
    for name, unit in [
        *zip(order, hidden, strict=True),
        *(("Logits", unit) for unit in units.values() if _is_last(unit)),
    ]:
        for part, value in unit.items():
            made[f"{name}.{_role(part, value, name == 'Logits')}"] = value
    return {name: value for name, value in made.items() if not name.endswith(".scale")}


def _is_last(unit: Mapping[str, Tensor]) -> bool:
    return any(value.ndim == 5 and len(value) == 400 for value in unit.values())


def _role(name: str, value: Tensor, last: bool) -> str:
    """Return a tensor's part in its unit; a normalisation's scale has to be one everywhere."""
    if value.ndim == 5:
        return "weight"
    for word, role in (("mean", "mean"), ("var", "variance"), ("bias", "bias" if last else "beta")):
        if word in name.rpartition(".")[2]:
            return role
    return _only_ones(name, value)


def _only_ones(name: str, value: Tensor) -> str:
    if not bool((value == 1).all()):
        raise UserError(f"{name}: expected a normalisation whose scale is one, as the original network's.")
    return "scale"


STEM = ("Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3", "Conv2d_3b_1x1", "Conv2d_4a_3x3")
BRANCHES_35 = {
    "conv": "branch1x1", "tower.conv": "branch5x5_1", "tower.conv_1": "branch5x5_2",
    "tower_1.conv": "branch3x3dbl_1", "tower_1.conv_1": "branch3x3dbl_2", "tower_1.conv_2": "branch3x3dbl_3",
    "tower_2.conv": "branch_pool",
}  # fmt: skip
REDUCE_17 = {
    "conv": "branch3x3", "tower.conv": "branch3x3dbl_1", "tower.conv_1": "branch3x3dbl_2",
    "tower.conv_2": "branch3x3dbl_3",
}  # fmt: skip
BRANCHES_17 = {
    "conv": "branch1x1", "tower.conv": "branch7x7_1", "tower.conv_1": "branch7x7_2", "tower.conv_2": "branch7x7_3",
    "tower_1.conv": "branch7x7dbl_1", "tower_1.conv_1": "branch7x7dbl_2", "tower_1.conv_2": "branch7x7dbl_3",
    "tower_1.conv_3": "branch7x7dbl_4", "tower_1.conv_4": "branch7x7dbl_5", "tower_2.conv": "branch_pool",
}  # fmt: skip
REDUCE_8 = {
    "tower.conv": "branch3x3_1", "tower.conv_1": "branch3x3_2", "tower_1.conv": "branch7x7x3_1",
    "tower_1.conv_1": "branch7x7x3_2", "tower_1.conv_2": "branch7x7x3_3", "tower_1.conv_3": "branch7x7x3_4",
}  # fmt: skip
BRANCHES_8 = {
    "conv": "branch1x1", "tower_conv": "branch3x3_1", "tower_mixed_conv": "branch3x3_2a",
    "tower_mixed_conv_1": "branch3x3_2b", "tower_1_conv": "branch3x3dbl_1", "tower_1_conv_1": "branch3x3dbl_2",
    "tower_1_mixed_conv": "branch3x3dbl_3a", "tower_1_mixed_conv_1": "branch3x3dbl_3b", "tower_2_conv": "branch_pool",
}  # fmt: skip
BLOCKS = {
    "5b": BRANCHES_35, "5c": BRANCHES_35, "5d": BRANCHES_35, "6a": REDUCE_17, "6b": BRANCHES_17, "6c": BRANCHES_17,
    "6d": BRANCHES_17, "6e": BRANCHES_17, "7a": REDUCE_8, "7b": BRANCHES_8, "7c": BRANCHES_8,
}  # fmt: skip
"""TensorFlow's names of the units of each block, and the usual PyTorch ones."""


def tower_names() -> dict[str, str]:
    """Map TensorFlow's names of the 2015 Inception's units to the usual PyTorch ones.

    Examples:
        >>> tower_names()["mixed_1.tower.conv"]
        'Mixed_5c.branch5x5_1'
    """
    names = {f"conv_{i}" if i else "conv": unit for i, unit in enumerate(STEM)}
    for i, (block, units) in enumerate(BLOCKS.items()):
        names |= {f"mixed{f'_{i}' if i else ''}.{tower}": f"Mixed_{block}.{unit}" for tower, unit in units.items()}
    return names


def from_inception_towers(source: Tensors) -> Tensors:
    """Rename the FID Inception under TensorFlow's names, without a classifier."""
    names, parts = tower_names(), {"weight": "weight", "beta": "beta", "mean": "mean", "var": "variance"}
    made: Tensors = {}
    for name, value in source.items():
        unit, _, part = re.sub(r"^(net\.)?layers\.", "", name).rpartition(".")
        if unit in names:
            made[f"{names[unit]}.{parts[part]}"] = value
    return made


def from_inception_branches(source: Tensors) -> Tensors:
    """Rename the FID Inception under the usual PyTorch names, without the classifier."""
    parts = {"conv.weight": "weight", "bn.bias": "beta", "bn.running_mean": "mean", "bn.running_var": "variance"}
    made: Tensors = {}
    for name, value in source.items():
        unit, _, part = name.partition(".conv.") if ".conv." in name else name.partition(".bn.")
        kind = f"{'conv' if '.conv.' in name else 'bn'}.{part}"
        if kind == "bn.weight":
            _only_ones(name, value)
        elif kind in parts:
            made[f"{unit}.{parts[kind]}"] = value
    return made


def read_whole(data: bytes, label: str) -> Tensors:
    """Return a file's bytes, "file": for a library that reads it by itself."""
    return {"file": torch.frombuffer(bytearray(data), dtype=torch.uint8)}


READERS: dict[str, Callable[[bytes, str], Tensors]] = {
    "pickle": read_pickle,
    "torch": read_torch,
    "torchscript": read_torchscript,
    "whole": read_whole,
}
LAYOUTS: dict[str, Callable[[Tensors], Tensors]] = {
    "flax-lpips": from_flax_lpips,
    "torchvision": from_torchvision,
    "lpips-heads": from_lpips_heads,
    "flax-i3d": from_flax_i3d,
    "ordered-i3d": from_ordered_i3d,
    "inception-towers": from_inception_towers,
    "inception-branches": from_inception_branches,
    "file": dict,
}


def convert(data: bytes, form: str, layout: str, label: str) -> Tensors:
    """Read a published file and name its tensors as the networks of this package do.

    Args:
        data: the file's bytes, already known to be the published ones.
        form: a key of `READERS`.
        layout: a key of `LAYOUTS`.
        label: name of the file in errors.

    Raises:
        UserError: the file does not hold what its layout says.
    """
    source = READERS[form](data, label)
    try:
        made = LAYOUTS[layout](source)
    except (KeyError, IndexError, ValueError) as error:
        raise UserError(f"{label}: expected tensors in the layout '{layout}', but {error} does not fit.") from error
    return {name: _kept(made[name]).contiguous() for name in sorted(made)}


def _kept(value: Tensor) -> Tensor:
    """Return numbers in single precision, and bytes as they are."""
    return value if value.dtype == torch.uint8 else value.float()
