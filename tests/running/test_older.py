"""Records from before a preset was mended: they stand for their row, with a note, until there are later ones."""

from typing import Any

import msgspec
from records_for_tests import PROTOCOL, psnr, record, spec

from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.specs import Line
from rewild4d.leaderboard.tables import Entrant
from rewild4d.priors.config import FOOTAGE, QUICK, STANDARD, without_colors
from rewild4d.running import planning
from rewild4d.running.older import LOSSES, MIRRORS, PRIOR


def test_runs_from_before_the_losses_were_mended_stand_for_their_row_until_there_are_later_ones() -> None:
    found = spec(
        [Line(label="Ours", method="ours"), Line(label="bare", method="ours", settings={"pose": {"anchors": False}})]
    )
    now = msgspec.to_builtins(planning.row_entry("t", found.rows[0], found, ()).config)
    then = now | {
        "deform": now["deform"] | {"anchors": True}, "geometry": now["geometry"] | {"compact_power": 2.0},
        "pose": {name: value for name, value in now["pose"].items() if name != "anchors"},
    }  # fmt: skip
    without = then | {"deform": then["deform"] | {"anchors": False}}
    protocol = PROTOCOL | {"name": "artemis-sweep-128", "scores": ["psnr"]}

    def run(config: dict[str, Any], value: float) -> RunRecord:
        prior = {"choice": "template", "config": msgspec.to_builtins(QUICK)}
        return record(
            config=config, preset="quick", protocol=protocol, prior=prior, scores=psnr(value), run_id=str(value)
        )

    (ours, other), _ = planning.entrants("t", found, [run(then, 1.0), run(without, 2.0)])
    assert [r.run_id for r in ours.records[0]] == ["1.0"] and LOSSES in ours.notes
    assert other.records == ((),), "the older ablation kept anchors in the pose network"
    (ours, _), _ = planning.entrants("t", found, [run(then, 1.0), run(now, 3.0)])
    assert [r.run_id for r in ours.records[0]] == ["3.0"] and not ours.notes


def test_runs_of_gart_from_before_it_had_mirror_images_stand_for_its_row_with_a_note() -> None:
    found = spec([Line(label="GART", method="gart")])
    now = msgspec.to_builtins(planning.row_entry("t", found.rows[0], found, ()).config)
    assert now["mirrored"] == 0.125
    then = {name: value for name, value in now.items() if name != "mirrored"}
    protocol = PROTOCOL | {"name": "artemis-sweep-128", "scores": ["psnr"]}
    prior = {"choice": "template", "config": msgspec.to_builtins(QUICK)}

    def row(*configs: dict[str, Any]) -> Entrant:
        runs = [
            record(
                method="gart", config=config, preset="quick", protocol=protocol, prior=prior, scores=psnr(float(index)),
                run_id=str(index),
            )
            for index, config in enumerate(configs)
        ]  # fmt: skip
        return planning.entrants("t", found, runs)[0][0]

    old, new, none = row(then), row(then, now), row(now | {"mirrored": 0.0})
    assert [r.run_id for r in old.records[0]] == ["0"] and MIRRORS in old.notes
    assert [r.run_id for r in new.records[0]] == ["1"] and not new.notes
    assert none.records == ((),), "a run that was asked to have none is another row"


def test_runs_from_priors_of_masks_alone_stand_for_their_row_with_a_note_until_there_are_later_ones() -> None:
    found = spec([Line(label="Ours", method="ours")], preset="standard")
    config = msgspec.to_builtins(planning.row_entry("t", found.rows[0], found, ()).config)
    now, masks = (msgspec.to_builtins(prior) for prior in (STANDARD, without_colors(STANDARD)))
    then = masks | {"stages": [{k: v for k, v in stage.items() if k != "colors"} for stage in masks["stages"]]}

    def row(*efforts: dict[str, Any], cameras: str = "sweep") -> Entrant:
        protocol = PROTOCOL | {"name": "artemis-sweep-128", "scores": ["psnr"], "selection": {"cameras": cameras}}
        runs = [
            record(
                config=config, preset="standard", protocol=protocol, prior={"choice": "template", "config": effort},
                scores=psnr(float(index)), run_id=str(index),
            )
            for index, effort in enumerate(efforts)
        ]  # fmt: skip
        return planning.entrants("t", found, runs)[0][0]

    shapeless = {name: value for name, value in then.items() if name != "density_weight"}
    before = {name: value for name, value in shapeless.items() if name != "heading_weight"}
    bent = {name: value for name, value in then.items() if name != "straight_weight"}
    assert row(bent, cameras="fixed").notes == (PRIOR.format(parts="a straight spine"),)
    stiff = {name: value for name, value in msgspec.to_builtins(STANDARD).items() if name != "least_turn"}
    assert row(stiff).notes == row(stiff, cameras="fixed").notes == (PRIOR.format(parts="turns that a network reads"),)
    old, new, none = row(then), row(then, now), row(masks)
    fixed, unread = row(then, cameras="fixed"), row(before, cameras="fixed")
    assert [r.run_id for r in old.records[0]] == ["0"] and old.notes == (PRIOR.format(parts="colours"),)
    assert row(shapeless, cameras="fixed").notes == (PRIOR.format(parts="shapes of random animals"),)
    assert [r.run_id for r in new.records[0]] == ["1"] and not new.notes
    assert none.records == ((),), "a run that was asked to have masks alone is another row"
    assert [r.run_id for r in fixed.records[0]] == ["0"] and not fixed.notes, "one camera: no colours today either"
    assert [r.run_id for r in unread.records[0]] == ["0"]
    assert unread.notes == (PRIOR.format(parts="headings and shapes of random animals"),)
    assert row(before, then, cameras="fixed").records[0][0].run_id == "1"
    films = [msgspec.to_builtins(FOOTAGE)]
    films.insert(0, {name: value for name, value in films[0].items() if name != "heading_weight"})
    assert row(films[0], cameras="unknown").notes == (PRIOR.format(parts="headings"),)
    stiff = {name: value for name, value in films[1].items() if name != "turned_weight"}
    assert row(stiff, cameras="unknown").notes == (PRIOR.format(parts="turns that a network reads"),)
    assert not row(*films, cameras="unknown").notes
