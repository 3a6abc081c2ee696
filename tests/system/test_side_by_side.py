"""Parts of a computation on all cores."""

import ctypes
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from splinecli.system.machine import one_thread_each, side_by_side


@pytest.fixture(params=[1, 3], autouse=True)
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_come_in_order_and_parts_run_at_the_same_time(threads):
    together = threading.Barrier(threads, timeout=60)

    def square(number):
        together.wait()
        time.sleep(0.01 * (number % 3))
        assert torch.get_num_threads() == 1 and torch.is_inference_mode_enabled()
        return number**2

    assert list(side_by_side(square, range(12))) == [number**2 for number in range(12)]
    assert torch.get_num_threads() == threads


def test_few_results_wait(threads):
    begun = []
    for done, _ in enumerate(side_by_side(begun.append, range(100)), 1):
        assert len(begun) <= done + threads


def test_an_error_comes_in_its_turn_and_ends_the_rest(threads):
    def refuse(number):
        if number == 5:
            raise ValueError(f"part {number}")
        return number

    results = side_by_side(refuse, range(1000))
    assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="part 5"):
        next(results)
    assert torch.get_num_threads() == threads


def test_a_new_thread_begins_with_one_thread_of_its_own(threads):
    """OpenMP's number, which PyTorch sets in a thread only before its first operation there."""
    openmp = ctypes.CDLL(None)
    if not hasattr(openmp, "omp_get_max_threads"):
        pytest.skip("PyTorch does not use a shared OpenMP here")
    assert (
        list(side_by_side(lambda _: openmp.omp_get_max_threads(), range(threads))) == [1] * threads
    )


def test_callers_in_several_threads_restore_the_number_in_each(threads):
    """The first one ends while the second one is within."""
    first_in, second_in, first_out = (threading.Event() for _ in range(3))

    def call(begins, began, ends):
        assert begins is None or begins.wait(60)
        with one_thread_each() as before:
            within = torch.get_num_threads()
            began.set()
            assert ends.wait(60)
        return before, within, torch.get_num_threads()

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(call, None, first_in, second_in)
        second = pool.submit(call, first_in, second_in, first_out)
        assert first.result() == (threads, 1, threads)
        first_out.set()
        assert second.result() == (threads, 1, threads)
        assert pool.submit(torch.get_num_threads).result() == threads
