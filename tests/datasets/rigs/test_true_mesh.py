"""The truth of a rig is the mesh that it draws, not voxels that are skinned on their own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from rewild4d.contracts import Selection
from rewild4d.datasets.artemis.mesh import FILE, Mesh, TrueMesh, read_mesh
from rewild4d.datasets.artemis.reader import Artemis
from rewild4d.datasets.artemis.volume import read_surface
from rewild4d.datasets.rigs.animal import AnimatedAnimal, Surface
from rewild4d.datasets.rigs.studio import joined, render_artemis
from rewild4d.errors import UserError

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])
SELECTION = Selection("sweep", 32)


def box(low: tuple[float, ...], high: tuple[float, ...], bones: np.ndarray) -> Surface:
    vertices = np.array(low) + CORNERS * (np.array(high) - np.array(low))
    return Surface(vertices, FACES, bones[:, None], np.ones((8, 1)), np.full((8, 3), 0.5))


def bent(extra: tuple[Surface, ...] = ()) -> AnimatedAnimal:
    """One box of eight corners; those of its front end turn by 70 degrees, so that its long faces stay flat."""
    body = box((0, 0, 0), (4, 1, 1), (CORNERS[:, 0] > 0.5).astype(int))
    rest = np.tile(np.eye(4), (2, 1, 1))
    rest[1, :3, 3] = (4, 0.5, 0.5)
    bones = np.tile(rest, (2, 1, 1, 1))
    bones[1, 1, :3, :3] = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    bones[1, 1, :3, 3] = (2.5, 2.5, 0.5)
    up = np.array([0.0, 0.0, 1.0])
    return AnimatedAnimal(
        "box", "box", "CC0", (body, *extra), ("a", "b"), np.array([-1, 0]), rest, bones, 10, "bend", up
    )


def rendered(folder: Path, animal: AnimatedAnimal, with_mesh: bool = True) -> Path:
    mesh = joined(animal.surfaces) if with_mesh else None
    return render_artemis([animal], folder / "box", views=3, width=32, height=32, mesh=mesh)


def distances(animal: AnimatedAnimal, frame: int, points: torch.Tensor) -> np.ndarray:
    """From points to the posed triangles of the first surface, by another program."""
    posed = trimesh.Trimesh(animal.posed(frame)[0], animal.surfaces[0].faces, process=False)
    return trimesh.proximity.closest_point_naive(posed, points.numpy())[1]


def test_samples_lie_on_the_posed_triangles_where_voxels_leave_them(tmp_path: Path) -> None:
    animal = bent()
    clip, truth = Artemis(rendered(tmp_path / "mesh", animal)).load("box/bend", SELECTION)
    assert truth.sample is not None and truth.surface is not None and truth.source == "mesh of the rig"
    for frame, time in enumerate(clip.times):
        for points in (truth.sample(time, 300, 1), truth.surface(time)[:300]):
            assert distances(animal, frame, points).max() < 1e-5
    _, old = Artemis(rendered(tmp_path / "voxels", animal, with_mesh=False)).load("box/bend", SELECTION)
    assert old.sample is not None and old.source == "voxels"
    assert distances(animal, 1, old.sample(clip.times[1], 300, 1)).max() > 0.2
    assert truth.diagonal == pytest.approx((4**2 + 1 + 1) ** 0.5)
    assert truth.digest != old.digest


def test_samples_are_uniform_by_area_and_independent_by_seed(tmp_path: Path) -> None:
    animal = bent()
    surface = read_surface(rendered(tmp_path, animal))
    assert surface is not None
    mesh = TrueMesh(joined(animal.surfaces), surface)
    points = mesh.sampled(20_000, 3).posed(animal.bones_rest)
    on_end = np.isclose(points[:, 0], 4).mean()
    assert on_end == pytest.approx(1 / (4 * 4 + 2), abs=0.005)  # one of two ends beside four sides of 4 x 1
    again, other = (mesh.sampled(50, seed).posed(animal.bones_rest) for seed in (3, 4))
    assert (
        np.array_equal(again, mesh.sampled(50, 3).posed(animal.bones_rest))
        and not np.isclose(again, other).all(axis=1).any()
    )


def test_what_lies_deep_inside_is_no_surface(tmp_path: Path) -> None:
    hidden = box((1.5, 0.4, 0.4), (2.5, 0.6, 0.6), np.zeros(8, int))
    animal = bent((hidden,))
    surface = read_surface(rendered(tmp_path, animal))
    assert surface is not None
    points = TrueMesh(joined(animal.surfaces), surface).sampled(2000, 0).posed(animal.bones_rest)
    inside = ((points > (1.4, 0.3, 0.3)) & (points < (2.6, 0.7, 0.7))).all(axis=1)
    assert not inside.any()


def test_joined_surfaces_keep_their_pose() -> None:
    animal = bent((replace(box((1, 0, 2), (2, 1, 3), np.ones(8, int)), bone_weights=np.ones((8, 1))),))
    wide = replace(animal.surfaces[1], bone_indices=np.ones((8, 2), int), bone_weights=np.full((8, 2), 0.5))
    animal = replace(animal, surfaces=(animal.surfaces[0], wide))
    mesh = joined(animal.surfaces)
    assert mesh.indices.shape == (16, 2) and mesh.faces.max() == 15
    np.testing.assert_allclose(mesh.posed(animal.transforms[1]), np.concatenate(animal.posed(1)), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [({"faces": torch.full((1, 3), 99)}, "expected faces as whole numbers from 0 to 7, got others"),
     ({"indices": torch.full((8, 1), -1)}, "expected indices as whole numbers from 0 to 1, got others"),
     ({"vertices": torch.full((8, 3), float("nan"))}, "expected finite vertices and weights, got a NaN"),
     ({"weights": torch.ones(7, 1)}, r"indices and weights \[n, K\], got \(8, 3\), \(12, 3\), \(8, 1\), \(7, 1\)"),
     ({"faces": None}, "expected the tensors vertices, faces, indices, weights, got other content")],
)  # fmt: skip
def test_a_damaged_mesh_is_one_sentence(tmp_path: Path, change: dict[str, object], text: str) -> None:
    animal = bent()
    folder = rendered(tmp_path, animal)
    surface = read_surface(folder)
    assert surface is not None
    torch.save(torch.load(folder / FILE) | change, folder / FILE)
    with pytest.raises(UserError, match=text):
        read_mesh(folder, surface)


def test_a_folder_without_a_mesh_has_none(tmp_path: Path) -> None:
    folder = rendered(tmp_path, bent(), with_mesh=False)
    surface = read_surface(folder)
    assert surface is not None and read_mesh(folder, surface) is None
    assert Mesh._fields == ("vertices", "faces", "indices", "weights")
