"""Files that once ended in a traceback or were taken for something else, each with the sentence that it gets now."""

import io
import json
import pickle
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from fault_readers import READERS, TINY, features, pickled_template, reconstruction
from mutations import LONGEST_MESSAGE
from prior_files import a_prior
from scipy import sparse

from rewild4d.baselines.external import External
from rewild4d.baselines.gart_smal import template_prior
from rewild4d.baselines.prior_only import PriorOnly
from rewild4d.datasets.artemis.files import read_parents
from rewild4d.datasets.artemis.volume import _tensor
from rewild4d.datasets.images import read_picture
from rewild4d.errors import UserError
from rewild4d.io.meshes import read_mesh
from rewild4d.io.ply import read_surface
from rewild4d.metrics.sets import read_features
from rewild4d.ours.checkpoint import CONFIG, load_checkpoint
from rewild4d.ours.reconstruction import STATE, load_reconstruction
from rewild4d.priors.io import load_prior

XYZ = "property float x\nproperty float y\nproperty float z\n"
CPU = torch.device("cpu")
NINES = "9" * 5000


@pytest.mark.parametrize(
    ("header", "sentence"),
    [
        (f"element vertex {NINES}\n{XYZ}", "expected a line of a PLY 1.0 header, got 'element vertex 999"),
        (f"element foo {10**17}\nelement vertex 1\n{XYZ}", "expected properties of 'foo' in the PLY header, got none"),
        (f"element vertex 1\n{XYZ}element vertex 1\n{XYZ}", "expected elements with different names in the PLY header"),
        (f"element vertex {10**17}\n{XYZ}", f"expected {10**17} rows of 'vertex', but the file ends before"),
    ],
)
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_counts_of_a_ply(header: str, sentence: str, form: str, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(f"ply\nformat {form} 1.0\n{header}end_header\n0 0 0\n")
    with pytest.raises(UserError, match=sentence):
        read_surface(tmp_path / "a.ply", 10, 0)


def test_an_obj_that_names_what_no_file_is_called(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(f"mtllib {NINES}.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    assert read_mesh(tmp_path / "a.obj").texture is None, "a missing library counts as none"
    (tmp_path / "a.mtl").write_text(f"map_Kd {NINES}.png\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    with pytest.raises(UserError, match="expected names of files in its own folder, got '99999"):
        read_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (torch.zeros(3, 3, device="meta"), r"got a tensor without values \(device meta\)"),
        (torch.zeros(3, 3).to_sparse(), "expected a dense tensor of integers or floats, got torch.sparse_coo"),
        (torch.zeros(3, 3, dtype=torch.complex64), "expected a dense tensor of integers or floats"),
        (torch.zeros(3, 3, dtype=torch.bfloat16), "expected a dense tensor of integers or floats"),
        ([torch.zeros(3, device="meta")], "got a tensor without values"),
        ({"a": 1}, "expected a saved torch tensor, got dict"),
    ],
)
def test_tensors_of_another_kind(value: Any, sentence: str, tmp_path: Path) -> None:
    torch.save(value, tmp_path / "a.pth")
    with pytest.raises(UserError, match=sentence):
        _tensor(tmp_path / "a.pth")


@pytest.mark.parametrize(
    "header",
    [b"", b"{", b"{'descr': '<f8', 'fortran_order': False, 'shape': (3,", b"(" * 300, b"9" * 5000, b"[1,\n2"],
)
def test_headers_of_arrays(header: bytes, tmp_path: Path) -> None:
    data = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header
    (tmp_path / "bone_parents.npy").write_bytes(data)
    with pytest.raises(UserError, match="the header of an array is damaged or another file's"):
        read_parents(tmp_path)
    with io.BytesIO() as stream:
        np.savez(stream, name=np.array("fox"))
        whole = stream.getvalue()
    (tmp_path / "a.npz").write_bytes(whole.replace("fox".encode("utf-32-le"), b"\xff" * 12))
    with pytest.raises(UserError, match="cannot be read as one: it is cut off, damaged or another file"):
        load_prior(tmp_path / "a.npz")


def test_a_png_without_pixels(tmp_path: Path) -> None:
    begin = b"IHDR" + (6).to_bytes(4, "big") * 2 + b"\x08\x02\0\0\0"
    chunks = b"".join(
        len(body[4:]).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big") for body in (begin, b"IEND")
    )
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    with pytest.raises(UserError, match=r"a\.png: expected a whole image, got a PNG that is cut off after"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("about", "sentence"),
    [
        ("null", "Expected `object`, got `null`"),
        ('{"kid_v": null}', "Expected `object`, got `null`"),
        ("{", "truncated"),
        ('{"love": {"conditions": {}, "prediction": {}, "truth": {}}}', "Object missing required field `extractor`"),
    ],
)
def test_descriptions_of_features(about: str, sentence: str, tmp_path: Path) -> None:
    path = features(tmp_path)
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **(arrays | {"about": np.array(about)}))
    with pytest.raises(UserError, match=f"but it cannot be read as one: .*{sentence}"):
        read_features(path)
    np.savez(path, **(arrays | {"kid_v.truth": np.full((3, 4), np.nan)}))
    with pytest.raises(UserError, match="it holds rows of float64 of shape .* or some that are not finite"):
        read_features(path)


def test_a_sparse_matrix_whose_numbers_lie_outside(tmp_path: Path) -> None:
    """SciPy itself would write there: the process ended."""
    kept = pickle.loads(pickled_template(tmp_path).read_bytes())
    prior = a_prior([0.0, 0.3], [0.0, -0.3])
    kept["J_regressor"].indices[:] = 10**8
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(kept, protocol=2))
    with pytest.raises(UserError, match=r"a\.pkl: expected a sparse matrix, but it is damaged"):
        template_prior(tmp_path / "a.pkl", prior)
    kept["J_regressor"] = sparse.csc_matrix(([1.0], ([0], [0])), shape=(10**6, 10**6))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(kept, protocol=2))
    with pytest.raises(UserError, match=r"expected a sparse matrix of at most 1 GiB .* got 7\.45e\+03 GiB"):
        template_prior(tmp_path / "a.pkl", prior)


def changed_state(name: str, value: Any) -> Callable[[dict[str, Any]], Any]:
    def change(state: dict[str, Any]) -> Any:
        return state | {"model": state["model"] | {name: value}}

    return change


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda state: [], "ours.pt: expected tensors by name, got list"),
        (lambda state: {}, "ours.pt: expected a tensor 'times', got NoneType"),
        (lambda state: state | {"model": None}, "ours.pt: expected tensors by name, got NoneType"),
        (lambda state: state | {"model": torch.empty(0)}, "ours.pt: expected tensors by name, got Tensor"),
        (lambda state: state | {"cameras": None}, "what it holds does not fit"),
        (lambda state: state | {"cameras": [None]}, "expected a camera of 2 frames each, got 1"),
        (lambda state: state | {"times": torch.zeros(3).double()}, r"'object_to_world' of shape \[T=3, 4, 4\]"),
        (changed_state("gaussians.means", torch.zeros(4, 2)), r"'gaussians.means' of shape \[n=4, 3\], got \[4, 2\]"),
        (changed_state("gaussians.means", torch.full((4, 3), torch.nan)), "finite numbers in 'gaussians.means'"),
        (changed_state("field.logits", torch.zeros(9, 2)), "expected 'field.logits' of a cube of voxels, got 9 rows"),
        (changed_state("parents", torch.tensor([-1, 7])), "expected integers from -1 to 1 in 'parents'"),
        (changed_state("mirror", torch.tensor([0.0, 1.0])), "expected integers from 0 to 1 in 'mirror'"),
        (changed_state("network.norm.bias", torch.full((8,), torch.inf)), "finite numbers in 'network.norm.bias'"),
        (changed_state("network.head.weight", torch.zeros(2, 2)), "what it holds does not fit .* size mismatch"),
    ],
)  # fmt: skip
def test_a_state_that_is_not_ours(change: Callable[[dict[str, Any]], Any], sentence: str, tmp_path: Path) -> None:
    path = reconstruction(STATE)(tmp_path)
    torch.save(change(torch.load(path)), path)
    with pytest.raises(UserError, match=sentence):
        load_reconstruction(tmp_path, CPU)


@pytest.mark.parametrize("content", [[], {}, torch.zeros(1), {"digest": "a"}])
def test_a_checkpoint_that_is_none(content: Any, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "checkpoint.pt")
    with pytest.raises(UserError, match=r"checkpoint\.pt: expected a checkpoint .*, got something else"):
        load_checkpoint(tmp_path, "a")


@pytest.mark.parametrize(
    ("part", "name", "value", "sentence"),
    [
        ("pose", "anchor_size", 2**40, "expected 'network.anchors' of shape"),
        ("pose", "width", 2**20, "expected 'network.embed.weight' of shape"),
        ("pose", "blocks", 2**40, "expected a tensor 'network.blocks.1099511627775.down.bias', got NoneType"),
        ("deform", "width", 2**20, "expected 'deform.project.weight' of shape"),
        ("deform", "frequencies", 2**40, "expected 'deform.query.weight' of shape"),
    ],
)
def test_settings_of_another_reconstruction(part: str, name: str, value: int, sentence: str, tmp_path: Path) -> None:
    path = reconstruction(CONFIG)(tmp_path)
    settings = msgspec.to_builtins(TINY)
    settings[part][name] = value
    path.write_text(json.dumps(settings))
    with pytest.raises(UserError, match=sentence):
        load_reconstruction(tmp_path, CPU)


@pytest.mark.parametrize(("method", "file"), [(PriorOnly(), "surface.pt"), (External(), "external.pt")])
@pytest.mark.parametrize("state", [[], {}, {"cameras": None}, {"cameras": {0.0: (1, 2)}}])
def test_states_of_others(method: Any, file: str, state: Any, tmp_path: Path) -> None:
    torch.save(state, tmp_path / file)
    with pytest.raises(UserError, match="expected a reconstruction by '.*', but what it holds does not fit"):
        method.load(tmp_path, CPU)


OF_READER = {
    "artemis-bones": "Artemis bones", "artemis-campose": "Artemis cameras", "artemis-intrinsic": "Artemis intrinsics",
    "artemis-sequences": "Artemis sequences", "artemis-vol-coords_init": "Artemis voxels",
    "artemis-vol-volume_weights": "Artemis voxel weights", "features": "features", "prior": "prior", "obj": "OBJ",
    "ply": "PLY mesh, ASCII", "big": "PLY Gaussians", "np": "PLY surface", "gltf": "glb",
    "recon-config": "reconstruction's settings", "recon-ours": "reconstruction",
}  # fmt: skip
"""How a file of shared/data/faults begins -> its reader."""


def test_collected_faults(shared: Path, tmp_path: Path) -> None:
    folder = shared / "data" / "faults"
    if not folder.is_dir():
        pytest.skip(f"collected faults are not here ({folder})")
    tried = 0
    for fault in sorted(folder.iterdir()):
        name = next(
            (name for start, name in OF_READER.items() if fault.name.startswith((f"{start}-", f"{start}."))), ""
        )
        if not name:
            continue
        tried += 1
        own = tmp_path / fault.name
        own.mkdir()
        path = READERS[name].make(own)
        shutil.copyfile(fault, path)
        try:
            READERS[name].read(path)
        except UserError as error:
            assert len(str(error).replace(str(path), "")) <= LONGEST_MESSAGE and str(error).startswith(str(own)), (
                fault.name
            )
    assert tried >= 20
