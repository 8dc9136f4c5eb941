"""What `table --protocol` takes: names, families, names that only records have; what it refuses."""

from pathlib import Path

import pytest
from calling import output
from records_for_tests import PROTOCOL, record

from rewild4d import cli
from rewild4d.errors import UserError
from rewild4d.leaderboard.records import write_record
from rewild4d.running import planning


def test_a_protocol_is_known_by_its_name_its_family_or_its_records() -> None:
    assert planning.known_protocol("artemis-sweep-256-v1") == "artemis-sweep-256-v1"
    assert planning.known_protocol("artemis-sweep-256") == planning.newest_protocol("artemis-sweep-256")
    assert planning.known_protocol("somebodys-v1", ["somebodys-v1"]) == "somebodys-v1"
    with pytest.raises(UserError, match="unknown protocol 'artemis-swep-256'. Did you mean 'artemis-sweep-256-v"):
        planning.known_protocol("artemis-swep-256")
    with pytest.raises(UserError, match="unknown protocol 'somebody-v1'. Did you mean 'somebodys-v1'"):
        planning.known_protocol("somebody-v1", ["somebodys-v1"])


def test_everything_of_one_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a table's name too a family stands for its newest version, and a name that nobody knows is refused."""
    newest = planning.newest_protocol("artemis-sweep-256")
    for index, name in enumerate((newest, "artemis-sweep-256-v1", "somebodys-v1")):
        made = record(run_id=str(index), protocol={**PROTOCOL, "name": name, "title": f"T{index}"})
        write_record(made, tmp_path / str(index))
    words = ("table", "--runs", str(tmp_path), "--protocol")
    for index, name in enumerate(("artemis-sweep-256", "artemis-sweep-256-v1", "somebodys-v1")):
        shown = output(capsys, *words, name)
        assert [number for number in range(3) if f"**T{number}**" in shown] == [index]
    (tmp_path / "empty").mkdir()
    nothing = output(capsys, "table", "--runs", str(tmp_path / "empty"), "--protocol", "davis-512")
    assert nothing == "no records\n", "known, but nothing is in this folder"
    there = f"artemis-sweep-256-v1, {newest}, somebodys-v1"
    for name, told in (
        ("davis-512", f"expected records of protocol {planning.newest_protocol('davis-512')}, got those of {there}."),
        ("artemis-swep-256", "unknown protocol 'artemis-swep-256'. Did you mean 'artemis-sweep-256-v"),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main([*words, name])
        assert stop.value.code == 2 and told in capsys.readouterr().err
