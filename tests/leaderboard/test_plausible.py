"""Whether numbers of a record can be right: by the ranges of their definitions; of other packages' metrics nothing."""

import math

import pytest
from records_for_tests import PROTOCOL, record

from rewild4d.leaderboard.plausible import implausible
from rewild4d.leaderboard.records import RunRecord
from rewild4d.metrics.definitions import NAMES, definition
from rewild4d.metrics.score import Score


def scored(score: Score, name: str, **about: dict[str, str]) -> RunRecord:
    """A record with one more score, which its protocol asks for, or which is another package's (``about``)."""
    base = record()
    asked = [*base.scores, *([] if about else [name])]
    return record(scores=base.scores | {name: score}, protocol=PROTOCOL | {"scores": asked}, metrics=about)


def told(found: RunRecord, name: str) -> list[str]:
    return [fault for fault in implausible(found) if fault.startswith((name, "expected the scores of its protocol"))]


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("psnr", 100.0, 101.0),
        ("psnr_black", 120.0, 121.0),  # 20 log10(1 / 1e-6)
        ("psnrm", -3.0, math.inf),
        ("pck@0.1_mask_area_bones", 1.0, 1.1),
        ("kt@0.05_mask_area", 0.0, -0.1),
        ("iou@0.7_worst5", 0.5, 1.5),
        ("accel_at_30fps_bones", 250.0, -1.0),
    ],
)
def test_values_are_in_the_range_of_their_definition(name: str, good: float, bad: float) -> None:
    unit, better = (definition(name).unit, definition(name).better) if name in NAMES else ("dB", "higher")
    assert told(scored(Score(good, unit, better, 1), name), name) == []
    assert len(told(scored(Score(bad, unit, better, 1), name), name)) == 1


def test_scores_of_other_packages_may_stand_beside_those_of_the_protocol() -> None:
    """Their means may be over pixels, and no range is known."""
    score = Score(7.0, "px", "", 30, [1.0, 9.0])
    assert told(scored(score, "strangeness", strangeness={"package": "strange", "version": "1.0"}), "strangeness") == []
    unasked = record(scores=record().scores | {"strangeness": score}, protocol=PROTOCOL)
    assert told(unasked, "strangeness")[-1].endswith("of one alone: strangeness.")
