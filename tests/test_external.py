"""Programs of others: every layout read back, every failure a sentence and a failed record, nobody's code needed."""

import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pygltflib
import pytest
import torch
from torch import Tensor

from rewild4d import runner
from rewild4d.baselines import external_alignment
from rewild4d.baselines.external import External, ExternalConfig, ExternalReconstruction
from rewild4d.baselines.external_folder import crop_box, find_outputs, write_clip
from rewild4d.baselines.external_gltf import read_animation
from rewild4d.baselines.external_profiles import PROFILES
from rewild4d.conformance import tiny_case
from rewild4d.contracts import Selection
from rewild4d.errors import UserError
from rewild4d.leaderboard.tables import standings
from rewild4d.meshes import Mesh, discs, read_mesh
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD
from rewild4d.priors.io import load_prior, save_prior
from rewild4d.priors.motion import pose_at
from rewild4d.protocol import find_protocol, render
from rewild4d.transforms import similarity, skin_points
from rewild4d.types import Case, Clip, Truth

CPU = torch.device("cpu")
UPPER = "upper bound: rotated, scaled and shifted to the best input-view PSNR"
STUB = Path(__file__).parent / "external_stub.py"


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case(frames=3)


@pytest.fixture(autouse=True)
def fewer_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A coarser grid: enough for a case this small."""
    for name, value in (("AZIMUTHS", 12), ("ELEVATIONS", (20.0,)), ("SCALES", (1.0,)), ("REFINED", 2)):
        monkeypatch.setattr(external_alignment, name, value)


def posed(case: Case, index: int) -> Tensor:
    """The true surface's vertices in the world at a frame."""
    object_to_world, transforms = pose_at(case.prior, case.clip.times[index])
    points = skin_points(case.prior.vertices, case.prior.weights, transforms).double()
    return points @ object_to_world[:3, :3].T + object_to_world[:3, 3]


def bodies(case: Case, matrix: Tensor | None = None) -> list[dict[str, Any]]:
    """What a perfect program knows of each frame, in a frame of reference of its own."""
    found = []
    rest = case.prior.vertices
    colors = 0.5 + 0.4 * torch.sin(3 * rest)
    for index in range(len(case.clip.frames)):
        points = posed(case, index)
        if matrix is not None:
            points = points @ matrix[:3, :3].T + matrix[:3, 3]
        scale = 1.0 if matrix is None else float(torch.linalg.det(matrix[:3, :3]) ** (1 / 3))
        area = discs([Mesh(points.float(), case.prior.faces)], 4000, 0)[0]
        shade = discs([Mesh(points.float(), case.prior.faces, colors)], 4000, 0)[0].colors
        assert shade is not None
        found.append({
            "points": area.points.tolist(), "colors": shade.tolist(), "radius": area.radius, "scale": scale,
            "vertices": points.tolist(), "faces": case.prior.faces.tolist(), "shade": colors.clamp(0, 1).tolist(),
        })  # fmt: skip
    return found


def settings(tmp_path: Path, what: str, content: list[dict[str, Any]], **changes: Any) -> ExternalConfig:
    path = tmp_path / f"{what}.json"
    path.write_text(json.dumps(content))
    command = f"{sys.executable} {STUB} {{clip}} {{out}} {what} {{seed}} {path}"
    return ExternalConfig(**{"command": command, "points": 4000, "timeout": 60.0, **changes})


def fit(case: Case, config: ExternalConfig, workdir: Path | None = None) -> ExternalReconstruction:
    return External().fit(
        case.clip, case.prior, config=config, seed=7, device=CPU, log=lambda *_: None, workdir=workdir
    )


def psnr(found: ExternalReconstruction, case: Case, held_out: bool = False) -> float:
    """Mean over the input or the held-out frames, on white."""
    values = []
    for frame in case.truth.held_out if held_out else case.clip.frames:
        assert frame.camera is not None
        color, alpha = render(found.at(frame.time), frame.camera)
        values.append(-10 * math.log10(float((color + 1 - alpha - frame.over(1.0)).square().mean())))
    return sum(values) / len(values)


@pytest.mark.parametrize("what", ["plain", "ascii", "order", "sh1", "sh2", "sh3"])
def test_every_kind_of_ply_gives_the_same_pictures(case: Case, tmp_path: Path, what: str) -> None:
    known = bodies(case)
    found = fit(case, settings(tmp_path, what, known))
    assert psnr(found, case) > 25
    assert found.marks == () and found.at(0.0).colors.shape[1] == (int(what[2]) + 1) ** 2 if what[:2] == "sh" else True
    torch.testing.assert_close(found.at(case.clip.times[1]).means, torch.tensor(known[1]["points"]), atol=1e-5, rtol=0)
    frame = case.clip.frames[1]
    assert frame.camera is not None
    plain = fit(case, settings(tmp_path, "plain", known))
    images = [render(each.at(frame.time), frame.camera)[0] for each in (found, plain)]
    assert (images[0] - images[1]).abs().max() < 0.02


@pytest.mark.parametrize("what", ["colored", "textured", "mesh"])
def test_meshes_become_gaussians(case: Case, tmp_path: Path, what: str) -> None:
    """With colours of their own, with a texture, and without either: then the frames paint them."""
    found = fit(case, settings(tmp_path, what, bodies(case)))
    splats = found.at(0.0)
    assert len(splats) == 4000
    frame = case.clip.frames[0]
    assert frame.camera is not None
    alpha = render(splats, frame.camera)[1]
    shared = ((alpha > 0.5) & (frame.mask > 0.5)).sum() / ((alpha > 0.5) | (frame.mask > 0.5)).sum()
    assert shared > 0.9
    if what == "textured":
        colors = {tuple(color) for color in splats.colors[:, 0].round().int().tolist()}
        assert colors == {(1, 0, 0), (0, 1, 0)}
    else:
        assert psnr(found, case) > (25 if what == "colored" else 21)
        assert psnr(found, case, held_out=True) > 17


def test_a_result_elsewhere_is_rotated_to_the_best_input_view_and_marked(case: Case, tmp_path: Path) -> None:
    """DreamMesh4D's layout, turned, moved and grown: the search brings it back, and says that it did."""
    turn = upright(case, up=2, azimuth=70.0)
    away = similarity(4.0, turn, torch.tensor((1.0, 2.0, 3.0)).double())
    config = settings(tmp_path, "dreammesh4d", bodies(case, away), profile="dreammesh4d")
    found = fit(case, config)
    assert found.marks == (UPPER,)
    truth = torch.tensor(bodies(case)[1]["points"]).double()
    means = found.at(case.clip.times[1]).means.double()
    diagonal = float((truth.amax(0) - truth.amin(0)).norm())
    # The stub's texture is grey, so the place comes from the outlines.
    assert float((means.median(0).values - truth.median(0).values).norm()) < 0.1 * diagonal
    size = float(means.std(0).norm() / truth.std(0).norm())
    assert 0.85 < size < 1.15
    assert found.diagnostics()["placed_scale"] == pytest.approx(1 / 4, rel=0.15)


def test_gaussians_elsewhere_are_found_by_their_colours(case: Case, tmp_path: Path) -> None:
    """GVFDiffusion's layout: its axes, its own number of moments."""
    away = similarity(0.5, upright(case, up=1, azimuth=200.0, sign=-1), torch.tensor((0.3, 0.1, 0.2)).double())
    config = settings(tmp_path, "gvfdiffusion", bodies(case, away), profile="gvfdiffusion")
    found = fit(case, config)  # tries every axis for up
    own = fit(case, settings(tmp_path, "plain", bodies(case)))
    assert psnr(found, case) > psnr(own, case) - 2.5
    assert len(found.moments) == 3 and found.times == pytest.approx(case.clip.times)
    notes = found.diagnostics()
    assert notes["program"] == "GVFDiffusion" and notes["placed_psnr"] > 20


def upright(case: Case, up: int, azimuth: float, sign: int = 1) -> Tensor:
    """World -> a frame of reference whose axis ``up`` (times ``sign``) is the first camera's up, turned about it."""
    camera = case.clip.frames[0].camera
    assert camera is not None
    top = torch.nn.functional.normalize(case.prior.object_to_world[0, :3, 1], dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(top, camera.world_to_camera[2, :3]), dim=0)
    angle = math.radians(azimuth)
    spin = torch.tensor(
        ((math.cos(angle), -math.sin(angle), 0), (math.sin(angle), math.cos(angle), 0), (0, 0, 1))
    ).double()
    to_z = spin @ torch.stack((side, torch.linalg.cross(top, side), top))
    if up == 2:
        return to_z
    to_y = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0))).double() @ to_z
    return to_y if sign > 0 else torch.diag(torch.tensor((1.0, -1.0, -1.0)).double()) @ to_y


def test_faunas_camera_puts_its_mesh_where_the_frame_shows_it(case: Case, tmp_path: Path) -> None:
    """A mesh as 3D-Fauna predicts it: in object space, with a camera of its own for the crop."""
    content = bodies(case)
    rest = case.prior.vertices
    for index, (frame, body) in enumerate(zip(case.clip.frames, content, strict=True)):
        assert frame.camera is not None
        object_to_world, transforms = pose_at(case.prior, frame.time)
        body["vertices"] = skin_points(rest, case.prior.weights, transforms).tolist()
        whole = frame.camera.world_to_camera @ object_to_world
        scale = torch.linalg.det(whole[:3, :3]) ** (1 / 3)
        turn, place = whole[:3, :3] / scale, whole[:3, 3] / scale
        left, top, side = crop_box(frame.mask)
        focal = side / 2 / math.tan(math.radians(12.5))
        k = frame.camera.intrinsics
        pixel = k @ (place / place[2])
        # The same size in the crop fixes its depth; the same place in the crop the rest.
        depth = float(place[2]) * focal / float(k[0, 0])
        center = torch.stack(
            ((pixel[0] - left - side / 2) / focal, (pixel[1] - top - side / 2) / focal, torch.ones(()))
        )
        seen = external_alignment._between(place / place[2], center) @ turn
        flip = torch.diag(torch.tensor((1.0, -1.0, -1.0)).double())
        moved = flip @ (depth * center.double()) - torch.tensor((0.0, 0.0, -10.0)).double()
        body["pose"] = [*(flip @ seen).T.flatten().tolist(), *moved.tolist()]
        assert index < 3
    found = fit(case, settings(tmp_path, "fauna", content, profile="3d-fauna"))
    assert found.marks == (), "its camera places it, so it is no upper bound"
    for frame in case.clip.frames:
        assert frame.camera is not None
        alpha = render(found.at(frame.time), frame.camera)[1]
        shared = ((alpha > 0.5) & (frame.mask > 0.5)).sum() / ((alpha > 0.5) | (frame.mask > 0.5)).sum()
        assert shared > 0.85


FAILURES = {
    "crash": r"ended with status 3; its last words: 'CUDA out of memory' \(log: .*program.log\)",
    "nothing": r"out: expected files frame_\*.ply or frame_\*.obj, found none",
    "half": r"expected 3 files frame_\*.ply or frame_\*.obj, one a frame, found 2; the first that is missing is 1",
    "nan": r"frame_0001.ply: expected finite x to z, got a NaN or an infinite value in vertex 5",
    "empty": r"frame_0000.ply: expected Gaussians, got none",
    "cut": r"frame_0000.ply: expected 4000 rows of 'vertex', but the file ends before",
}


@pytest.mark.parametrize("what", FAILURES)
def test_a_failure_is_one_sentence_and_a_failed_record(case: Case, tmp_path: Path, what: str) -> None:
    save_prior(case.prior, tmp_path / "prior.npz")
    protocol = msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou"))
    plan = runner.Plan(
        dataset="artemis", reader=OneCase(case), root=tmp_path, cases=(case.clip.name,), protocol=protocol,
        entries=(runner.Entry("external", "default", settings(tmp_path, what, bodies(case)), (7,)),),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD), device=CPU, out=tmp_path / "runs",
    )  # fmt: skip
    (record,) = runner.execute(plan)
    assert record.status == "failed" and record.scores == {}
    assert re.search(FAILURES[what], record.error), record.error
    assert "\n" not in record.error


def test_a_record_carries_the_mark_and_the_table_does_not_rank_it(case: Case, tmp_path: Path) -> None:
    save_prior(case.prior, tmp_path / "prior.npz")
    for index, body in enumerate(bodies(case)):
        (tmp_path / "theirs").mkdir(exist_ok=True)
        lines = [f"v {x} {y} {z}" for x, y, z in body["vertices"]]
        lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in body["faces"]]
        (tmp_path / "theirs" / f"frame_{index:04d}.obj").write_text("\n".join(lines))
    folder = str(tmp_path / "theirs")
    entries = [ExternalConfig(folder=folder, points=1000, program="theirs"),
               ExternalConfig(folder=folder, points=1000, program="rotated", placed="no", up="y")]  # fmt: skip
    protocol = msgspec.structs.replace(find_protocol("artemis", None), scores=("psnr", "iou"))
    plan = runner.Plan(
        dataset="artemis", reader=OneCase(case), root=tmp_path, cases=(case.clip.name,), protocol=protocol,
        entries=tuple(runner.Entry("external", "default", config, (0,)) for config in entries),
        prior=PriorChoice(str(tmp_path / "prior.npz"), STANDARD), device=CPU, out=tmp_path / "runs",
    )  # fmt: skip
    as_is, rotated = runner.execute(plan)
    assert (as_is.status, as_is.marks) == ("ok", []) and as_is.diagnostics["program"] == "theirs"
    assert rotated.marks == [UPPER]
    (table,) = standings([as_is, rotated])
    assert {row.kind for row in table.rows} == {"method", "unranked"}
    assert table.notes == tuple(rotated.marks)
    # Another file in the folder is another run; the same ones are the same run.
    first = plan.entries[0]
    assert runner.pieces(replace(plan, entries=(first,)))[0].run_id == as_is.run_id
    (tmp_path / "theirs" / "frame_0000.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert runner.pieces(replace(plan, entries=(first,)))[0].run_id != as_is.run_id


class OneCase:
    """A reader of the tiny case."""

    licence = "CC0 1.0"

    def __init__(self, case: Case) -> None:
        self.case = case

    def cases(self, selection: Selection) -> list[str]:
        return [self.case.clip.name]

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        return self.case.clip, self.case.truth

    def check(self) -> list[Any]:
        return []


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"command": ""}, "external: expected either --command (a program to run) or --folder (its results)"),
        ({"folder": "x"}, "external: expected either --command (a program to run) or --folder (its results)"),
        ({"profile": "dreammesh"}, "unknown profile 'dreammesh'. Did you mean 'dreammesh4d'?"),
        ({"command": "prog {clip}"}, "--command: expected {clip} and {out} for the two folders among its words"),
        ({"command": "prog {clip} {out} {what}"}, "--command: expected words with {clip}, {out}, {case} or {seed}"),
        ({"command": "/no/such/program {clip} {out}"}, "that can be started, but '/no/such/program': No such file"),
        (
            {"command": "", "folder": "/no/such/{case}"},
            "/no/such/tiny__walk: expected the folder of a program's results",
        ),
    ],
)
def test_bad_settings_are_one_sentence(case: Case, tmp_path: Path, changes: dict[str, str], sentence: str) -> None:
    with pytest.raises(UserError, match=re.escape(sentence)):
        fit(case, settings(tmp_path, "plain", [], **changes))


def test_a_program_that_does_not_end_is_ended(case: Case, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected an end within 1 s, but it was still running"):
        fit(case, settings(tmp_path, "hang", [], timeout=1.0))


def test_an_empty_mask_is_said_before_the_program_runs(case: Case, tmp_path: Path) -> None:
    frames = (replace(case.clip.frames[0], mask=torch.zeros_like(case.clip.frames[0].mask)), *case.clip.frames[1:])
    other = replace(case, clip=replace(case.clip, frames=frames))
    with pytest.raises(UserError, match="expected an animal in every frame, but a mask is empty"):
        fit(other, settings(tmp_path, "crash", []))


def test_a_program_that_has_run_to_its_end_is_not_run_again(case: Case, tmp_path: Path) -> None:
    config = settings(tmp_path, "plain", bodies(case))
    (tmp_path / "work").mkdir()
    once = fit(case, config, tmp_path / "work")
    (tmp_path / "plain.json").write_text("damaged")
    again = fit(case, config, tmp_path / "work")
    assert torch.equal(once.at(0.0).means, again.at(0.0).means)
    with pytest.raises(UserError, match="ended with status 1"):
        fit(replace(case, clip=replace(case.clip, digest="other")), config, tmp_path / "work")


def test_saved_and_loaded_it_gives_the_same_gaussians(case: Case, tmp_path: Path) -> None:
    found = fit(case, settings(tmp_path, "sh1", bodies(case)))
    found.save(tmp_path)
    loaded = External().load(tmp_path, CPU)
    assert (loaded.times, loaded.marks, loaded.notes) == (found.times, found.marks, found.notes)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(loaded.at(0.1), name), getattr(found.at(0.1), name))
    camera = loaded.camera(case.clip.times[0])
    assert camera is not None and camera.width == 96
    assert loaded.camera(17.0) is None


def test_the_written_clip_is_the_clip(case: Case, tmp_path: Path) -> None:
    import cv2

    write_clip(tmp_path, case.clip, case.prior, crops=True)
    about = json.loads((tmp_path / "clip.json").read_text())
    assert (about["name"], about["fps"], len(about["frames"])) == ("tiny/walk", 10.0, 3)
    frame, told = case.clip.frames[2], about["frames"][2]
    assert frame.camera is not None
    assert told["time"] == frame.time
    assert told["camera"]["world_to_camera"] == frame.camera.world_to_camera.tolist()
    white = cv2.imread(str(tmp_path / told["frame"]))[..., ::-1] / 255
    assert np.abs(white - frame.over(1.0).permute(1, 2, 0).numpy()).max() < 1 / 255
    rgba = cv2.imread(str(tmp_path / told["rgba"]), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]] / 255
    assert np.abs(rgba[..., :3] * rgba[..., 3:] - frame.rgb.permute(1, 2, 0).numpy()).max() < 2.5 / 255
    assert torch.equal(load_prior(tmp_path / "prior.npz").transforms, case.prior.transforms)
    left, top, side = crop_box(frame.mask)
    assert (tmp_path / "crops" / "0002_box.txt").read_text().split() == [
        "2", f"{left:g}", f"{top:g}", f"{side:g}", f"{side:g}", "96", "64", "1",
    ]  # fmt: skip
    crop = cv2.imread(str(tmp_path / "crops" / "0002_mask.png"), 0)
    assert crop.shape == (256, 256)
    share = float(frame.mask.sum()) / side**2
    assert crop.mean() / 255 == pytest.approx(share, abs=0.02)


def glb(path: Path, morph: bool, moving: bool, clips: int = 1) -> None:
    """A square that grows by a morph target, or moves with its node, over one second."""
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    offsets = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
    keys, shift = np.array([0, 1], np.float32), np.array([(0, 0, 0), (0, 0, 8)], np.float32)
    blocks = [points, faces, offsets, keys, np.array([0, 1], np.float32), shift]
    data, views, at = b"", [], 0
    for block in blocks:
        raw = block.tobytes() + b"\0" * (-block.nbytes % 4)
        views.append(pygltflib.BufferView(buffer=0, byteOffset=at, byteLength=block.nbytes))
        data, at = data + raw, at + len(raw)
    floats, shorts = 5126, 5123
    accessors = [
        pygltflib.Accessor(bufferView=0, componentType=floats, count=4, type="VEC3", min=[0, 0, 0], max=[1, 1, 0]),
        pygltflib.Accessor(bufferView=1, componentType=shorts, count=6, type="SCALAR"),
        pygltflib.Accessor(bufferView=2, componentType=floats, count=4, type="VEC3"),
        pygltflib.Accessor(bufferView=3, componentType=floats, count=2, type="SCALAR", min=[0], max=[1]),
        pygltflib.Accessor(bufferView=4, componentType=floats, count=2, type="SCALAR"),
        pygltflib.Accessor(bufferView=5, componentType=floats, count=2, type="VEC3"),
    ]
    primitive = pygltflib.Primitive(
        attributes=pygltflib.Attributes(POSITION=0), indices=1, targets=[{"POSITION": 2}] if morph else []
    )
    target = pygltflib.AnimationChannelTarget(node=0, path="weights" if morph else "translation")
    animation = pygltflib.Animation(
        samplers=[pygltflib.AnimationSampler(input=3, output=4 if morph else 5)],
        channels=[pygltflib.AnimationChannel(sampler=0, target=target)],
    )
    tree = pygltflib.GLTF2(
        scene=0, scenes=[pygltflib.Scene(nodes=[0])], nodes=[pygltflib.Node(mesh=0)],
        meshes=[pygltflib.Mesh(primitives=[primitive])], accessors=accessors, bufferViews=views,
        buffers=[pygltflib.Buffer(byteLength=len(data))], animations=[animation] * clips if moving else [],
    )  # fmt: skip
    tree.set_binary_blob(data)
    tree.save_binary(str(path))


def test_an_animated_glb_moves_by_morphs_and_by_nodes(tmp_path: Path) -> None:
    """Four moments of a second: at 0, 1/4, 1/2 and 3/4."""
    glb(tmp_path / "morph.glb", morph=True, moving=True)
    moments = read_animation(tmp_path / "morph.glb", 4)
    assert [float(parts[0].vertices[2, 0]) for parts in moments] == pytest.approx([1.0, 1.25, 1.5, 1.75])
    glb(tmp_path / "node.glb", morph=False, moving=True)
    moments = read_animation(tmp_path / "node.glb", 4)
    assert [float(parts[0].vertices[0, 2]) for parts in moments] == pytest.approx([0.0, 2.0, 4.0, 6.0])
    glb(tmp_path / "still.glb", morph=False, moving=False)
    with pytest.raises(UserError, match="still.glb: expected one animation, got none"):
        read_animation(tmp_path / "still.glb", 4)
    glb(tmp_path / "two.glb", morph=False, moving=True, clips=2)
    with pytest.raises(UserError, match="two.glb: expected one animation, got clip_0, clip_1"):
        read_animation(tmp_path / "two.glb", 4)


def test_a_glb_is_a_result(case: Case, tmp_path: Path) -> None:
    glb(tmp_path / "square.glb", morph=True, moving=True)
    config = ExternalConfig(folder=str(tmp_path), profile="glb", points=500)
    found = fit(case, config)
    sizes = [float(found.at(time).means[:, 0].amax()) for time in case.clip.times]
    assert sizes == pytest.approx([1.0, 4 / 3, 5 / 3], abs=0.05)
    glb(tmp_path / "other.glb", morph=True, moving=True)
    with pytest.raises(UserError, match=re.escape("expected one animated file *.glb or *.gltf, found 2")):
        fit(case, config)


def test_files_are_ordered_by_their_numbers(tmp_path: Path) -> None:
    for name in ("frame_10", "frame_9", "frame_2"):
        (tmp_path / f"{name}.ply").touch()
    found = find_outputs(tmp_path, PROFILES["frames"], 3)
    assert [path.stem for path in found] == ["frame_2", "frame_9", "frame_10"]


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (OBJ + "f 1 2 9\n", "expected faces of vertices 1 to 4, got one of another"),
        (OBJ + "f 1 2 x\n", "expected numbers in line 5, got 'f 1 2 x'"),
        ("v 0 0\nf 1 1 1\n", "expected vertices with three coordinates, got fewer"),
        ("", "expected vertices with three coordinates, got no vertex"),
        (OBJ, "expected a mesh with triangles, got 4 points without any"),
        ("v 0 0 nan\n" + OBJ + "f 1 2 3\n", "expected finite coordinates, got a NaN or an infinite value in vertex 0"),
    ],
)
def test_a_damaged_obj_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(UserError, match=re.escape(f"a.obj: {sentence}")):
        read_mesh(tmp_path / "a.obj")


def test_an_obj_has_polygons_backward_indices_and_colours(tmp_path: Path) -> None:
    square = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 1 1 0 0 1 0\nv 0 1 0 0 1 0\nf -4 -3 -2 -1\n"
    (tmp_path / "a.obj").write_text(square)
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    (found,) = discs([mesh], 2000, 0)
    assert found.colors is not None
    torch.testing.assert_close(found.colors[:, 1], found.points[:, 1], atol=1e-5, rtol=0)
    assert found.radius == pytest.approx(math.sqrt(1 / (math.pi * 2000)))
    # Uniform on the unit square.
    torch.testing.assert_close(found.points[:, :2].mean(0), torch.full((2,), 0.5), atol=0.03, rtol=0)
    flat = Mesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(ValueError, match="expected triangles with an area, got 1 triangles without"):
        discs([flat], 10, 0)


def test_meshes_of_one_topology_keep_their_points(case: Case) -> None:
    meshes = [Mesh(posed(case, index).float(), case.prior.faces) for index in range(2)]
    moved = meshes[0].vertices + torch.tensor((1.0, 0.0, 0.0))
    first, second = discs([meshes[0], replace(meshes[0], vertices=moved)], 300, 0)
    torch.testing.assert_close(second.points - first.points, torch.tensor((1.0, 0, 0)).expand(300, 3))
