"""The one exception for bad input: one clear sentence, exit code 2, no traceback."""

from collections.abc import Iterable
from typing import Any

MOST_LISTED = 30
"""More names than these are not listed where a close one can be suggested."""
MOST_CHARACTERS = 400
"""Of a whole message; what is longer loses its middle."""
MOST_SHOWN = 60
"""Characters of one value in a message."""
_MOST_PATH = 280
"""Characters that the start of a message, its path, keeps whole however long the sentence is."""
_MOST_NAMES = 200
"""Characters of a list of names."""


class UserError(Exception):
    """What a person gave cannot be used. The message names the path, what was expected and what came.

    Args:
        message: the sentence; what is longer than `MOST_CHARACTERS` is shortened, and control characters are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__(bounded(message))


def bounded(message: str) -> str:
    """Return a message of at most `MOST_CHARACTERS`, with the path at its start whole where that leaves room."""
    message = _printable(message)
    if len(message) <= MOST_CHARACTERS:
        return message
    path, colon, sentence = message.partition(": ")
    if not colon or len(path) > MOST_CHARACTERS:
        return shortened(message, MOST_CHARACTERS)
    path = shortened(path, max(_MOST_PATH, MOST_CHARACTERS - len(colon) - len(sentence)))
    return path + colon + shortened(sentence, MOST_CHARACTERS - len(path) - len(colon))


def shortened(text: str, most: int = MOST_SHOWN) -> str:
    """Return a text of at most ``most`` characters (40 or more): a long one loses its middle and says its length.

    Examples:
        >>> shortened("9" * 5000, 40)
        '999999999...(5000 characters)...99999999'
    """
    if len(text) <= most:
        return text
    mark = f"...({len(text)} characters)..."
    kept = most - len(mark)
    return text[: kept - kept // 2] + mark + text[len(text) - kept // 2 :]


def shown(value: Any, most: int = MOST_SHOWN) -> str:
    """Return a value as a message names it: on one line, at most ``most`` characters."""
    try:
        text = str(value)
    except ValueError:  # Python refuses to write integers of more than 4300 digits
        text = f"a number of {value.bit_length()} bits"
    return shortened(_printable(text), most)


def reason(error: BaseException) -> str:
    """Return what an error says, as the end of a sentence: without a full stop, on one line, short.

    The system's words where it is one of files ("No such file or directory"), and never the bytes of a file.
    """
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.object[error.start]:#04x} at position {error.start} is no {error.encoding.upper()} text"
    if isinstance(error, RecursionError):
        return "it cannot be parsed (nested too deeply)"
    if isinstance(error, ValueError) and "integer string conversion" in str(error):
        return "it holds a number of more digits than can be read"
    if isinstance(error, KeyError):
        return f"it lacks {shown(error)}"
    said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return shortened(_printable(said), 200).rstrip(".") or type(error).__name__


def _printable(text: str) -> str:
    """Return a text on one line, in which characters that would steer a terminal are escaped."""
    if text.isprintable():
        return text
    text = text.replace("\n", " ").replace("\t", " ").replace("\r", " ")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


class DiskFull(UserError):
    """Nothing more can be written: the disk or a quota is full, or a file may not grow. It is no fault of a run."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """Make the error for a name that is not in ``known``, with a suggestion where one is close.

    Args:
        kind: what the name stands for, as it reads in a sentence ("method", "dataset").
        name: what the user gave.
        known: every valid name.
    """
    import difflib  # only who misspells a name waits for it

    names = sorted(set(known))
    close = difflib.get_close_matches(name[:200], names, n=1, cutoff=0.5)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    listed = f" Available: {_listed(names)}." if len(names) <= MOST_LISTED or not close else ""
    return UserError(f"unknown {kind} '{shown(name)}'.{hint}{listed}")


def _listed(names: list[str]) -> str:
    """Return names as a list that a message has room for."""
    listed = ", ".join(names)
    if len(listed) <= _MOST_NAMES:
        return listed or "none"
    fit = listed[:_MOST_NAMES].rpartition(", ")[0] or shortened(names[0], _MOST_NAMES)
    return f"{fit}, ... ({len(names)} in all)"
