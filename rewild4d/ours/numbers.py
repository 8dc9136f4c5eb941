"""Ranges of settings."""

from typing import Annotated

from msgspec import Meta

Count = Annotated[int, Meta(ge=1)]
Whole = Annotated[int, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
Weight = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Opacity = Annotated[float, Meta(gt=0, lt=1)]
Degree = Annotated[int, Meta(ge=0, le=3)]
Size = Annotated[int, Meta(ge=16)]
Rate = tuple[Positive, Positive]
