"""What lies behind an animal: still and panning cameras, cuts, what is never seen; and what it gives to `track`."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from films import iou

from rewild4d.datasets.masking import following, tracking
from rewild4d.datasets.masking.backdrop import RANGE, Backdrop
from rewild4d.datasets.masking.makers import Unmasked
from rewild4d.datasets.masking.parts import others
from rewild4d.datasets.masking.tracking import track_masks

WIDE, HIGH, COUNT = 320, 160, 60
RED, BLUE = (200, 50, 40), (40, 60, 220)


def red(image: np.ndarray) -> np.ndarray:
    """A network to which red things stand out."""
    return cv2.GaussianBlur(((image[..., 0] > 150) & (image[..., 2] < 120)).astype(np.float32), (0, 0), 1.0)


def ground(seed: int = 0, wide: int = WIDE) -> np.ndarray:
    """A meadow with something for corners to hold on to, [HIGH, wide, 3]."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 60, (HIGH, wide, 3)), (0, 0), 1.5) * 1.5
    return np.clip(np.array((70, 110, 70)) + noise, 0, 140).astype(np.uint8)


def box(left: int, top: int, wide: int, high: int) -> np.ndarray:
    found = np.zeros((HIGH, WIDE), bool)
    found[top : top + high, max(0, left) : max(0, left + wide)] = True
    return found


def passing(number: int) -> np.ndarray:
    return box(10 + 4 * number, 60, 30, 30)


def painted(picture: np.ndarray, color: tuple[int, int, int], *where: np.ndarray) -> np.ndarray:
    """Things on a picture, each with spots that move with it."""
    found = picture.copy()
    for mask in where:
        spots = np.roll(ground(9).astype(int) - 80, int(np.nonzero(mask)[1].min()), axis=1) // 3
        found[mask] = np.clip(np.array(color) + spots, 0, 255)[mask]
    return found


@pytest.mark.parametrize("pan", [0, 1], ids=["still", "panning"])
def test_what_moves_is_no_backdrop_though_it_does_not_stand_out(pan: int) -> None:
    meadow = ground(wide=WIDE + pan * COUNT)
    pictures = [painted(meadow[:, pan * k : pan * k + WIDE], BLUE, passing(k)) for k in range(COUNT)]
    backdrop = Backdrop(pictures, red)
    for number in (20, 30, COUNT - 1):
        odds, thing = backdrop.odds(number, pictures[number]), passing(number)
        assert odds.shape == (HIGH, WIDE) and odds.min() >= RANGE[0] and odds.max() <= RANGE[1]
        around = (cv2.dilate(thing.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0) & (odds != 0)
        assert (odds[thing] > 1).mean() > 0.9 and (odds[around] < 0).mean() > 0.95, number
        assert (odds == 0).mean() < 0.2, "unknown where the camera looks for a short time"


def test_nothing_is_known_of_what_is_hidden_throughout_nor_across_a_cut() -> None:
    stays = box(100, 60, 60, 40)
    pictures = [painted(ground(), RED, stays) for _ in range(COUNT)]
    odds = Backdrop(pictures, red).odds(20, pictures[20])
    assert (odds[stays] == 0).all() and (odds[:, 200:] < -1).mean() > 0.95
    two = [ground(1 + (k >= 20)) for k in range(40)]
    backdrop = Backdrop(two, red)
    for number in (2, 38):
        assert (backdrop.odds(number, two[number]) == 0).all(), "two other frames of a shot, where four are wanted"
    long = [ground(1 + (k >= 40)) for k in range(80)]
    backdrop = Backdrop(long, red)
    for number in (39, 40):
        assert (backdrop.odds(number, long[number]) < 0).mean() > 0.95, "compared with frames of its own shot alone"


def test_one_frame_alone_and_pictures_without_corners_tell_nothing() -> None:
    assert not Backdrop([ground()], red).odds(0, ground()).any()
    plain = np.full((HIGH, WIDE, 3), 90, np.uint8)
    assert not Backdrop([plain] * COUNT, red).odds(20, plain).any()


def test_frames_are_read_when_the_first_backdrop_is_wanted_and_once() -> None:
    read: list[int] = []

    def images() -> Iterator[np.ndarray]:
        for number in range(COUNT):
            read.append(number)
            yield ground()

    backdrop = Backdrop(images(), red)
    assert not read, "a film in which two things stand out is refused before that"
    for _ in range(2):
        assert (backdrop.odds(20, ground()) < 0).mean() > 0.95 and read == [*range(COUNT)]


def test_others_are_large_things_away_from_the_animal() -> None:
    animal, person, speck, near = box(20, 40, 60, 60), box(200, 20, 40, 90), box(290, 10, 8, 8), box(85, 40, 20, 80)
    apart = np.where(animal | person | speck | near, 3.0, -3.0).astype(np.float32)
    assert iou(others(animal, apart) > 0, person) == 1
    assert iou(others(animal, np.where(person, 0, apart)) > 0, person) == 1, "what is hidden throughout"
    assert not others(animal, np.zeros_like(apart)).any() and not others(np.zeros_like(animal), apart).any()


def followed(pictures: list[np.ndarray], at: tuple[int, int, int, int]) -> list[np.ndarray]:
    stems = tuple(map(str, range(len(pictures))))
    where = tuple(map(float, at))
    source = Unmasked("film", stems, (WIDE, HIGH), lambda: iter(pictures), {0: where})  # type: ignore[dict-item]
    return [mask > 0 for mask in track_masks(source)]


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Red things stand out, and no weights are needed."""
    monkeypatch.setattr(tracking, "is_here", lambda _: True)
    monkeypatch.setattr(tracking, "load_weights", lambda _: None)
    monkeypatch.setattr(tracking, "Saliency", lambda _: red)


def walker(number: int) -> tuple[np.ndarray, np.ndarray]:
    """The body and the head of an animal that walks to the right."""
    left = 20 + 3 * number
    return box(left, 50, 60, 40), box(left + 60, 40, 20, 24)


@pytest.mark.usefixtures("network")
def test_a_head_that_does_not_stand_out_is_part_of_the_animal(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = [painted(painted(ground(), RED, walker(k)[0]), BLUE, walker(k)[1]) for k in range(COUNT)]
    masks = followed(pictures, (20, 40, 80, 50))
    assert min(mask[walker(k)[1]].mean() for k, mask in enumerate(masks)) > 0.8
    assert min(iou(mask, walker(k)[0] | walker(k)[1]) for k, mask in enumerate(masks)) > 0.85
    monkeypatch.setattr(following, "BEHIND", 0.0)
    assert max(mask[walker(k)[1]].mean() for k, mask in enumerate(followed(pictures, (20, 40, 80, 50)))) < 0.3


@pytest.mark.usefixtures("network")
@pytest.mark.parametrize("touching", [0, 4], ids=["touching", "a gap"])
def test_a_person_whom_the_animal_comes_to_is_no_part_of_it(monkeypatch: pytest.MonkeyPatch, touching: int) -> None:
    person = box(250, 10, 40, 130)

    def there(number: int) -> np.ndarray:
        return box(min(20 + 4 * number, 190 - touching), 50, 60, 40)

    pictures = [painted(ground(), RED, there(k), person) for k in range(COUNT)]
    masks = followed(pictures, (20, 50, 60, 40))
    assert max(mask[person].mean() for mask in masks) < 0.1
    assert min(iou(mask, there(k)) for k, mask in enumerate(masks)) > 0.85
    if not touching:
        monkeypatch.setattr(following, "OTHER", 0.0)
        assert max(mask[person].mean() for mask in followed(pictures, (20, 50, 60, 40))) > 0.5
