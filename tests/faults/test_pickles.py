"""SMAL pickles that would fill the memory with a few bytes."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from rewild4d.baselines.gart_smal import _read
from rewild4d.errors import UserError

HUGE = (1 << 40,)


class Calls:
    """Pickles as the call of a function."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.call


RECONSTRUCT = np.zeros(0).__reduce__()[0]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\x80\x02}r\xff\xff\xff\x7f.", "it numbers more values than it can hold"),
        (pickle.dumps({"f": Calls(RECONSTRUCT, np.ndarray, HUGE, b"b")}), "it begins an array of shape"),
        (pickle.dumps({"f": Calls(np.ndarray, HUGE)}), "'NoneType' object is not callable"),
        (pickle.dumps({"f": Calls(sparse.csc_matrix, (1 << 40, 3))}), "it makes a sparse matrix of a size"),
        (pickle.dumps({"f": Calls(print, "run")}), "it holds a builtins.print, which is not let through"),
    ],
)
def test_a_pickle_that_asks_for_room_is_one_sentence(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "smal.pkl").write_bytes(content)
    with pytest.raises(UserError, match=f"expected a D-SMAL file .* but it cannot be read: {reason}"):
        _read(tmp_path / "smal.pkl")


def test_arrays_and_sparse_matrices_are_read(tmp_path: Path) -> None:
    regressor = sparse.csc_matrix(np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]))
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [0, 4, 0]])
    for protocol in (0, 2, 4):
        content = {"v_template": vertices, "J_regressor": regressor}
        (tmp_path / "smal.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
        assert _read(tmp_path / "smal.pkl")["joints"].tolist() == [[0.5 * 0 + 0.5 * 2, 0, 0], [0, 4, 0]]
