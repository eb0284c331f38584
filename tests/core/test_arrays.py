"""Work that is shared out over the cores."""

import threading

import numpy as np
import pytest

from warpir.core.arrays import BAND, in_bands, on_cores


def test_results_keep_the_order_of_the_items() -> None:
    assert on_cores(lambda item: item**2, range(100)) == [item**2 for item in range(100)]
    assert on_cores(str, iter(())) == []


@pytest.mark.parametrize("count", [1, 2])
def test_one_item_is_left_to_the_callers_thread(count: int) -> None:
    threads = on_cores(lambda _: threading.get_ident(), range(count))
    assert (threading.get_ident() in threads) == (count == 1)


def test_an_error_in_one_item_reaches_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        on_cores(lambda item: 1 // item, [0])
    with pytest.raises(ZeroDivisionError):
        on_cores(lambda item: 1 // item, [1, 0])


@pytest.mark.parametrize("height, width", [(1, 1), (7, BAND), (3 * BAND // 8 + 1, 8), (5, 0)])
def test_bands_cover_every_row_once(height: int, width: int) -> None:
    calls = np.zeros(height, np.int32)

    def add(rows: slice) -> None:
        calls[rows] += 1

    in_bands(add, height, width)
    assert (calls == 1).all()
