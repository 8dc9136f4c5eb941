"""Which template a clip gets: the better of those that ran the same rounds, the usual one where they are close."""

from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import torch
from walking import shortened, silent, walking_clip

from rewild4d.errors import UserError
from rewild4d.kernels.switch import VARIABLE
from rewild4d.priors import fit
from rewild4d.priors.bodies.choice import KINDS
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import STANDARD, Stage
from rewild4d.priors.fit import fit_template
from rewild4d.priors.race import HANDICAP, ONE_SIDE_HANDICAP, Race, decided, steps_of

STAGES = tuple(Stage(size=32, steps=steps, blur=(0.1, 0.1), keep=1, joints=steps > 1) for steps in (1, 2, 4))


class Told:
    """A race that costs what it is told to, and remembers the rounds that it ran."""

    def __init__(self, name: str, cost: float, handicap: float) -> None:
        self.handicap = handicap
        self.guesses = SimpleNamespace(body=SimpleNamespace(name=name))
        self.misfits, self.figures, self.ran = torch.tensor([9.0, cost]), cast(dict[str, float], {}), 0
        self.costs = self.misfits - torch.tensor([0.0, 0.6])  # the verdict may be negative, and names no body

    def run(self, stage: Stage) -> None:
        self.ran += stage.steps


def run(*costs: float, handicap: float = HANDICAP) -> tuple[list[Any], Any]:
    races = [Told(name, cost, handicap) for name, cost in zip(("usual", "other", "third"), costs, strict=False)]
    return races, decided(cast(list[Race], races), STAGES)


def test_all_run_until_joints_were_fitted_and_the_best_runs_on() -> None:
    races, best = run(0.5, 0.2, 0.4)
    assert best is races[1] and [race.ran for race in races] == [1 + 2, 1 + 2 + 4, 1 + 2]
    assert steps_of(STAGES, 3) == sum(race.ran for race in races)
    names = {"usual_cost": 0.5, "other_cost": 0.2, "third_cost": 0.4, "body_margin": 0.5 / (0.2 * HANDICAP) - 1}
    assert best.figures == pytest.approx(names)


def test_the_usual_one_has_an_advantage() -> None:
    races, best = run(0.5, 0.5 / 1.2)
    assert best is races[0] and best.figures["body_margin"] == pytest.approx(HANDICAP / 1.2 - 1)
    between = 0.5 * (HANDICAP + ONE_SIDE_HANDICAP)
    for handicap, winner in ((HANDICAP, 1), (ONE_SIDE_HANDICAP, 0)):
        races, best = run(0.5, 0.5 / between, handicap=handicap)
        assert best is races[winner]


def test_where_one_side_is_seen_the_usual_one_has_a_greater_advantage(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[float] = []

    def told(races: list[Race], stages: Any) -> Race:
        found.append(races[0].handicap)
        return decided(races, stages)

    monkeypatch.setattr(fit, "decided", told)
    for cameras in ("sweep", "fixed"):
        fit_template(walking_clip(3, cameras), config=shortened(1), seed=0, log=silent)
    assert found == [HANDICAP, ONE_SIDE_HANDICAP]


def test_one_alone_runs_all_and_says_nothing() -> None:
    races, best = run(0.5)
    assert best is races[0] and best.ran == 1 + 2 + 4 and best.figures == {}


def test_a_walking_quadruped_is_one(one_thread: None) -> None:
    clip, total = walking_clip(6, "sweep"), []
    config = shortened(12, yaw_starts=4)
    prior = fit_template(clip, config=config, seed=0, log=lambda *told: total.append(told[:2]), bodies=KINDS)
    assert prior.provenance.startswith("Template (quadruped) fitted to masks of the clip's 6 frames")
    assert {"quadruped_cost", "biped_cost", "primate_cost", "body_margin"} <= prior.quality.keys()
    assert total[-1] == (len(total), len(total))
    alone = fit_template(clip, config=config, seed=0, log=silent)
    assert torch.equal(alone.transforms, prior.transforms)


def test_a_name_chooses_and_is_part_of_the_cache(one_thread: None) -> None:
    clip, truth = walking_clip(2, "sweep"), cast(Any, None)
    names = ("template", "template:biped", "template:primate", "template:quadruped")
    assert len({PriorChoice(name, STANDARD).identity(clip, truth) for name in names}) == len(names)
    assert [body.name for body in PriorChoice("template:biped", STANDARD).bodies()] == ["biped"]
    assert PriorChoice("template", STANDARD).bodies() == KINDS
    assert PriorChoice("template:biped", STANDARD).is_fitted
    with pytest.raises(UserError, match=r"unknown template 'bird'"):
        PriorChoice("template:bird", STANDARD).require()
    with pytest.raises(UserError, match=r"no/such\.glb"):
        PriorChoice("template:no/such.glb", STANDARD).require()


def test_the_chosen_template_is_fitted(one_thread: None) -> None:
    config = msgspec.structs.replace(shortened(2), stages=shortened(2).stages[:2])
    prior = fit_template(walking_clip(2, "sweep"), config=config, seed=0, log=silent, bodies=KINDS[1:2])
    assert prior.provenance.startswith("Template (biped)") and "body_margin" not in prior.quality


def test_torch_kernels_have_a_prior_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    clip, truth = walking_clip(2, "sweep"), cast(Any, None)
    made = set()
    for mode in ("auto", "torch"):
        monkeypatch.setenv(VARIABLE, mode)
        made.add(PriorChoice("template", STANDARD).identity(clip, truth))
    assert len(made) == 2


def kept(misfits: tuple[float, ...], facing: tuple[float, ...], *, keep: int, lost: float) -> list[float]:
    """Costs of the guesses that stay, of some that face one way (1) or the other (-1)."""
    race = object.__new__(Race)
    heads = torch.tensor([(0.0, 0.0, way) for way in facing])
    race.guesses = cast(Any, SimpleNamespace(heading=lambda: heads, select=lambda rows: rows))
    race.costs = race.misfits = torch.tensor(misfits)
    race.figures = {}
    race._cut(keep, lost)
    return race.costs.tolist()  # type: ignore[no-any-return]


def test_the_best_that_faces_the_other_way_stays_unless_it_has_lost() -> None:
    misfits, facing = (0.25, 0.125, 0.375, 0.5), (1.0, 1.0, -1.0, -1.0)
    assert kept(misfits, facing, keep=2, lost=4.0) == [0.125, 0.375]
    assert kept(misfits, facing, keep=2, lost=2.0) == [0.125], "nothing takes its place"
    assert kept(misfits, facing, keep=3, lost=3.0) == [0.125, 0.25, 0.375]
    assert kept(misfits, facing, keep=3, lost=2.0) == [0.125, 0.25]
    assert kept(misfits, facing, keep=2, lost=1.5) == [0.125]
