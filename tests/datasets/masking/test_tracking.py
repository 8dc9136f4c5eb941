"""`masks --tool track`: boxes on any frame or none, both directions, neighbours, losses; and the network's plumbing."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import moving
import numpy as np
import pytest
from calling import call, refusal
from films import iou

from rewild4d.datasets.masking import neighbours, tracking
from rewild4d.datasets.masking.flow import Flow, carried
from rewild4d.datasets.masking.following import Follower
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.saliency import Saliency
from rewild4d.datasets.masking.tracking import track_masks
from rewild4d.errors import UserError
from rewild4d.metrics.weights import is_here, load_weights

SIZE = (192, 128)
BOX = (8.0, 40.0, 64.0, 56.0)
"""Around the animal in frame 0."""


def red(image: np.ndarray) -> np.ndarray:
    """A network to which red things stand out."""
    return cv2.GaussianBlur((image[..., 0] > 150).astype(np.float32), (0, 0), 1.0)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Red things stand out, and no weights are needed."""
    monkeypatch.setattr(tracking, "is_here", lambda _: True)
    monkeypatch.setattr(tracking, "load_weights", lambda _: None)
    monkeypatch.setattr(tracking, "Saliency", lambda _: red)


def film(pictures: list[np.ndarray], **boxes: tuple[float, float, float, float]) -> Unmasked:
    stems = tuple(f"{100 + number:05d}" for number in range(len(pictures)))
    known = {int(name.removeprefix("at")): box for name, box in boxes.items()}
    return Unmasked("film", stems, SIZE, lambda: iter(pictures), known)


def walking(count: int = 8) -> list[np.ndarray]:
    return [textured(moving.image(number, SIZE)) for number in range(count)]


def textured(image: np.ndarray) -> np.ndarray:
    """Something for flow to hold on to, which stands still."""
    noise = np.random.default_rng(0).integers(0, 30, image.shape[:2])[..., None]
    return np.clip(image.astype(int) + noise, 0, 255).astype(np.uint8)


def found(source: Unmasked) -> list[np.ndarray]:
    masks = list(track_masks(source))
    assert all(mask.shape == SIZE[::-1] and set(np.unique(mask)) <= {0, 255} for mask in masks)
    return [mask > 0 for mask in masks]


@pytest.mark.usefixtures("network")
@pytest.mark.parametrize("boxes", [{"at0": BOX}, {"at5": (18.0, 40.0, 64.0, 56.0)}, {}])
def test_an_animal_is_followed_from_a_box_on_any_frame_and_from_none(
    boxes: dict[str, tuple[float, float, float, float]],
) -> None:
    masks = found(film(walking(), **boxes))
    assert len(masks) == 8
    for number, mask in enumerate(masks):
        assert iou(mask, moving.mask(number, SIZE) > 0) > 0.9, number


@pytest.mark.usefixtures("network")
def test_frames_before_a_box_come_first_and_each_box_starts_anew() -> None:
    starts: list[int] = []

    class Spy(Follower):
        def __init__(self, *given: object) -> None:
            starts.append(1)
            super().__init__(*given)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "Follower", Spy)
        masks = found(film(walking(), at3=(14.0, 40.0, 64.0, 56.0), at6=(20.0, 40.0, 64.0, 56.0)))
    assert len(starts) == 2, "one from each box"
    places = [float(np.nonzero(mask)[1].mean()) for mask in masks]
    assert places == sorted(places), "the animal walks to the right"


@pytest.mark.usefixtures("network")
def test_two_animals_ask_for_a_box_and_none_says_so() -> None:
    two = textured(moving.image(0, SIZE))
    two[40:96, 120:180] = (210, 40, 30)
    with pytest.raises(
        UserError, match=r"film: 2 things stand out in frame 00100; choose: --box 00100:120,40,60,56 or "
    ):
        found(film([two]))
    small = textured(moving.image(0, SIZE))
    small[10:20, 170:180] = (210, 40, 30)
    assert iou(found(film([small]))[0], moving.mask(0, SIZE) > 0) > 0.9, "a small thing does not compete"
    meadow = textured(np.full((*SIZE[::-1], 3), 60, np.uint8))
    with pytest.raises(
        UserError, match="film: nothing in it stands out; give a box: --box frame:left,top,width,height"
    ):
        found(film([meadow] * 2))
    with pytest.raises(UserError, match=r"--box: expected a box inside the frame of 192 x 128 pixels, got 200,1,5,5\."):
        found(film([meadow], at0=(200, 1, 5, 5)))


@pytest.mark.usefixtures("network")
def test_an_animal_that_leaves_is_lost_and_found_again() -> None:
    meadow = textured(moving.image(0, SIZE, left=-60))
    masks = found(film([*walking(3), *[meadow] * 2, *walking(3)], at0=BOX))
    assert masks[2].any() and not masks[3].any() and not masks[4].any()
    assert iou(masks[7], moving.mask(2, SIZE) > 0) > 0.9
    other = meadow.copy()
    other[40:96, 100:160] = (250, 250, 40)  # stands out too, in other colours
    assert not found(film([*walking(3), meadow, other], at0=BOX))[4].any()


def uncovering() -> tuple[Unmasked, list[np.ndarray]]:
    """A stripe of the animal's colours comes out from behind it as it walks, and comes loose; the film, the truth."""
    wide, high = 640, 320
    noise = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 60, (high, wide, 3)), (0, 0), 2.0) * 2
    still = np.clip(np.array((200, 60, 40)) + noise, 0, 255)
    pictures, truth = [], []
    for number in range(24):
        picture = np.clip(np.array((60, 110, 60)) + noise[::-1], 0, 255)
        picture[130:210, 190:230] = still[::-1][130:210, 190:230]  # the neighbour
        animal = np.zeros((high, wide), bool)
        animal[100:240, 80 + 10 * number : 240 + 10 * number] = True
        picture[animal] = np.roll(still, 10 * number, axis=1)[animal]
        pictures.append(picture.astype(np.uint8))
        truth.append(animal)
    stems = tuple(map(str, range(24)))
    return Unmasked("film", stems, (wide, high), lambda: iter(pictures), {0: (80, 100, 160, 140)}), truth


def neighbour(mask: np.ndarray, animal: np.ndarray) -> float:
    """Share of what is seen of the neighbour that is in a mask."""
    seen = ~animal[130:210, 190:230]
    return float((mask[130:210, 190:230] > 0)[seen].mean()) if seen.any() else 0.0


@pytest.mark.usefixtures("network")
def test_a_neighbour_that_comes_loose_is_no_part_of_the_animal_before_it_does() -> None:
    source, truth = uncovering()
    masks = list(track_masks(source))
    assert not masks[-1][130:210, 190:230].any() and max(map(neighbour, masks, truth)) < 0.05
    assert min(iou(mask > 0, animal) for mask, animal in zip(masks, truth, strict=True)) > 0.94
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbours, "LEAST_LOOSE", 9.0)
        late = list(map(neighbour, track_masks(source), truth))
    assert late[-1] == 0 and max(late) > 0.9, "what is known when it has come loose alone"


@pytest.mark.usefixtures("network")
def test_it_is_taken_out_of_what_is_followed_back_too() -> None:
    source, truth = uncovering()
    back = replace(source, images=lambda: reversed(list(source.images())), boxes={23: (80.0, 100.0, 160.0, 140.0)})
    masks = list(track_masks(back))
    assert max(map(neighbour, masks, reversed(truth))) < 0.05
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbours, "LEAST_LOOSE", 9.0)
        assert max(map(neighbour, track_masks(back), reversed(truth))) > 0.9


def test_masks_come_late_in_their_order_and_small_loose_parts_change_none() -> None:
    image, recent = textured(moving.image(0, SIZE)), neighbours.Recent()
    masks = [np.zeros(SIZE[::-1], bool) for _ in range(neighbours.FRAMES + 2)]
    speck = np.zeros(SIZE[::-1], bool)
    for number, mask in enumerate(masks):
        mask[40:96, 8 : 72 + number] = True
    speck[40:42, 8:20] = True
    ready = [each for mask in masks for each in recent.add(image, mask, speck)]
    assert [int(mask.sum()) for mask in [*ready, *recent.rest()]] == [56 * (64 + number) for number in range(26)]
    assert len(ready) == 2 and not recent.rest()


def test_flow_says_where_pixels_came_from_and_where_it_is_not_sure() -> None:
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (80, 120)).astype(np.uint8), (0, 0), 1.5)
    before, after = np.roll(ground, 0, 1), np.roll(ground, 4, 1)
    flow, sure = Flow().checked(after, before)
    inside = np.s_[16:-16, 16:-16]
    assert np.abs(flow[inside] - (-4, 0)).mean() < 0.3 and sure[inside].mean() > 0.95
    mark = np.zeros((80, 120), np.float32)
    mark[30:50, 40:60] = 1
    assert iou(carried(mark, flow) > 0.5, np.roll(mark, 4, 1) > 0.5) > 0.9
    unlike = rng.integers(0, 255, (80, 120)).astype(np.uint8)
    assert Flow().checked(after, unlike)[1].mean() < 0.5


def test_without_weights_masks_are_rough_and_a_line_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "is_here", lambda _: False)
        moving.frames(tmp_path / "clip", size=SIZE)
        words = ("masks", "--video", str(tmp_path / "clip"), "--out", str(tmp_path / "m"))
        assert call(*words, "--box", "8,40,64,56") == 0
        out, err = capsys.readouterr()
        assert "12 masks by 'track', 0 of them without the animal" in out
        assert "the network 'u2netp' is not here, so these are rough masks, from flow and colours alone" in err
        assert "the rough masks need a box around the animal" in refusal(capsys, *words)


def published() -> Saliency:
    if not is_here("u2netp"):
        pytest.skip("no weights of u2netp: rewild4d-bench weights fetch u2netp")
    return Saliency(load_weights("u2netp"))


def test_with_the_published_weights_an_animal_stands_out() -> None:
    image = textured(moving.image(20, SIZE))
    assert iou(published()(image) > 0.5, moving.mask(20, SIZE) > 0) > 0.8


def test_a_real_camel_is_followed(davis: Path) -> None:
    """Ten frames of DAVIS from a box around the first mask; all ninety: docs/experiments/tracking.md."""
    published()
    files = sorted((davis / "JPEGImages" / "480p" / "camel").glob("*.jpg"))[:10]
    truth = [cv2.imread(str(davis / "Annotations/480p/camel" / f"{file.stem}.png"), 0) for file in files]
    assert truth[0] is not None

    def images() -> Iterator[np.ndarray]:
        for file in files:
            image = cv2.imread(str(file))
            assert image is not None
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    left, top, width, height = cv2.boundingRect(truth[0])
    source = Unmasked("camel", tuple(file.stem for file in files), (854, 480), images, {0: (left, top, width, height)})
    scores = [
        iou(mask > 0, true > 127) for mask, true in zip(track_masks(source), truth, strict=True) if true is not None
    ]
    assert np.mean(scores) > 0.93
