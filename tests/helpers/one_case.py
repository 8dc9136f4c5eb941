"""A data set of one case."""

from typing import Any

from rewild4d.contracts import Selection
from rewild4d.types import Case, Clip, Truth


class OneCase:
    """A reader of the tiny case."""

    licence = "CC0 1.0"

    def __init__(self, case: Case) -> None:
        self.case = case

    def cases(self, selection: Selection) -> list[str]:
        return [self.case.clip.name]

    def load(self, case: str, selection: Selection) -> tuple[Clip, Truth]:
        return self.case.clip, self.case.truth

    def check(self) -> list[Any]:
        return []
