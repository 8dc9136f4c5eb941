"""Messages: short, on one line, with the path whole; and what JSON and TOML that cannot be read say."""

import os
from pathlib import Path

import pytest

from rewild4d.datasets.artemis import files
from rewild4d.errors import MOST_CHARACTERS, UserError, reason, shortened, shown, unknown_name
from rewild4d.evaluation.protocol import Protocol
from rewild4d.foreign.texts import parse_json, parse_toml, read_json, read_text, read_toml
from rewild4d.priors.landmarks import load_mapping


def test_a_long_message_keeps_its_path_and_loses_its_middle() -> None:
    path = "/data" * 40 + "/a.json"
    said = str(UserError(f"{path}: expected a number, got '{5000 * '9'}' in the end."))
    assert len(said) == MOST_CHARACTERS == 400
    assert said.startswith(f"{path}: expected a number, got '9") and said.endswith("9' in the end.")
    assert f"...({len('expected a number, got') + 5000 + len(' in the end.') + 3} characters)..." in said
    assert str(UserError("a.json: expected a number.")) == "a.json: expected a number."


def test_even_a_path_has_an_end() -> None:
    said = str(UserError(f"{'x' * 5000}: expected a number, got a word."))
    assert len(said) <= MOST_CHARACTERS
    said = str(UserError(f"{'x' * 390}: expected a number, got a word."))
    assert len(said) <= MOST_CHARACTERS and said.endswith("x: expected a number, got a word.")
    path = 350 * "x"
    said = str(UserError(f"{path}: expected a number, but {100 * 'y'}."))
    assert len(said) <= MOST_CHARACTERS and said.count("x") == 1 + 280 - len("...(350 characters)...")
    assert str(UserError(f"{path}: {60 * 'y'}")) != (said := str(UserError(f"{path}: {48 * 'y'}")))
    assert said == f"{path}: {48 * 'y'}" and len(said) == MOST_CHARACTERS


def test_control_characters_steer_no_terminal() -> None:
    assert str(UserError("a\x1b[31mb\0c\nd")) == r"a\x1b[31mb\x00c d"


def test_values_are_shown_short() -> None:
    assert shown(5 * "9") == "99999"
    assert shown(10**5000) == f"a number of {(10**5000).bit_length()} bits"
    assert len(shown(5000 * "9")) == 60 and len(shortened(5000 * "9", 40)) == 40


def test_what_an_error_says_holds_no_file() -> None:
    with pytest.raises(UnicodeDecodeError) as caught:
        (b"a" * 100000 + b"\xe9").decode()
    assert reason(caught.value) == "byte 0xe9 at position 100000 is no UTF-8 text"
    assert reason(FileNotFoundError(2, "No such file or directory", "/a/b")) == "No such file or directory"
    assert reason(KeyError("points")) == "it lacks 'points'"
    assert len(reason(ValueError(5000 * "9"))) == 200


def test_a_list_of_names_has_an_end() -> None:
    said = str(unknown_name("thing", 5000 * "q", [f"name-of-a-thing-{i:02d}" for i in range(30)]))
    assert len(said) <= MOST_CHARACTERS and "name-of-a-thing-00, " in said and "... (30 in all)." in said


FAULTS: list[tuple[bytes, str]] = [
    (b"\xff\xfe\x00", "is no UTF-16"),
    (b"\xe9", "byte 0xe9 at position 0 is no UTF-8 text"),
    (b"a", "it cannot be parsed"),
    (b"a = " + 5000 * b"9", "it cannot be parsed|it holds a number of more digits than can be read"),
    (b"a = " + 100000 * b"[", "it cannot be parsed"),
    (100000 * b"[", r"it cannot be parsed"),
]


@pytest.mark.parametrize(("data", "message"), FAULTS)
def test_files_that_are_no_toml_or_json(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(data)
    for read in (read_toml, read_json):
        with pytest.raises(UserError, match=f"a: expected a thing, but .*({message})") as error:
            read(path, "a thing")
        assert len(str(error.value)) <= MOST_CHARACTERS
    with pytest.raises(UserError, match="expected a protocol, but"):
        read_toml(path, "a protocol", Protocol)


def test_numbers_of_too_many_digits_and_deep_nesting_are_told() -> None:
    digits, deep = 5000 * "9", 100000 * "["
    for parse, number, nested in ((parse_toml, f"a = {digits}", f"a = {deep}"), (parse_json, digits, deep)):
        with pytest.raises(UserError, match="but it holds a number of more digits than can be read"):
            parse(number, "a", "a thing")
        with pytest.raises(UserError, match=r"a: expected a thing, but it cannot be parsed \(nested too deeply\)"):
            parse(nested, "a", "a thing")


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a: expected a thing, but there is no such file"):
        read_json(tmp_path / "a", "a thing")
    with pytest.raises(UserError, match="expected a thing, but: Is a directory"):
        read_text(tmp_path, "a thing")
    with pytest.raises(UserError, match="expected a thing, but there is no such file"):
        read_text(tmp_path / (300 * "x"), "a thing")


def test_devices_and_texts_that_fill_the_memory_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="pipe: expected a thing, but: it is a device or a pipe"):
        read_text(tmp_path / "pipe", "a thing")
    monkeypatch.setenv("REWILD4D_LARGEST_GIB", "0.000001")
    (tmp_path / "long").write_text("x" * 2000)
    with pytest.raises(UserError, match="long: expected a thing of at most 9.99e-07 GiB once read"):
        read_text(tmp_path / "long", "a thing")


def test_marks_say_the_encoding(tmp_path: Path) -> None:
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-32"):
        (tmp_path / "a").write_bytes('{"ä": 1}'.encode(encoding))
        assert read_json(tmp_path / "a", "a thing") == {"ä": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [("points = 5", r"expected a table \[points\] of names in quotes, got 5"), ("", r"\[points\] .*, got None"),
     ("[points]\nnose = 5", r"\[points\] of names in quotes, got {'nose': 5}"),
     (f"[points]\nnose = '{5000 * 'x'}'", "unknown landmark in the mapping .*a.toml 'xxx"),
     ("a = " + 100000 * "[", "nested too deeply"), ("a = " + 5000 * "9", "more digits than can be read")],
)  # fmt: skip
def test_mappings_that_cannot_be_used(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(UserError, match=message) as error:
        load_mapping(str(tmp_path / "a.toml"))
    assert len(str(error.value)) <= MOST_CHARACTERS


@pytest.mark.parametrize("token", [5000 * "9", 5000 * "x", "1e300", "nan"])
def test_numbers_of_an_animal_are_echoed_short(token: str, tmp_path: Path) -> None:
    path = tmp_path / "CamPose.inf"
    path.write_text(f"{token} {11 * '0 '}\n")
    with pytest.raises(UserError, match=r"row 1 \(camera 0\): expected (finite )?numbers") as error:
        files.read_cameras(path)
    assert len(str(error.value)) <= MOST_CHARACTERS
    (tmp_path / "sequences").write_text(f"walk {token}\n")
    with pytest.raises(UserError, match="expected '<motion> <number of frames>' in line 1, got 'walk "):
        files.read_sequences(tmp_path / "sequences")


def test_a_frame_of_an_enormous_number_is_a_gap(tmp_path: Path) -> None:
    for name in ("0", "9" * 200):
        (tmp_path / name).mkdir()
    with pytest.raises(UserError, match="expected frame folders 0 to 999.* without a gap, but folder 1 is missing"):
        files.list_frames(tmp_path)
