"""Prior files: what is written is read back, and a broken file is one clear sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.priors.io import load_prior, save_prior
from rewild4d.transforms import mirror_points, skin_points
from rewild4d.types import Prior


def test_what_was_saved_is_loaded_with_the_same_digest(prior: Prior, tmp_path: Path) -> None:
    save_prior(prior, tmp_path / "prior.npz")
    loaded = load_prior(tmp_path / "prior.npz")
    assert loaded.digest == prior.digest and loaded.quality == prior.quality
    assert loaded.name == "template" and loaded.provenance == "Made by a test."
    for key in ("vertices", "faces", "weights", "transforms", "transforms_flip", "object_to_world", "times"):
        assert torch.equal(getattr(loaded, key), getattr(prior, key)) and (
            getattr(loaded, key).dtype == getattr(prior, key).dtype
        )
    assert torch.equal(loaded.cameras_flip[1].intrinsics, prior.cameras_flip[1].intrinsics)


def test_digest_covers_poses_cameras_and_name(prior: Prior, tmp_path: Path) -> None:
    save_prior(prior, tmp_path / "a.npz")
    changed = [
        replace(prior, transforms=prior.transforms.roll(1, dims=1)),
        replace(prior, cameras=(replace(prior.cameras[0], width=65), prior.cameras[1])),
        replace(prior, name="other"),
    ]
    digests = set()
    for index, other in enumerate(changed):
        save_prior(other, tmp_path / f"{index}.npz")
        digests.add(load_prior(tmp_path / f"{index}.npz").digest)
    assert len(digests | {prior.digest}) == 4


def test_object_cameras_see_the_world_and_flipped_cameras_the_mirrored_image(prior: Prior) -> None:
    camera, flipped = prior.cameras[0], prior.cameras_flip[0]
    posed = skin_points(prior.vertices, prior.weights, prior.transforms[0]).double()
    pixels, depth = camera.project(posed)
    mirrored, mirrored_depth = flipped.project(mirror_points(posed))
    assert torch.allclose(mirrored[:, 0], camera.width - pixels[:, 0]) and torch.allclose(mirrored[:, 1], pixels[:, 1])
    assert torch.allclose(depth, mirrored_depth)
    # object_to_world halves lengths, so depth in object units is twice the depth in the world
    center = prior.object_to_world[0, :3, 3]
    assert camera.project(torch.zeros(3, dtype=torch.float64))[1] == pytest.approx(
        2 * float((torch.tensor((6.0, 1.0, 2.0)).double() - center) @ torch.tensor((6.0, 1.0, 2.0)).double()) / 41**0.5
    )


def test_a_file_without_the_flipped_half_gets_the_exact_mirror_images(prior: Prior, tmp_path: Path) -> None:
    save_prior(prior, tmp_path / "prior.npz")
    with np.load(tmp_path / "prior.npz") as archive:
        arrays = {key: archive[key] for key in archive.files if not key.endswith("_flip")}
    np.savez(tmp_path / "half.npz", **arrays)
    loaded = load_prior(tmp_path / "half.npz")
    assert torch.allclose(loaded.transforms_flip, prior.transforms_flip)
    assert torch.allclose(loaded.cameras_flip[0].world_to_camera, prior.cameras_flip[0].world_to_camera)


def nan(array: np.ndarray) -> np.ndarray:
    broken = array.copy()
    broken.flat[0] = np.nan
    return broken


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("weights", None, "expected an array 'weights', but the file holds only"),
        ("weights", lambda a: a[:-1], r"expected 'weights' of shape \[n=1418, J\], got \[1417, 20\]"),
        ("weights", lambda a: a * 2, "expected rows of 'weights' to sum to one"),
        ("vertices", nan, "expected finite numbers in 'vertices', got 1 that are not"),
        ("vertices", lambda a: a * 2, "expected a rest bounding-box diagonal of 5, got 10"),
        ("faces", lambda a: a + 5000, "expected 'faces' to be below 1418"),
        ("faces", lambda a: a.astype(float), "expected 'faces' to hold integers, got float64"),
        ("parents", lambda a: np.roll(np.arange(20), 1), "expected 'parents' to form a tree"),
        ("mirror", lambda a: np.roll(a, 1), "expected 'mirror' to be its own inverse"),
        ("times", lambda a: a[::-1], "expected 'times' to increase"),
        ("object_to_world", lambda a: -a, "expected 'object_to_world' to keep handedness"),
        ("object_to_world", lambda a: a @ np.diag((1.1, 1, 1, 1)), "expected similarities in 'object_to_world'"),
        ("object_to_world", lambda a: 0.9 * a, "expected similarities in 'object_to_world', got some that are 0.1 off"),
        ("world_to_camera", lambda a: a @ np.diag((2.0, 2, 2, 1)), "expected rigid matrices in 'world_to_camera', got"),
        ("world_to_camera", lambda a: a @ np.diag((-1.0, 1, 1, 1)), "expected rigid matrices in 'world_to_camera'"),
        ("world_to_camera_flip", lambda a: 0 * a, "expected rigid matrices in 'world_to_camera_flip'"),
        ("transforms", lambda a: 1e20 * a, "expected rigid matrices in 'transforms'"),
        ("intrinsics", lambda a: np.diag((-1.0, -1, 1)) @ a, "expected positive focal lengths and a last row 0 0 1"),
        ("intrinsics", lambda a: 2 * a, "expected positive focal lengths and a last row 0 0 1 in 'intrinsics', got"),
        ("intrinsics_flip", None, "expected all or none of world_to_camera_flip"),
        ("quality", lambda a: np.array("[1]"), "expected 'quality' to be a JSON object of numbers"),
        ("quality", lambda a: np.array('{"a": 1, "b": NaN}'), "expected finite numbers in 'quality', got nan for 'b'"),
        ("quality", lambda a: np.array(f'{{"a": 1{"0" * 400}}}'), "expected 'quality' to be a JSON object of numbers"),
    ],
)
def test_each_broken_promise_is_one_sentence_with_the_path(prior, tmp_path, key, change, message) -> None:  # type: ignore[no-untyped-def]
    save_prior(prior, tmp_path / "prior.npz")
    with np.load(tmp_path / "prior.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    if change is None:
        del arrays[key]
    else:
        arrays[key] = change(arrays[key])
    np.savez(tmp_path / "broken.npz", **arrays)
    with pytest.raises(UserError, match=f"broken.npz: {message}"):
        load_prior(tmp_path / "broken.npz")


def test_no_file_and_no_npz_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there is no such file"):
        load_prior(tmp_path / "nothing.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(UserError, match="cannot be read as one"):
        load_prior(tmp_path / "text.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(UserError, match="array.npy: .* cannot be read as one: it holds a single array"):
        load_prior(tmp_path / "array.npy")


def test_flipped_bytes_are_one_sentence(prior: Prior, tmp_path: Path) -> None:
    save_prior(prior, tmp_path / "prior.npz")
    data = bytearray((tmp_path / "prior.npz").read_bytes())
    data[3000:3050] = bytes(255 - value for value in data[3000:3050])
    (tmp_path / "prior.npz").write_bytes(data)
    with pytest.raises(UserError, match="cannot be read as one"):
        load_prior(tmp_path / "prior.npz")
