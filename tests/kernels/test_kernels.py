"""The parts that CPU kernels are made of, against NumPy and torch."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from numba.core.errors import TypingError
from torch import nn

from rewild4d.kernels.columns import read_columns, write_columns
from rewild4d.kernels.compiling import kernel
from rewild4d.kernels.doubles import floor, load_columns, log2, root, spread, store_columns, where_gt
from rewild4d.kernels.halves import add_pair_product, available, pair_matrix, pair_rows, pair_vectors
from rewild4d.kernels.magnitudes import all_below
from rewild4d.kernels.matrix import add_product, matrix_tile, multiply_add, transpose_tile
from rewild4d.kernels.memory import keep_freed_memory
from rewild4d.kernels.rows import add_scaled, sum_rows
from rewild4d.kernels.threads import run, set_kernel_threads, spans, thread_count, torch_on_one
from rewild4d.ours.gradients import clip_gradients


def numbers(*shape: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize(
    ("rows", "depth", "columns"), [(8, 1, 16), (16, 7, 48), (64, 54, 80), (24, 48, 112), (8, 0, 32)]
)
@pytest.mark.parametrize("transposed", [False, True])
def test_products_are_added(rows: int, depth: int, columns: int, transposed: bool) -> None:
    a, b, before = numbers(rows, depth, seed=1), numbers(depth, columns, seed=2), numbers(rows, columns, seed=3)
    c = before.copy()
    # The same memory serves A and its transpose: only the distances differ.
    stored, strides = (np.ascontiguousarray(a.T), (1, rows)) if transposed else (a, (depth, 1))
    add_product(stored.ravel(), 0, *strides, b.ravel(), 0, columns, depth, c.ravel(), 0, columns, rows, columns)
    np.testing.assert_allclose(c, before + a.astype(np.float64) @ b, atol=1e-4)


_wide, _narrow = matrix_tile(8, 3, multiply_add), matrix_tile(4, 1, multiply_add)


@kernel
def _by_wide_tile(a: np.ndarray, b: np.ndarray, c: np.ndarray, depth: int) -> None:
    _wide(a, 0, depth, 1, b, 0, 48, depth, c, 0, 48)


@kernel
def _by_narrow_tiles(a: np.ndarray, b: np.ndarray, c: np.ndarray, depth: int) -> None:
    for row in range(0, 8, 4):
        for column in range(0, 48, 16):
            _narrow(a, row * depth, depth, 1, b, column, 48, depth, c, row * 48 + column, 48)


@pytest.mark.parametrize("depth", [0, 1, 37])
def test_tiles_for_avx512_and_for_avx2_give_the_same_bits(depth: int) -> None:
    a, b = numbers(8, depth, seed=1), numbers(depth, 48, seed=2)
    wide, narrow = numbers(2, 8, 48, seed=3)[:1].repeat(2, axis=0)
    _by_wide_tile(a.ravel(), b.ravel(), wide.ravel(), depth)
    _by_narrow_tiles(a.ravel(), b.ravel(), narrow.ravel(), depth)
    np.testing.assert_array_equal(wide, narrow)
    np.testing.assert_allclose(wide, numbers(2, 8, 48, seed=3)[0] + a.astype(np.float64) @ b, atol=1e-4)


@kernel
def _pair_product(a: np.ndarray, b: np.ndarray, c: np.ndarray, rows: int, depth: int, columns: int) -> None:
    left, right = np.empty(rows * depth // 2, np.int32), np.empty(depth * columns // 2, np.float32)
    pair_matrix(a.view(np.int32), 0, rows, depth, left, np.empty_like(left), 0)
    pair_rows(b, depth, columns, right)
    half = depth // 2
    add_pair_product(left.view(np.float32), 0, half, right, 0, columns, half, c, 0, columns, rows, columns)


@pytest.mark.skipif(not available(), reason="this CPU multiplies no bfloat16 pairs (AVX512_BF16)")
@pytest.mark.parametrize(("rows", "depth", "columns"), [(8, 2, 16), (16, 8, 48), (64, 54, 80), (24, 48, 112)])
def test_products_of_pairs_are_those_of_the_rounded_factors(rows: int, depth: int, columns: int) -> None:
    a, b, before = numbers(rows, depth, seed=1), numbers(depth, columns, seed=2), numbers(rows, columns, seed=3)
    c = before.copy()
    _pair_product(a.ravel(), b.ravel(), c.ravel(), rows, depth, columns)
    left, right = (torch.from_numpy(factor).bfloat16().double().numpy() for factor in (a, b))
    np.testing.assert_allclose(c, before + left @ right, atol=1e-4)


@kernel
def _pairs(given: np.ndarray, along: np.ndarray, across: np.ndarray, vectors: np.ndarray) -> None:
    pair_matrix(given.view(np.int32), 0, 16, 32, along, across, 0)
    pair_vectors(given, 16, 32, vectors)


def test_words_hold_neighbours_of_a_row_a_column_and_a_vector() -> None:
    given = numbers(16, 32, seed=1)
    along, across, vectors = np.empty(256, np.int32), np.empty(256, np.int32), np.empty(256, np.float32)
    _pairs(given.ravel(), along, across, vectors)
    rounded = torch.from_numpy(given).bfloat16()

    def words(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array.view(np.int16)).view(torch.bfloat16)

    assert torch.equal(words(along).view(16, 32), rounded)
    assert torch.equal(words(across).view(32, 16), rounded.T)
    assert torch.equal(words(vectors).view(16, 16, 2), rounded.view(16, 2, 16).transpose(1, 2))


@kernel
def _transposed(source: np.ndarray, target: np.ndarray) -> None:
    transpose_tile(source, 3, 20, target, 5, 17)


def test_a_tile_is_transposed_in_place_of_its_strides() -> None:
    source, target = numbers(400, seed=1), np.zeros(400, np.float32)
    _transposed(source, target)
    for row in range(16):
        for column in range(16):
            assert target[5 + 17 * column + row] == source[3 + 20 * row + column]


@kernel
def _summed(rows: np.ndarray, count: int, sums: np.ndarray) -> None:
    sum_rows(rows, count, sums, 0)


@pytest.mark.parametrize("count", [1, 9, 16, 21])
def test_each_row_is_summed(count: int) -> None:
    rows, sums = numbers(count, 16, seed=count), np.full(32, np.nan, np.float32)
    _summed(rows.ravel(), count, sums)
    np.testing.assert_allclose(sums[:count], rows.astype(np.float64).sum(1), atol=1e-5)


@kernel
def _added(share: float, source: np.ndarray, target: np.ndarray, count: int) -> None:
    add_scaled(share, source, 2, target, 1, count)


@pytest.mark.parametrize("count", [1, 16, 20, 37])
def test_a_scaled_row_is_added_and_nothing_beyond_it(count: int) -> None:
    source, before = numbers(50, seed=1), numbers(50, seed=2)
    target = before.copy()
    _added(np.float32(0.5), source, target, count)
    wanted = before.copy()
    wanted[1 : 1 + count] += np.float32(0.5) * source[2 : 2 + count]
    np.testing.assert_allclose(target, wanted, rtol=1e-6)


def test_the_kernels_keep_their_threads_while_torch_has_one() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with torch_on_one():
            assert torch.get_num_threads() == 1 and thread_count() == 3
            with torch_on_one():
                assert thread_count() == 3
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3 and thread_count() == 3
    finally:
        torch.set_num_threads(before)


def test_the_kernels_may_have_threads_of_their_own() -> None:
    """A run gives them cores that torch may not use: its last digits depend on how many it has."""
    torch_has = torch.get_num_threads()
    before = set_kernel_threads(torch_has + 2)
    try:
        assert (torch.get_num_threads(), thread_count()) == (torch_has, torch_has + 2)
        with torch_on_one():
            assert thread_count() == torch_has + 2
        assert set_kernel_threads(None) == torch_has + 2 and thread_count() == torch_has
    finally:
        set_kernel_threads(before)


def test_an_error_in_a_thread_reaches_the_caller() -> None:
    def work(index: int) -> None:
        if index == 1:
            raise ValueError("in the second")

    with pytest.raises(ValueError, match="in the second"):
        run(work, [(0,), (1,)])


def test_no_worker_outlives_the_interpreter() -> None:
    # Callbacks run in the reverse order of their registration: this one comes last.
    program = """
import atexit, threading
atexit.register(lambda: print(threading.active_count()))
from rewild4d.kernels.threads import run
done = []
run(done.append, [("a",), ("b",)])
print(*sorted(done))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["a", "b", "1"]


def test_spans_cover_everything_once() -> None:
    assert spans(10, 4) == [(0, 2), (2, 5), (5, 7), (7, 10)]
    assert spans(2, 5) == [(0, 1), (1, 2)] and spans(0, 3) == []


def test_the_memory_hint_never_raises() -> None:
    assert keep_freed_memory() in (True, False)


@pytest.mark.parametrize("limit", [0.1, 100.0])
def test_gradients_are_clipped_as_torch_does(limit: float) -> None:
    found = []
    for clip in (clip_gradients, nn.utils.clip_grad_norm_):
        layers = nn.Sequential(nn.Linear(5, 7), nn.Linear(7, 2))
        generator = torch.Generator().manual_seed(0)
        for parameter in layers.parameters():
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        norm = clip(list(layers.parameters()), limit)
        found.append([torch.as_tensor(norm), *(parameter.grad for parameter in layers.parameters())])
    for own, wanted in zip(*found, strict=True):
        torch.testing.assert_close(own, wanted)
    assert clip_gradients([nn.Parameter(torch.zeros(2))], limit) == 0


@kernel
def _through_columns(given: np.ndarray, made: np.ndarray) -> None:
    a, b, c = load_columns(given, 3, 3)
    store_columns(made, 3, (c, a, b))


def test_rows_become_columns_and_rows_again() -> None:
    given, made = np.arange(30, dtype=np.float32), np.zeros(30, np.float32)
    _through_columns(given, made)
    assert (made[3:27].reshape(8, 3) == given[3:27].reshape(8, 3)[:, [2, 0, 1]]).all()
    assert not made[:3].any() and not made[27:].any()


@kernel
def _arithmetic(x: np.ndarray, made: np.ndarray) -> None:
    (a,) = load_columns(x, 0, 1)
    (b,) = load_columns(x, 8, 1)
    store_columns(made, 0, (log2(a), (1 - a * b) / (b + 2), root(a), floor(a - b), where_gt(a, b, a, spread(-1.0))))


def test_vectors_of_doubles_compute_as_numpy_does() -> None:
    x, made = np.random.default_rng(0).lognormal(0, 4, 16), np.zeros(40)
    _arithmetic(x, made)
    a, b = x[:8], x[8:]
    expected = np.log2(a), (1 - a * b) / (b + 2), np.sqrt(a), np.floor(a - b), np.where(a > b, a, -1)
    np.testing.assert_allclose(made.reshape(8, 5).T, expected, rtol=1e-10, atol=1e-10)


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


@pytest.mark.parametrize("count", [1, 63, 64, 65, 130])
@pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf, 8.0, -8.0])
def test_one_odd_number_is_seen_wherever_it_stands(count: int, odd: float) -> None:
    before, after = torch.ones(3), -torch.ones(70)
    for place in range(count):
        values = torch.linspace(-7.9, 7.9, count)
        assert all_below((before, values, after), 8.0)
        values[place] = odd
        assert not all_below((before, values, after), 8.0), place


def test_tensors_of_any_layout_and_none_at_all() -> None:
    wide = torch.zeros(4, 6)
    wide[:, 3:] = math.nan
    assert all_below((wide[:, :3], wide.T[:3]), 1.0)
    assert not all_below((wide[:, 1:4],), 1.0)
    assert all_below((), 1.0)
    assert all_below((torch.zeros(0, 3), torch.zeros(1).expand(5, 2)), 1.0)
