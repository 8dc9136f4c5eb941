"""The studio: what it writes must be what was posed, seen through the cameras that it wrote."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from rewild4d.datasets.rigs.animal import AnimatedAnimal, Surface
from rewild4d.datasets.rigs.closest_points import closest_points
from rewild4d.datasets.rigs.shading import sample_texture
from rewild4d.datasets.rigs.studio import camera_ring, make_artemis, render_artemis
from rewild4d.datasets.rigs.voxels import barycentric, voxelise
from rewild4d.errors import UserError

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


def box(low: tuple[float, ...], high: tuple[float, ...], bone: int, color: tuple[float, ...]) -> Surface:
    vertices = np.array(low) + CORNERS * (np.array(high) - np.array(low))
    indices, weights = np.full((8, 1), bone), np.ones((8, 1))
    return Surface(vertices, FACES, indices, weights, np.tile(color, (8, 1)).astype(float))


def toy(up: tuple[float, float, float] = (0, 0, 1), frames: int = 2) -> AnimatedAnimal:
    """A red body and a green head; the head rises by 0.2 a frame and doubles in size from the second frame on."""
    surfaces = (box((-1, -0.3, 0), (1, 0.3, 0.8), 0, (1, 0, 0)), box((1.1, -0.2, 0.5), (1.6, 0.2, 1), 1, (0, 1, 0)))
    rest = np.tile(np.eye(4), (2, 1, 1))
    rest[1, :3, 3] = (1, 0, 0.75)
    bones = np.tile(rest, (frames, 1, 1, 1))
    bones[1:, 1, :3, :3] *= 2
    bones[:, 1, 2, 3] += 0.2 * np.arange(frames)
    names, parents = ("body", "head"), np.array([-1, 0])
    return AnimatedAnimal("toy", "box", "CC0", surfaces, names, parents, rest, bones, 10.0, "nod", np.array(up, float))


def read(folder: Path, motion: str, frame: int, view: int) -> tuple[np.ndarray, np.ndarray]:
    stem = folder / "img" / motion / str(frame) / f"img_{view:04d}"
    rgb, alpha = cv2.imread(f"{stem}.png"), cv2.imread(f"{stem}_alpha.png", cv2.IMREAD_UNCHANGED)
    assert rgb is not None and alpha is not None and alpha.ndim == 2
    return rgb[..., ::-1] / 255.0, alpha / 255.0


def cameras(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """World-to-camera and integer-centre intrinsics, parsed here from the format's description alone."""
    poses = []
    for row in np.loadtxt(folder / "CamPose.inf").reshape(-1, 4, 3):
        pose = np.eye(4)
        pose[:3, 2], pose[:3, 0], pose[:3, 1], pose[:3, 3] = row
        poses.append(np.linalg.inv(pose))
    numbers = np.array((folder / "Intrinsic.inf").read_text().split(), float).reshape(-1, 10)
    return list(zip(poses, numbers[:, 1:].reshape(-1, 3, 3), strict=True))


def project(points: np.ndarray, camera: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    local = points @ camera[0][:3, :3].T + camera[0][:3, 3]
    assert (local[:, 2] > 0).all()
    image = local @ camera[1].T
    return image[:, :2] / image[:, 2:]


def silhouette(animal: AnimatedAnimal, frame: int, camera: tuple[np.ndarray, np.ndarray], size: tuple) -> np.ndarray:
    """Coverage by another road than ray casting: 12 x 12 points a pixel inside any projected triangle."""
    fine = 12
    covered = np.zeros((size[1] * fine, size[0] * fine), bool)
    for vertices, surface in zip(animal.posed(frame), animal.surfaces, strict=True):
        for triangle in (project(vertices, camera)[surface.faces] + 0.5) * fine - 0.5:
            (left, top), (right, bottom) = np.floor(triangle.min(0)).astype(int), np.ceil(triangle.max(0)).astype(int)
            u, v = np.meshgrid(np.arange(left, right + 1), np.arange(top, bottom + 1))
            sides = [
                (q[0] - p[0]) * (v - p[1]) - (q[1] - p[1]) * (u - p[0])
                for p, q in zip(triangle, np.roll(triangle, -1, axis=0), strict=True)
            ]
            inside = (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
            covered[top : bottom + 1, left : right + 1] |= inside
    return covered.reshape(size[1], fine, size[0], fine).mean((1, 3))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (-1, 0, 0)])
def test_matte_agrees_with_projected_triangles(tmp_path: Path, up: tuple[float, float, float]) -> None:
    animal = toy(up)
    render_artemis([animal], tmp_path / "toy", views=5, width=96, height=54)
    views = cameras(tmp_path / "toy")
    assert len(views) == 5
    areas = []
    for frame in range(2):
        for view, camera in enumerate(views):
            _, alpha = read(tmp_path / "toy", "nod", frame, view)
            truth = silhouette(animal, frame, camera, (96, 54))
            assert np.abs(alpha - truth).max() < 0.3, (
                "an edge along a row is off by half a ray (1 / 6), a corner by two"
            )
            areas.append((alpha.sum(), truth.sum()))
            border = np.concatenate((alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
            assert border.max() == 0, "inside every image"
            assert camera[0][:3, :3] @ up @ (0, 1, 0) < -0.7, "the image's y points down"
    rendered, exact = np.sum(areas, axis=0)
    assert rendered == pytest.approx(exact, rel=0.006)


def test_colors_are_straight_and_shaded_mildly(tmp_path: Path) -> None:
    render_artemis([toy()], tmp_path / "toy", views=4, width=96, height=54)
    assert (tmp_path / "toy" / "licence.txt").read_text() == "CC0\n"
    seen = set()
    for view in range(4):
        rgb, alpha = read(tmp_path / "toy", "nod", 0, view)
        covered = rgb[alpha > 0]
        assert covered[:, 2].max() == 0
        assert covered[:, :2].sum(1).min() > 0.69 and covered.sum(1).max() <= 1.001, "not darkened at the rim"
        seen |= {int(channel) for channel in covered.argmax(1)}
    assert seen == {0, 1}


def test_voxels_fill_the_rest_shape_and_land_inside_every_matte(tmp_path: Path) -> None:
    animal = toy()
    render_artemis([animal], tmp_path / "toy", views=4, width=160, height=90)
    folder = tmp_path / "toy" / "volumes"
    voxels, indices, weights = (
        torch.load(folder / f"{name}.pth", weights_only=True).double().numpy()
        for name in ("coords_init", "volume_indices", "volume_weights")
    )
    pitch = 2 * np.loadtxt(folder / "radius.txt")[0] / 256
    assert len(voxels) * pitch**3 == pytest.approx(
        (2 + pitch) * (0.6 + pitch) * (0.8 + pitch) + (0.5 + pitch) * (0.4 + pitch) * (0.5 + pitch), rel=0.06
    )
    steps = (voxels - voxels.min(0)) / pitch
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    assert (np.diff(weights, axis=1) <= 1e-7).all()
    for frame in range(2):
        transforms = animal.transforms[frame][indices.astype(int)]
        points = np.einsum("nk,nkab,nb->na", weights, transforms[..., :3, :], np.c_[voxels, np.ones(len(voxels))])
        for view, camera in enumerate(cameras(tmp_path / "toy")):
            _, alpha = read(tmp_path / "toy", "nod", frame, view)
            grown = cv2.dilate(alpha, np.ones((5, 5)))  # half a cell of the doubled head and rounding
            column, row = np.round(project(points, camera)).astype(int).T
            assert (grown[row, column] > 0).all()


def test_overlapping_and_open_parts_are_filled() -> None:
    body, head = box((0, 0, 0), (2, 1, 1), 0, (1, 1, 1)), box((1.5, 0.2, 0.2), (2.5, 0.8, 0.8), 1, (1, 1, 1))
    split = (replace(body, faces=body.faces[:6]), replace(body, faces=body.faces[6:]), head)
    volume = voxelise(split)
    inside = ((volume.voxels > 0.1) & (volume.voxels < (1.9, 0.9, 0.9))).all(1).sum()
    pitch = volume.radius[0] / 128
    assert inside * pitch**3 == pytest.approx(1.8 * 0.8 * 0.8, rel=0.05)


def test_closest_points_equal_trimesh_on_triangles_of_any_size() -> None:
    rng = np.random.default_rng(0)
    sizes = 10 ** rng.uniform(-2, 0.5, (70, 1, 1))
    triangles = rng.uniform(-1, 1, (70, 1, 3)) + sizes * rng.uniform(-1, 1, (70, 3, 3))
    triangles[3, 2] = triangles[3, 1] = triangles[3, 0]  # a point
    triangles[4, 2] = (triangles[4, 0] + triangles[4, 1]) / 2  # a line
    points = rng.uniform(-2, 2, (500, 3))
    pairs = trimesh.triangles.closest_point(np.tile(triangles, (500, 1, 1)), np.repeat(points, 70, axis=0))
    truth = np.linalg.norm(pairs.reshape(500, 70, 3) - points[:, None], axis=2).min(1)
    found = closest_points(triangles, points)
    place = np.einsum("nk,nkd->nd", barycentric(found.uv), triangles[found.faces])
    np.testing.assert_allclose(found.distances, truth, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(place - points, axis=1), truth, atol=1e-5)
    near = closest_points(triangles, points, 0.3)
    np.testing.assert_array_equal(near.faces, np.where(found.distances < 0.3, found.faces, -1))
    np.testing.assert_array_equal(near.distances, np.minimum(found.distances, np.float32(0.3)))


def test_texture_lookup() -> None:
    texture = np.zeros((2, 4, 3), np.uint8)
    texture[0, 1], texture[1, 3] = (255, 0, 0), (0, 255, 0)
    # centres of the texels (column + 0.5) / 4, (row + 0.5) / 2; a whole turn further is the same; half way blends
    uv = np.array([[1.5 / 4, 0.5 / 2], [1 + 3.5 / 4, -1 + 1.5 / 2], [2 / 4, 0.5 / 2]])
    np.testing.assert_allclose(sample_texture(texture, uv), [[1, 0, 0], [0, 1, 0], [0.5, 0, 0]], atol=1e-12)


def test_ring_turns_evenly_and_smoothly() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (2, 50, 3)) + 7
    up = np.array([0.0, 1.0, 0.0])
    centers = np.stack([camera.center.numpy() for camera in camera_ring(points, up, 36, 64, 36)])
    target = (points.reshape(-1, 3).min(0) + points.reshape(-1, 3).max(0)) / 2
    arms = centers - target
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    elevation = np.degrees(np.arcsin(arms @ up))
    assert elevation.min() >= -5.001 and elevation.max() <= 35.001 and np.ptp(elevation) > 38
    steps = np.degrees(np.arccos((arms * np.roll(arms, 1, axis=0)).sum(1)))
    assert steps.max() < 14
    flat = np.delete(arms, 1, axis=1)
    azimuth = np.degrees(np.unwrap(np.arctan2(flat[:, 1], flat[:, 0])))
    np.testing.assert_allclose(np.abs(np.diff(azimuth)), 360 / 36, atol=1e-6)


def test_refusals_leave_nothing_behind(tmp_path: Path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("keep")
    with pytest.raises(UserError, match=r"full: expected a new or an empty folder, got one that holds files\."):
        render_artemis([toy()], full, views=2, width=32, height=18)
    with pytest.raises(UserError, match=r"out: expected views of at least 1, got 0\."):
        make_artemis(tmp_path / "no.glb", "Walk", 0, 1, 32, 18, tmp_path / "out")

    def stop(done: int, total: int) -> None:
        assert total == 2 * 2
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_artemis([toy()], tmp_path / "out", views=2, width=32, height=18, progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["full"] and (full / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize(("name", "clip"), [("cow", "Eating"), ("khronos_fox", "Run")])
def test_real_rigs(rigs: Path, tmp_path: Path, name: str, clip: str) -> None:
    out = make_artemis(rigs / f"{name}.glb", clip, 3, 2, 128, 72, tmp_path / name)
    assert (out / "sequences").read_text() == f"{clip} 2\n"
    for view in range(3):
        rgb, alpha = read(out, clip, 1, view)
        assert 0.03 < alpha.mean() < 0.6
        assert np.ptp(rgb[alpha == 1], axis=0).max() > 0.3, "several colours"
