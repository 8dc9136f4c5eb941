"""Paths and user names out of a record, so that it can be handed on."""

import re
from typing import Any

import msgspec

from rewild4d.leaderboard.records import RunRecord

_START = r"(?<![\w.:/\\~<])"
_PATH = re.compile(rf"{_START}(?:~[\w.-]*(?=/)|/(?=[\w.~])|[A-Za-z]:[\\/])[^\s\"'`,;()\[\]{{}}<>|:]*")
"""An absolute path inside of a text: POSIX, ~user/..., or with a drive. It ends at a space or at punctuation."""
_HOMES = re.compile(r"(?:[A-Za-z]:)?[\\/](?:home|Users)[\\/][^\\/]+|~[\w.-]*|/root")


def without_paths(record: RunRecord) -> RunRecord:
    """The record with every absolute path cut to its last part; home folders, which are user names, to "~"."""
    return msgspec.convert(_cleaned(msgspec.to_builtins(record)), RunRecord)


def last_part(path: str) -> str:
    """The name of a file or folder without where it lies."""
    bare = path.rstrip("\\/.")
    return "~" if _HOMES.fullmatch(bare) else re.split(r"[\\/]", bare)[-1] + path[len(path.rstrip(".")) :]


def _cleaned(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {_cleaned(name): _cleaned(value) for name, value in tree.items()}
    if isinstance(tree, list):
        return [_cleaned(value) for value in tree]
    if not isinstance(tree, str):
        return tree
    if re.match(r"(?:~[\w.-]*)?/|[A-Za-z]:[\\/]", tree) and not re.search(r"[:;,\n\"']\s|\s[-/~{]", tree[2:]):
        return last_part(tree)  # a text that is one path may have spaces in it
    return _PATH.sub(lambda found: last_part(found[0]), tree)
