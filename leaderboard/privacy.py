"""Paths and user names out of a record, so that it can be handed on."""

import re
from collections.abc import Iterator
from typing import Any

import msgspec

from rewild4d.leaderboard.records import RunRecord

_URL = r"(?P<url>https?://[^\s\"'`<>]*)"
_FLAG = r"(?:(?<!\S)(?P<flag>-[A-Za-z]+)(?=/[\w.~-]+/))"
"""Before a path that is glued to it, as in -I/usr/include."""
_START = r"(?:(?:file:)?/+(?=[\w.~])|~[\w.-]*(?=/)|[A-Za-z]:[\\/]|\\{2,}(?=\w))"
_PATH = re.compile(rf"{_URL}|(?:{_FLAG}|(?<![\w./\\~<])){_START}[^\s\"'`,;()\[\]{{}}<>|:]*")
"""An absolute path inside of a text: POSIX, ~user/..., file:///..., with a drive, or of a server. It ends at a space or
at punctuation, so that each folder of a list with colons is one; addresses of the web are no paths."""
_HOMES = re.compile(r"(?:[A-Za-z]:|[\\/]{2}[^\\/]+|/*)[\\/](?:home|Users)[\\/][^\\/]+|~[\w.-]*|/+root")


def without_paths(record: RunRecord) -> RunRecord:
    """Cut every absolute path in a record to its last part; home folders, which are user names, to "~"."""
    return msgspec.convert(_cleaned(msgspec.to_builtins(record)), RunRecord)


def texts_with_paths(tree: Any) -> Iterator[str]:
    """Find every text in nested containers, however deep, that names an absolute path; keys too."""
    waiting = [tree]
    while waiting:
        item = waiting.pop()
        if isinstance(item, dict):
            waiting += [*item.keys(), *item.values()]
        elif isinstance(item, list | tuple | set | frozenset):
            waiting += item
        elif isinstance(item, str) and _cleaned(item) != item:
            yield item


def last_part(path: str) -> str:
    """Return the name of a file or folder without where it lies."""
    bare = path.removeprefix("file:").rstrip("\\/.")
    return "~" if _HOMES.fullmatch(bare) else re.split(r"[\\/]", bare)[-1] + path[len(path.rstrip(".")) :]


def _cleaned(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {_cleaned(name): _cleaned(value) for name, value in tree.items()}
    if isinstance(tree, list):
        return [_cleaned(value) for value in tree]
    if not isinstance(tree, str):
        return tree
    if re.match(_START, tree) and not re.search(r"[:;,\n\"']\s|\s[-/~{]", tree[2:]):
        return last_part(tree)  # a text that is one path may have spaces in it
    return _PATH.sub(_shortened, tree)


def _shortened(found: re.Match[str]) -> str:
    """Cut a path inside of a text."""
    if found["url"]:
        return found[0]
    flag = found["flag"] or ""
    return flag + last_part(found[0].removeprefix(flag))
