"""Rows of memory as columns of lanes: where a block is whole, where it ends early, and where the memory ends."""

import numpy as np
import pytest
from numba.core.errors import TypingError

from rewild4d.kernels.columns import read_columns, write_columns

WIDE = 32


@pytest.mark.parametrize("numbers", [1, 3, 4, 15, 16, 20, 48])
@pytest.mark.parametrize(("begin", "end"), [(0, 32), (5, 37), (0, 1), (20, 37), (32, 48)])
def test_columns_are_the_transposed_rows(numbers: int, begin: int, end: int) -> None:
    rows = np.arange(48 * numbers, dtype=np.float32).reshape(48, numbers) + 1
    columns = np.full(-(-numbers // 16) * 16 * WIDE, np.nan, np.float32)
    read_columns(rows, begin, end, columns, WIDE)
    made = columns.reshape(-1, WIDE)[:numbers]
    assert (made[:, : end - begin] == rows[begin:end].T).all()
    assert (made[:, end - begin :] == 0).all(), "lanes behind the rows"
    written = np.zeros_like(rows)
    write_columns(columns, WIDE, written, begin, end)
    assert (written[begin:end] == rows[begin:end]).all()
    written[begin:end] = 0
    assert (written == 0).all(), "no other row is touched"


def test_other_numbers_than_single_precision_are_an_error() -> None:
    with pytest.raises(TypingError):
        read_columns(np.zeros((4, 3)), 0, 4, np.zeros(16 * WIDE, np.float32), WIDE)
    with pytest.raises(TypingError):
        write_columns(np.zeros(16 * WIDE, np.float32), WIDE, np.zeros((4, 3)), 0, 4)
