"""The built-in animals: closed surfaces, sound skinning, gaits that loop and stand on the ground, three body plans."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rewild4d.datasets.builtin import synthetic
from rewild4d.datasets.builtin.anatomy import assemble
from rewild4d.datasets.builtin.gait import FEET, foot_path, pose
from rewild4d.datasets.rigs.animal import AnimatedAnimal
from rewild4d.errors import UserError
from rewild4d.files import digest

NAMES = synthetic.animals()


def in_body_frame(animal: AnimatedAnimal, points: np.ndarray) -> np.ndarray:
    world = synthetic.placement(animal.name)
    return (points - world[:3, 3]) @ world[:3, :3]


@pytest.mark.parametrize("name", NAMES)
def test_surface_is_closed_and_faces_outwards(name: str) -> None:
    surface = synthetic.rest_surface(name)
    corners = surface.faces
    edges = np.concatenate((corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]))
    there, back = (np.sort(e @ (len(surface.vertices), 1)) for e in (edges, edges[:, ::-1]))
    assert np.array_equal(there, back)  # every edge is walked once each way
    a, b, c = (surface.vertices[corners[:, k]] for k in range(3))
    volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6
    box = np.ptp(surface.vertices, axis=0).prod()
    assert 0.05 * box < volume < 0.6 * box
    assert 5_000 < len(surface.vertices) < 25_000
    assert np.unique(corners).size == len(surface.vertices)


@pytest.mark.parametrize("name", NAMES)
def test_skinning_and_colours_are_sound(name: str) -> None:
    surface, bones = synthetic.rest_surface(name), len(synthetic.build(name)[0].bone_names)
    np.testing.assert_allclose(surface.bone_weights.sum(axis=1), 1.0, atol=1e-12)
    assert surface.bone_weights.min() >= 0
    assert surface.bone_indices.min() >= 0 and surface.bone_indices.max() < bones
    assert surface.colors.min() >= 0 and surface.colors.max() <= 1
    assert surface.colors.std(axis=0).min() > 0.1  # a pattern, not one colour


@pytest.mark.parametrize("name", NAMES)
def test_bones_are_rigid_and_the_tree_is_ordered(name: str) -> None:
    for animal in synthetic.build(name):
        for matrices in (animal.bones_rest, animal.bones):
            rotation = matrices[..., :3, :3]
            np.testing.assert_allclose(rotation @ np.swapaxes(rotation, -1, -2), np.eye(3) + 0 * rotation, atol=1e-9)
            np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-9)
        assert animal.parents[0] == -1
        assert (animal.parents[1:] < np.arange(1, len(animal.parents))).all() and (animal.parents[1:] >= 0).all()
        assert animal.licence == "CC0 1.0 (made by rewild4d)"


@pytest.mark.parametrize("name", NAMES)
def test_gait_is_a_smooth_loop(name: str) -> None:
    for animal in synthetic.build(name):
        posed = np.stack([animal.posed(t)[0] for t in range(len(animal.bones))])
        steps = np.linalg.norm(np.roll(posed, -1, axis=0) - posed, axis=-1).max(axis=1)
        assert steps[-1] < 1.25 * steps[:-1].max()  # the last frame leads into the first like any other
        assert steps.max() < 0.2 * np.linalg.norm(np.ptp(posed[0], axis=0))


@pytest.mark.parametrize("name", NAMES)
def test_a_cycle_ends_where_it_starts(name: str) -> None:
    skeleton, _ = assemble(synthetic.RECIPES[name].body)
    for gait in synthetic.RECIPES[name].motions.values():
        np.testing.assert_allclose(pose(skeleton, gait, 1.0), pose(skeleton, gait, 0.0), atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_feet_in_stance_stay_on_the_ground_and_move_with_it(name: str) -> None:
    recipe = synthetic.RECIPES[name]
    for animal, gait in zip(synthetic.build(name), recipe.motions.values(), strict=True):
        surface, frames = animal.surfaces[0], len(animal.bones)
        height = np.ptp(synthetic.rest_surface(name).vertices[:, 1])
        posed = np.stack([in_body_frame(animal, animal.posed(t)[0]) for t in range(frames)])
        for touchdown, foot in zip(gait.touchdown, FEET, strict=True):
            limb, side = foot.split(".")
            toe = animal.bone_names.index(f"{limb}.3.{side}")
            sole = (surface.bone_weights * (surface.bone_indices == toe)).sum(axis=1) > 0.9
            lowest = posed[:, sole, 1].min(axis=1)
            phase = (np.arange(frames) / frames - touchdown) % 1.0
            stance = phase < gait.duty
            assert np.abs(lowest[stance]).max() < 0.02 * height
            assert lowest[~stance].max() > 0.015 * height
            ahead = posed[:, sole, 2].mean(axis=1)[stance][np.argsort(phase[stance])]
            # The ground passes at stride / duty a cycle; a planted foot goes with it.
            np.testing.assert_allclose(np.diff(ahead), -gait.stride / gait.duty / frames, atol=0.01 * height)


def test_left_and_right_walk_half_a_cycle_apart() -> None:
    skeleton, _ = assemble(synthetic.RECIPES["horse"].body)
    gait = synthetic.RECIPES["horse"].motions["walk"]
    for limb in ("fore", "hind"):
        left, right = (skeleton.names.index(f"{limb}.2.{side}") for side in "LR")
        now, later = pose(skeleton, gait, 0.3), pose(skeleton, gait, 0.8)
        np.testing.assert_allclose(now[left, :3, :3], later[right, :3, :3], atol=0.03)
        assert np.abs(now[left, :3, :3] - now[right, :3, :3]).max() > 0.1


def test_foot_path_is_continuous() -> None:
    gait = synthetic.RECIPES["tiger"].motions["walk"]
    for phase in (0.0, gait.duty):
        before, after = foot_path(gait, (phase - 1e-6) % 1.0), foot_path(gait, phase + 1e-6)
        np.testing.assert_allclose(before, after, atol=1e-4)


def test_three_body_plans() -> None:
    def plan(name: str) -> tuple[float, float]:
        """Height over length, and length of the neck over that of the fore leg."""
        size = np.ptp(synthetic.rest_surface(name).vertices, axis=0)
        skeleton, _ = assemble(synthetic.RECIPES[name].body)
        joints = dict(zip(skeleton.names, skeleton.heads, strict=True))
        return size[1] / size[2], np.linalg.norm(joints["head"] - joints["neck.0"]) / joints["fore.0.L"][1]

    horse, tiger, giraffe = plan("horse"), plan("tiger"), plan("giraffe")
    assert tiger[0] < 0.6 < horse[0] < 1.0 < 1.3 < giraffe[0]
    assert max(horse[1], tiger[1]) < 0.75 < giraffe[1]


def test_worlds_differ_in_their_up_axis_and_heading() -> None:
    ups = {tuple(synthetic.build(name)[0].up) for name in NAMES}
    assert ups == {(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)}
    for name in NAMES:
        animal, world = synthetic.build(name)[0], synthetic.placement(name)
        np.testing.assert_allclose(world[:3, :3] @ (0, 1, 0), animal.up, atol=1e-12)
        assert np.linalg.det(world) == pytest.approx(1.0)
        height = animal.surfaces[0].vertices @ animal.up - np.array(synthetic.RECIPES[name].place) @ animal.up
        assert abs(height.min()) < 0.02 * np.ptp(height)


def test_the_coat_differs_between_left_and_right() -> None:
    surface = synthetic.rest_surface("giraffe")
    order = {tuple(np.round(v, 6)): i for i, v in enumerate(surface.vertices)}
    pairs = [(i, order.get(tuple(np.round(v * (-1, 1, 1), 6)))) for i, v in enumerate(surface.vertices) if v[0] > 0.05]
    found = np.array([(i, j) for i, j in pairs if j is not None])
    assert len(found) > 0.8 * len(pairs)  # the shape is a mirror image
    assert np.abs(surface.colors[found[:, 0]] - surface.colors[found[:, 1]]).mean() > 0.05  # the coat is not


def test_building_twice_gives_the_same_bytes() -> None:
    def everything() -> str:
        synthetic.build.cache_clear()
        synthetic.rest_surface.cache_clear()
        animal = synthetic.build("tiger")[0]
        surface = animal.surfaces[0]
        return digest(surface.vertices, surface.faces, surface.bone_weights, surface.colors, animal.bones)

    assert everything() == everything()


@pytest.mark.parametrize(
    ("name", "place", "spread", "color", "joints"),
    [
        ("horse", (0.0007, 1.0963, 0.0457), (0.1674, 0.4724, 0.6700), (0.5477, 0.3832, 0.2785), (0.7072, 0.7200)),
        ("tiger", (0.0000, 0.6411, 0.0136), (0.1322, 0.2920, 0.6650), (0.6655, 0.4716, 0.2674), (1.3265,)),
        ("giraffe", (0.0000, 2.1225, 0.2286), (0.2387, 1.1070, 0.8060), (0.7482, 0.5942, 0.4024), (2.0927,)),
    ],
)
def test_what_builtin_v1_looks_like(
    name: str, place: tuple[float, ...], spread: tuple[float, ...], color: tuple[float, ...], joints: tuple[float, ...]
) -> None:
    """Tables hold all records of one version side by side: who changes an animal on purpose raises the version in
    `synthetic.ensure`, then these numbers (means and standard deviations, metres) and those of the rendering below."""
    surface = synthetic.rest_surface(name)
    assert surface.vertices.mean(axis=0) == pytest.approx(place, abs=3e-4)
    assert surface.vertices.std(axis=0) == pytest.approx(spread, abs=3e-4)
    assert surface.colors.mean(axis=0) == pytest.approx(color, abs=3e-4)
    assert [np.abs(animal.bones[..., :3, 3]).mean() for animal in synthetic.build(name)] == pytest.approx(
        joints, abs=3e-4
    )


def test_unknown_animal_gets_a_suggestion() -> None:
    with pytest.raises(UserError, match="unknown built-in animal 'hors'. Did you mean 'horse'"):
        synthetic.build("hors")


def test_render_makes_what_is_missing_once(tmp_path: Path) -> None:
    root, seen = tmp_path / "cache" / "set", []
    synthetic.render(root, ["tiger"], views=2, width=48, height=32, progress=lambda *pair: seen.append(pair))
    assert seen[-1] == (2 * synthetic.FRAMES,) * 2
    assert [path.name for path in root.iterdir()] == ["tiger"]
    assert [path.name for path in root.parent.iterdir()] == ["set"]
    pictures = sorted(path for path in root.rglob("*") if path.suffix in (".png", ".jpg"))
    assert len(pictures) == 2 * 2 * synthetic.FRAMES
    colors = [np.asarray(Image.open(path).convert("RGB"), float).mean(axis=(0, 1)) for path in pictures]
    assert np.mean(colors, axis=0) == pytest.approx((48.10, 38.96, 29.53), abs=0.05)  # of builtin-v1, see above
    again: list[tuple[int, int]] = []
    synthetic.render(root, ["tiger"], views=2, width=48, height=32, progress=lambda *pair: again.append(pair))
    assert again == []


def test_ensure_names_a_cache_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("REWILD4D_CACHE", str(tmp_path / "file"))
    with pytest.raises(UserError, match="expected a folder that can be written"):
        synthetic.ensure()
