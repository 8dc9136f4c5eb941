"""The one exception for bad input: one clear sentence, exit code 2, no traceback."""

from collections.abc import Iterable

MOST_LISTED = 30
"""More names than these are not listed where a close one can be suggested."""


class UserError(Exception):
    """What a person gave cannot be used. The message names the path, what was expected and what came."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UserError:
    """Make the error for a name that is not in ``known``, with a suggestion where one is close.

    Args:
        kind: what the name stands for, as it reads in a sentence ("method", "dataset").
        name: what the user gave.
        known: every valid name.
    """
    import difflib  # only who misspells a name waits for it

    names = sorted(set(known))
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    listed = f" Available: {', '.join(names) or 'none'}." if len(names) <= MOST_LISTED or not close else ""
    return UserError(f"unknown {kind} '{name}'.{hint}{listed}")
