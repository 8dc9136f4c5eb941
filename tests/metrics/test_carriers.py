"""Published weights: what their readers refuse, that all layouts give the same tensors, and that the table is whole."""

import io
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_weights import Calls

from rewild4d.errors import UserError
from rewild4d.metrics import carriers, weights

KERNEL = np.ones((2, 3, 4, 5), np.float32)


@pytest.mark.parametrize("tree", [{"a": 1}, [KERNEL], {"a": KERNEL.astype(object)}, "text"])
def test_a_pickle_of_anything_else_is_refused(tree: object) -> None:
    with pytest.raises(UserError, match="x: expected a pickle of float32 arrays only"):
        carriers.read_pickle(pickle.dumps(tree), "x")
    with pytest.raises(UserError, match="expected a pickle of float32 arrays only"):
        carriers.read_pickle(b"no pickle", "x")


def test_a_state_dict_with_code_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    torch.save({"features.0.weight": Calls(tmp_path / "ran")}, stream)
    with pytest.raises(UserError, match="x: expected a state dict of tensors that torch.load reads with weights_only"):
        carriers.read_torch(stream.getvalue(), "x")
    assert not (tmp_path / "ran").exists()


def test_the_two_layouts_of_inception_name_the_same_tensors() -> None:
    generator = torch.Generator().manual_seed(0)
    towers, branches = {}, {"fc.weight": torch.ones(1)}
    for tower, unit in carriers.tower_names().items():
        values = {part: torch.rand(2, generator=generator) for part in ("weight", "beta", "mean", "var")}
        towers |= {f"net.layers.{tower}.{part}": value for part, value in values.items()}
        branches |= {
            f"{unit}.conv.weight": values["weight"],
            f"{unit}.bn.weight": torch.ones(2),
            f"{unit}.bn.bias": values["beta"],
            f"{unit}.bn.running_mean": values["mean"],
            f"{unit}.bn.running_var": values["var"],
            f"{unit}.bn.num_batches_tracked": torch.tensor(0),
        }
    first, second = carriers.from_inception_towers(towers), carriers.from_inception_branches(branches)
    assert len(first) == 94 * 4  # units of Inception-v3 without its classifiers
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    branches["Mixed_5b.branch1x1.bn.weight"] = torch.tensor([1.0, 2.0])
    with pytest.raises(UserError, match="expected a normalisation whose scale is one"):
        carriers.from_inception_branches(branches)


def test_the_two_layouts_of_i3d_name_the_same_tensors() -> None:
    generator = torch.Generator().manual_seed(0)
    kinds = {"0": "1x1", "1": "3x3", "2": "3x3", "3": "1x1"}
    paths = ["Conv3d_1a_7x7", "Conv3d_2b_1x1", "Conv3d_2c_3x3"]
    for block in ("3b", "3c", "4b", "4c", "4d", "4e", "4f", "5b", "5c"):
        for unit in ("0a", "1a", "1b", "2a", "2b", "3b"):
            kind = "1x1" if unit[1] == "a" else kinds[unit[0]]
            paths.append(f"Mixed_{block}/Branch_{unit[0]}/Conv3d_0{unit[1]}_{kind}")
    last = {"kernel": torch.rand(1, 1, 1, 2, 400, generator=generator), "bias": torch.rand(400, generator=generator)}
    flax = {f"params/Logits/Conv3d_0c_1x1/Conv_0/{part}": value for part, value in last.items()}
    ordered = {"logits.conv3d.weight": last["kernel"].permute(4, 3, 0, 1, 2), "logits.conv3d.bias": last["bias"]}
    for path in paths:
        kernel, beta = torch.rand(1, 2, 3, 2, 2, generator=generator), torch.rand(2, generator=generator)
        mean, variance = torch.rand(2, generator=generator), torch.rand(2, generator=generator)
        flax |= {
            f"params/{path}/Conv_0/kernel": kernel,
            f"params/{path}/BatchNorm_0/bias": beta,
            f"batch_stats/{path}/BatchNorm_0/mean": mean.reshape(1, 1, 1, 1, 2),
            f"batch_stats/{path}/BatchNorm_0/var": variance.reshape(1, 1, 1, 1, 2),
        }
        unit = path.replace("/", ".").replace("Conv3d_", "conv").lower()
        ordered |= {
            f"{unit}.conv3d.weight": kernel.permute(4, 3, 0, 1, 2),
            f"{unit}.bn.weight": torch.ones(2),
            f"{unit}.bn.bias": beta,
            f"{unit}.bn.running_mean": mean,
            f"{unit}.bn.running_var": variance,
        }
    first, second = carriers.from_flax_i3d(flax), carriers.from_ordered_i3d(ordered)
    assert len(first) == 57 * 4 + 2 == 230  # tensors of TF-hub's checkpoint
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_file_that_a_library_reads_is_kept_byte_for_byte() -> None:
    data = bytes(range(256)) * 3
    (found,) = carriers.convert(data, "whole", "file", "x").items()
    assert found[0] == "file" and found[1].dtype == torch.uint8 and found[1].numpy().tobytes() == data


def test_the_real_table_is_whole() -> None:
    table = weights.table()
    assert list(table.networks) == ["lpips-alex", "lpips-vgg", "inception-fid", "i3d-k400", "u2netp"]
    for known in (*table.networks.values(), *table.archives.values(), *table.files.values()):
        assert len(known.sha256) == 64 and known.bytes > 0
    for network in table.networks.values():
        assert all(file in table.files for files in network.made_from for file in files)
        assert any(archive.members.keys() >= set(network.made_from[0]) for archive in table.archives.values())
    for file in table.files.values():
        assert file.form in carriers.READERS and file.layout in carriers.LAYOUTS


def test_the_pinned_hashes_are_the_published_ones(shared: Path) -> None:
    path = shared / "design" / "weights_known_hashes.json"
    if not path.is_file():
        pytest.skip(f"the table of published hashes is not here ({path})")
    published = {name.rpartition("/")[2]: entry for name, entry in json.loads(path.read_text()).items()}
    known = weights.table().files
    assert known.keys() - published.keys() == {"u2netp.onnx"}, "no metric's network"
    for name, file in known.items():
        if name == "u2netp.onnx":
            continue
        assert file.sha256 == published[name]["sha256"]
        assert file.bytes == published[name].get("bytes", file.bytes)
