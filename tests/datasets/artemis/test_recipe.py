"""A rendered folder is known by what it was made of, until somebody edits it."""

import json
import shutil
from pathlib import Path

import pygltflib
import pytest
from rig_files import build

from rewild4d.contracts import Selection
from rewild4d.datasets.artemis.reader import Artemis
from rewild4d.datasets.artemis.recipe import FILE, read_recipe
from rewild4d.datasets.rigs.reader import content
from rewild4d.datasets.rigs.studio import make_artemis
from rewild4d.errors import UserError
from rewild4d.running import provenance


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return rendered(build(tmp_path / "rig.glb"), tmp_path / "toy")


def rendered(rig: Path, out: Path, views: int = 2, width: int = 32) -> Path:
    return make_artemis(rig, "Trot", views, 2, width, 18, out)


def test_the_recipe_names_what_was_rendered_and_not_where(folder: Path, tmp_path: Path) -> None:
    known = read_recipe(folder)
    assert len(known) == 16
    copied = shutil.copy(tmp_path / "rig.glb", tmp_path / "copy.glb")
    assert read_recipe(rendered(Path(copied), tmp_path / "again")) == known
    others = (
        rendered(tmp_path / "rig.glb", tmp_path / "more", views=3),
        rendered(tmp_path / "rig.glb", tmp_path / "wide", width=34),
        rendered(build(tmp_path / "other.glb", move_tag=True), tmp_path / "other"),
    )
    assert len({known, *map(read_recipe, others)}) == 4


def test_other_pixels_of_the_same_recipe_are_known_by_it(folder: Path, tmp_path: Path) -> None:
    """As another processor renders them: the digest of the files is its own, the ingredients are the same."""
    known, twin = read_recipe(folder), rendered(tmp_path / "rig.glb", tmp_path / "twin", width=34)
    recipe = json.loads((twin / FILE).read_text())
    recipe["ingredients"]["width"] = 32
    (twin / FILE).write_text(json.dumps(recipe))
    assert read_recipe(twin) == known


@pytest.mark.parametrize("change", ["edited", "added", "removed", "renamed"])
def test_a_folder_that_was_edited_is_new_data(folder: Path, change: str) -> None:
    image = folder / "img" / "Trot" / "0" / "img_0001.png"
    if change == "edited":
        image.write_bytes(image.read_bytes().replace(b"IEND", b"IENE"))
    elif change == "added":
        (folder / "notes.txt").write_text("mine")
    elif change == "removed":
        (folder / "licence.txt").unlink()
    else:
        image.rename(image.with_name("other.png"))
    assert read_recipe(folder) == ""


def test_a_record_has_the_recipe_and_check_tells_of_an_edit(folder: Path) -> None:
    reader = Artemis(folder)
    selection = Selection(cameras="sweep", size=32)
    clip, _ = reader.load("toy/Trot", selection)
    assert provenance.reading(reader, clip) == {"recipe": read_recipe(folder)}
    assert not [finding for finding in reader.check() if "rendered" in finding.message]
    (folder / "licence.txt").write_text("mine\n")
    (told,) = [finding for finding in reader.check() if "rendered" in finding.message]
    assert (told.level, Path(told.path).name) == ("warning", FILE)
    assert provenance.reading(reader, clip) == {}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"ingredients": {}, "files": 3}'])
def test_a_damaged_recipe_is_none(folder: Path, text: str) -> None:
    (folder / FILE).write_text(text)
    assert read_recipe(folder) == ""


def test_the_content_of_a_rig_includes_the_files_beside_it(tmp_path: Path) -> None:
    tree = pygltflib.GLTF2().load(str(build(tmp_path / "rig.glb")))
    data = tree.binary_blob()
    tree.buffers[0].uri = "the%20data.bin"
    tree.save_json(str(tmp_path / "rig.gltf"))
    (tmp_path / "the data.bin").write_bytes(data)
    known = content(tmp_path / "rig.gltf")
    (tmp_path / "the data.bin").write_bytes(b"\1" + data[1:])
    assert content(tmp_path / "rig.gltf") == content(tmp_path / "rig.gltf") != known
    (tmp_path / "the data.bin").unlink()
    with pytest.raises(UserError, match=r"the data\.bin: expected the file that rig\.gltf names, but: No such file"):
        content(tmp_path / "rig.gltf")
