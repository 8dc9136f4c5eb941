"""The packed Gaussians of a page: what is lost is half a step of each track, and a clip stays small."""

import hashlib
import json
import re
import struct
import zlib
from importlib import resources

import numpy as np
import pytest
from swarm import COUNT, MOMENTS, Colors, Growing, Swarm, film, only

from rewild4d.contracts import Reconstruction
from rewild4d.harmonics import seen_colors
from rewild4d.visualize.report.clouds import Collected, collect
from rewild4d.visualize.report.layout import BITS, Cloud, curve_order, pack, steps, unpack


def collected(reconstruction: Reconstruction) -> Collected:
    clip = film()
    return collect(reconstruction, clip.times, [reconstruction.camera(time) for time in clip.times])


def tracks_of(data: bytes) -> list[dict[str, dict[str, object]]]:
    """The tracks' heads of each cloud, by name."""
    raw = zlib.decompress(data)
    (length,) = struct.unpack_from("<I", raw, 6)
    return [
        {track["name"]: track for track in cloud["tracks"]} for cloud in json.loads(raw[10 : 10 + length])["clouds"]
    ]


@pytest.mark.parametrize("colors", ["rgb", "world", "own", "changing"])
def test_no_value_is_off_by_more_than_half_a_step(colors: Colors) -> None:
    made = collected(Swarm(colors)).clouds
    back = unpack(pack(made))
    assert [len(cloud) for cloud in back] == [len(cloud) for cloud in made] == [COUNT - COUNT // 10]
    for cloud, found in zip(made, back, strict=True):
        assert (found.moments, found.frame) == (cloud.moments, cloud.frame) == (MOMENTS, frame_of(colors))
        for name, bits in BITS.items():
            values = cloud.tracks[name]
            off = np.abs(found.tracks[name] - values).max((0, 1))
            # A track that stays within half a step of its first moment is written once: half a step more.
            halves = 1 if len(found.tracks[name]) > 1 else 2
            assert (off <= halves * steps(values, bits) / 2 + 1e-9).all(), name


def frame_of(colors: Colors) -> str:
    return "rgb" if colors == "changing" else colors


def test_positions_are_kept_within_half_a_step_of_sixteen_bits_in_their_box() -> None:
    found = collected(Swarm())
    box = np.ptp(found.clouds[0].tracks["means"], axis=(0, 1))
    assert found.position_error == pytest.approx(float(np.linalg.norm(box / 65535 / 2)))


def test_what_stays_is_written_once() -> None:
    (tracks,) = tracks_of(pack(collected(Swarm("own")).clouds))
    moments = {name: track["moments"] for name, track in tracks.items()}
    assert moments == {"means": MOMENTS, "quats": MOMENTS, "scales": 1, "opacities": 1, "colors": 1}
    (tracks,) = tracks_of(pack(collected(Swarm("changing")).clouds))
    assert tracks["colors"]["moments"] == MOMENTS and tracks["colors"]["components"] == 3


def test_invisible_gaussians_are_left_out_and_counted() -> None:
    found = collected(Swarm())
    assert (found.total, found.invisible) == (COUNT, COUNT // 10)
    assert (np.exp(0) * found.clouds[0].tracks["opacities"] >= 1 / 255).all()


def test_colours_that_stay_nowhere_are_those_that_the_films_camera_sees() -> None:
    swarm, clip = Swarm("changing"), film()
    found = collected(swarm)
    (cloud,) = found.clouds
    assert found.seen and not collected(Swarm("own")).seen
    camera = swarm.camera(clip.times[-1])
    assert camera is not None
    splats = swarm.at(clip.times[-1])
    wanted = seen_colors(only(splats, splats.opacities >= 1 / 255), camera.center)
    assert cloud.tracks["colors"][-1].sum(0) == pytest.approx(wanted.double().sum(0).numpy(), rel=1e-5)


def test_moments_with_other_gaussians_are_clouds_of_their_own() -> None:
    found = unpack(pack(collected(Growing()).clouds))
    assert [(len(cloud), cloud.moments) for cloud in found] == [(90, 3), (180, 2), (0, 1)]


def test_another_version_is_refused() -> None:
    raw = bytearray(zlib.decompress(pack([])))
    raw[4] += 1
    with pytest.raises(ValueError, match="expected b'R4SP' of version 1, got b'R4SP' of version 2"):
        unpack(zlib.compress(bytes(raw)))


def test_neighbours_are_close_along_the_curve() -> None:
    points = np.random.default_rng(0).random((4000, 3))
    ordered = points[curve_order(points)]
    assert np.linalg.norm(np.diff(ordered, axis=0), axis=1).mean() < 0.15
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).mean() > 0.5


def test_the_player_in_one_file_is_made_of_these_sources() -> None:
    folder = resources.files("rewild4d.visualize.report") / "player"
    names = sorted(file.name for file in folder.iterdir() if re.search(r"(?<!\.min)\.(js|json)$", file.name))
    sha = hashlib.sha256()
    for name in names:
        sha.update(name.encode() + b"\0" + (folder / name).read_bytes() + b"\0")
    bundle = (folder / "player.min.js").read_text("utf-8")
    assert bundle.startswith(f"// sources {sha.hexdigest()}\n"), "npm ci && npm run build"


def test_a_hundred_moments_of_twenty_thousand_gaussians_take_less_than_fifteen_megabytes() -> None:
    """Bytes a Gaussian and moment, of a body whose twelve parts swing and whose Gaussians sway on their own."""
    generator = np.random.default_rng(0)
    count, moments = 20_000, 25
    points = generator.normal(size=(count, 3))
    points *= np.array((0.4, 0.5, 1.2)) / np.linalg.norm(points, axis=1, keepdims=True)
    points = points[curve_order(points)]
    part, phases = np.floor((points[:, 2] + 1.2) * 5).clip(0, 11), generator.uniform(0, 6.28, (count, 3))
    angles = 0.4 * np.sin(0.25 * np.arange(moments)[:, None] + part)
    sine, cosine, (x, y, z) = np.sin(angles), np.cos(angles), points.T
    means = np.stack((np.broadcast_to(x, sine.shape), cosine * y - sine * z, sine * y + cosine * z), axis=-1)
    means = means + 0.001 * np.sin(0.3 * np.arange(moments)[:, None, None] + phases)
    quats = generator.normal(size=(count, 4))
    w, i, j, k = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    sine, cosine = np.sin(angles / 2), np.cos(angles / 2)
    turned = np.stack((cosine * w - sine * i, cosine * i + sine * w, cosine * j - sine * k, cosine * k + sine * j), -1)
    tracks = {
        "means": means, "quats": turned, "scales": generator.uniform(-5, -3, (1, count, 3)),
        "opacities": generator.uniform(0.5, 1, (1, count, 1)), "colors": generator.uniform(0, 1, (1, count, 3)),
    }  # fmt: skip
    first = len(pack([Cloud({name: values[:1] for name, values in tracks.items()}, 1, "rgb")]))
    more = (len(pack([Cloud(tracks, moments, "rgb")])) - first) / (moments - 1)
    player = (resources.files("rewild4d.visualize.report") / "player" / "player.min.js").read_bytes()
    film = 1e6
    assert (first + 99 * more) * 5 / 4 + len(player) + film < 15e6, "five digits of base 85 are four bytes"
