"""One thread for torch's operators, in one Python thread at a time."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
import torch

from bidnerf_core.devices import set_threads_here, threads_at_most

pytestmark = pytest.mark.usefixtures("three_threads")


def in_new_thread() -> int:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


def test_the_usual_number_is_restored_after_an_error() -> None:
    with pytest.raises(KeyboardInterrupt), threads_at_most(1):
        raise KeyboardInterrupt
    assert torch.get_num_threads() == in_new_thread() == 3


def test_threads_that_start_meanwhile_have_the_usual_number() -> None:
    with threads_at_most(1):
        assert in_new_thread() == 3
    set_threads_here(2)
    assert (torch.get_num_threads(), in_new_thread()) == (2, 3)


def test_the_number_stays_in_a_thread_that_is_new_to_torch() -> None:
    def set_and_computed() -> int:
        set_threads_here(1)
        torch.ones(10).sum()
        return torch.get_num_threads()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(set_and_computed).result() == 1


def test_blocks_that_overlap_leave_no_trace() -> None:
    """The second block begins during the first and ends after it."""
    began, ended = Barrier(2), Barrier(2)

    def first() -> int:
        with threads_at_most(1):
            began.wait()
        ended.wait()
        return torch.get_num_threads()

    def second() -> tuple[int, int]:
        began.wait()
        with threads_at_most(1) as usual:
            ended.wait()
        return usual, torch.get_num_threads()

    with ThreadPoolExecutor(2) as pool:
        one, two = pool.submit(first), pool.submit(second)
        assert (one.result(), two.result()) == (3, (3, 3))
    assert torch.get_num_threads() == in_new_thread() == 3
