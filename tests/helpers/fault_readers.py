"""Every reader of files that damaged ones are tried on, each with a tiny valid file.

Another reader is one more entry of `READERS`: a function that writes its file into a folder, and one that reads it.
"""

import hashlib
import json
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import msgspec
import numpy as np
import torch
from artemis_animals import write_animal
from mutations import Reader
from prior_files import a_prior
from records_for_tests import record
from rig_files import build
from scipy import sparse

from rewild4d.baselines.gart_smal import template_prior
from rewild4d.commands.verifying import Bundle, examine, look_at_cases
from rewild4d.datasets.artemis import files, volume
from rewild4d.datasets.rigs.reader import clips, content, load_rig
from rewild4d.datasets.video.footage import open_footage
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.io import meshes, ply
from rewild4d.leaderboard.bundle import write_bundle
from rewild4d.leaderboard.records import FILE
from rewild4d.leaderboard.submission import SUBMISSION, About, assemble
from rewild4d.metrics.samples import Conditions, Features
from rewild4d.metrics.sets import Compared, read_features, write_features
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.checkpoint import CONFIG
from rewild4d.ours.config import Config, Deform, Pose
from rewild4d.ours.model import Model
from rewild4d.ours.motion import Root
from rewild4d.ours.reconstruction import STATE, OursReconstruction, load_reconstruction
from rewild4d.ours.skinning import SkinningField
from rewild4d.priors.io import load_prior, save_prior
from rewild4d.types import Splats

Maker = Callable[[Path], Path]

MESH_HEADER = (
    "ply\nformat {} 1.0\ncomment a tetrahedron\nelement vertex 4\n"
    "property float x\nproperty float y\nproperty float z\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 4\n"
    "property list uchar int vertex_indices\nend_header\n"
)
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
TINY = Config(
    pose=Pose(anchor_size=4, frequencies=2, width=8, blocks=1, heads=1), deform=Deform(width=8, heads=1, frequencies=2)
)


def ascii_mesh(folder: Path) -> Path:
    path = folder / "mesh.ply"
    rows = [" ".join(map(str, (*row, 200, 30, 10))) for row in CORNERS]
    faces = [" ".join(map(str, (3, *row))) for row in FACES]
    path.write_text(MESH_HEADER.format("ascii") + "\n".join([*rows, *faces]) + "\n")
    return path


def binary_mesh(folder: Path) -> Path:
    path = folder / "mesh.ply"
    vertices = np.zeros(4, [("p", "<f4", 3), ("c", "u1", 3)])
    vertices["p"], vertices["c"] = CORNERS, (200, 30, 10)
    faces = np.zeros(4, [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, FACES
    path.write_bytes(MESH_HEADER.format("binary_little_endian").encode() + vertices.tobytes() + faces.tobytes())
    return path


def gaussians(folder: Path) -> Path:
    path = folder / "gaussians.ply"
    count = 5
    turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    sizes, opacities = torch.full((count, 3), 0.1), torch.full((count,), 0.5)
    ply.write_splats(path, Splats(torch.rand(count, 3), turns, sizes, opacities, torch.rand(count, 4, 3)))
    return path


def textured_obj(folder: Path) -> Path:
    path = folder / "mesh.obj"
    cv2.imwrite(str(folder / "skin.png"), np.full((4, 4, 3), 100, np.uint8))
    (folder / "mesh.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    corners = "".join("v {} {} {}\n".format(*row) for row in CORNERS)
    faces = "".join("f {}/1 {}/2 {}/3\n".format(*row + 1) for row in FACES)
    path.write_text(f"mtllib mesh.mtl\n{corners}vt 0 0\nvt 1 0\nvt 0 1\nusemtl skin\n{faces}f 1/1 2/1 3/1 4/2\n")
    return path


def glb(folder: Path) -> Path:
    return build(folder / "rig.glb", move_tag=True)


def prior(folder: Path) -> Path:
    path = folder / "prior.npz"
    save_prior(a_prior([0.0, 0.3], [0.0, -0.3]), path)
    return path


def smal_arrays() -> dict[str, np.ndarray]:
    """A tetrahedron with two joints as a template in SMAL's axes."""
    shares = np.array([[1.0, 0], [1, 0], [0, 1], [0.5, 0.5]])
    joints = np.array([[0.0, 0, 0], [1, 0, 0]])
    return {
        "vertices": CORNERS * 1.0,
        "faces": FACES,
        "weights": shares,
        "joints": joints,
        "parents": np.array([-1, 0]),
    }


def template(folder: Path) -> Path:
    path = folder / "template.npz"
    np.savez(path, **smal_arrays())
    return path


def pickled_template(folder: Path) -> Path:
    found = smal_arrays()
    parents, regressor = np.stack((found["parents"], np.arange(2))), sparse.csc_matrix(np.eye(4)[:2])
    kept = {"v_template": found["vertices"], "f": found["faces"], "weights": found["weights"]}
    path = folder / "template.pkl"
    path.write_bytes(pickle.dumps({**kept, "J_regressor": regressor, "kintree_table": parents}, protocol=2))
    return path


def features(folder: Path) -> Path:
    path = folder / "features.npz"
    side = Features(torch.rand(3, 4).double(), torch.zeros(3, dtype=torch.int64), "toy", "0", "none")
    write_features([Compared("kid_v", side, side, Conditions())], path)
    return path


def of_animal(name: str) -> Maker:
    """Return what writes a whole Artemis animal and names one of its files."""

    def make(folder: Path) -> Path:
        return write_animal(folder / "animal") / name

    return make


def reconstruction(name: str) -> Maker:
    """Return what writes a reconstruction of `ours` and names one of its files."""

    def make(folder: Path) -> Path:
        generator = torch.Generator().manual_seed(0)
        quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1)
        values = {"means": torch.rand(4, 3), "quats": quats, "log_scales": torch.full((4, 3), -3.0),
                  "logit_opacities": torch.zeros(4), "colors": torch.rand(4, 1, 3)}  # fmt: skip
        parents, mirror = torch.tensor([-1, 0]), torch.arange(2)
        field = SkinningField(torch.zeros(8, 2), -torch.ones(3), torch.full((3,), 2.0), mirror, True)
        own = Gaussians(values, TINY.canonical.max_scale)
        model = Model(TINY, own, field, torch.zeros(2, 3), parents, mirror, generator)
        times = torch.arange(2).double()
        OursReconstruction(model, TINY, Root(times, torch.eye(4).double().repeat(2, 1, 1), (None, None))).save(folder)
        return folder / name

    return make


def array_picture(folder: Path) -> Path:
    path = folder / "frame.npy"
    np.save(path, np.full((4, 4, 3), 0.5, np.float32))
    return path


def picture(folder: Path) -> Path:
    path = folder / "frame.png"
    cv2.imwrite(str(path), np.arange(108, dtype=np.uint8).reshape(6, 6, 3))
    return path


def read_frame(path: Path) -> object:
    return open_footage(path.parent).reels[0].picture(0)


def read_rig(path: Path) -> object:
    content(path)
    return load_rig(path, next(iter(clips(path)), "none"), 3)


def read_ours(path: Path) -> object:
    return load_reconstruction(path.parent, torch.device("cpu")).at(0.5)


def read_template(path: Path) -> object:
    return template_prior(path, a_prior([0.0, 0.3], [0.0, -0.3]))


def read_surface(path: Path) -> object:
    return ply.read_surface(path, 20, 0), ply.is_mesh(path)


def read_volume(path: Path) -> object:
    return volume.read_voxels(path.parent.parent)


def submission(folder: Path) -> Path:
    """The file that says what is in a bundle, in the folder of one with one run."""
    protocol = {"digest": "", **msgspec.to_builtins(find_protocol("artemis", "artemis-sweep-128-v1"))}
    made = folder / "made"
    assemble(
        [(folder, record(protocol=protocol))], made, About(name="J", licence="CC0", date="2026-01-31", title="T"), {},
        predictions=False, timeout=1.0,
    )  # fmt: skip
    return made / SUBMISSION


def bundle(folder: Path) -> Path:
    write_bundle(submission(folder).parent, folder / "bundle.zip")
    return folder / "bundle.zip"


def read_bundle(path: Path) -> Bundle:
    with tempfile.TemporaryDirectory() as scratch:
        found = examine(path, Path(scratch), timeout=1.0)
        look_at_cases(found, {})
        return found


def read_submission(path: Path) -> Bundle:
    with tempfile.TemporaryDirectory() as scratch:
        write_bundle(path.parent, Path(scratch) / "bundle.zip")
        return read_bundle(Path(scratch) / "bundle.zip")


def submitted_record(folder: Path) -> Path:
    return next(submission(folder).parent.rglob(FILE))


def read_record_of_bundle(path: Path) -> Bundle:
    """As a forger would have it: the digest is that of the damaged record."""
    folder = path.parents[3]
    said = json.loads((folder / SUBMISSION).read_text())
    said["files"][path.relative_to(folder).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / SUBMISSION).write_text(json.dumps(said))
    return read_submission(folder / SUBMISSION)


READERS = {
    "PLY mesh, ASCII": Reader(ascii_mesh, meshes.read_mesh),
    "PLY mesh, binary": Reader(binary_mesh, meshes.read_mesh),
    "PLY surface": Reader(binary_mesh, read_surface),
    "PLY Gaussians": Reader(gaussians, ply.read_splats),
    "PLY Gaussians as surface": Reader(gaussians, read_surface),
    "OBJ": Reader(textured_obj, meshes.read_mesh),
    "glb": Reader(glb, read_rig),
    "prior": Reader(prior, load_prior),
    "D-SMAL": Reader(template, read_template),
    "SMAL pickle": Reader(pickled_template, read_template),
    "features": Reader(features, read_features),
    "Artemis cameras": Reader(of_animal("CamPose.inf"), files.read_cameras),
    "Artemis intrinsics": Reader(of_animal("Intrinsic.inf"), lambda path: files.read_intrinsics(path, 4)),
    "Artemis bones": Reader(of_animal("bones/Bones_0000.inf"), lambda path: files.read_matrices(path, "bone")),
    "Artemis skeleton": Reader(of_animal("bones/Bones_0000.inf"), lambda p: volume.read_skeleton(p.parent.parent)),
    "Artemis parents": Reader(of_animal("bones/bone_parents.npy"), lambda path: files.read_parents(path.parent)),
    "Artemis sequences": Reader(of_animal("sequences"), files.read_sequences),
    "Artemis voxels": Reader(of_animal("volumes/coords_init.pth"), read_volume),
    "Artemis voxel bones": Reader(of_animal("volumes/volume_indices.pth"), read_volume),
    "Artemis voxel weights": Reader(of_animal("volumes/volume_weights.pth"), read_volume),
    "bundle": Reader(bundle, read_bundle),
    "bundle's submission": Reader(submission, read_submission),
    "bundle's record": Reader(submitted_record, read_record_of_bundle),
    "reconstruction": Reader(reconstruction(STATE), read_ours),
    "reconstruction's settings": Reader(reconstruction(CONFIG), read_ours),
    "picture as array": Reader(array_picture, read_frame),
    "picture": Reader(picture, read_frame),
}
"""Name -> reader; the number of a damage and the name decide the damage."""
