"""Which frames of a video are shown to a method, and which are held out."""

Split = int | tuple[int, int]
"""As `contracts.Selection.split`."""


def split_frames(count: int, split: Split) -> list[bool]:
    """Return which usable frames are held out: the middle one of every ``split``, never the first or the last.

    Of two numbers the second says how many are held out after each so many shown ones, ends or not.
    """
    if isinstance(split, tuple):
        return [is_held_out(i, split) for i in range(count)]
    return [i % split == split // 2 and 0 < i < count - 1 for i in range(count)]


def is_held_out(place: int, split: tuple[int, int]) -> bool:
    """Return whether a frame is held out where so many frames are shown, so many after them held out, and again.

    Args:
        place: number of the frame, from 0.
        split: its first number is at least 1.
    """
    return place % sum(split) >= split[0]


def scores_shown(split: Split | None) -> bool:
    """Return whether the frames that a method sees are scored, and no others."""
    return isinstance(split, tuple) and split[1] == 0
