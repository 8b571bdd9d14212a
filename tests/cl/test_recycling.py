"""Memory that is used again: never while somebody may still see it."""

import gc
import threading
import weakref

import numpy as np
import pytest

from stss_cl.device.recycling import Recycler, recycler_of
from tests.cl.conftest import anew

FLOAT = np.dtype(np.float32)


@pytest.fixture
def recycler():
    made = []

    def make(size):
        made.append(size)
        return np.empty(size, np.uint8)

    recycler = Recycler(make, most=3)
    recycler.made = made
    return recycler


def test_memory_is_used_again_once_its_array_and_all_views_are_gone(recycler):
    first = recycler.array((4, 5), FLOAT)
    first[:] = 7
    view = first[1:, ::2]
    del first
    second = recycler.array((4, 5), FLOAT)
    second[:] = 8
    assert (view == 7).all()
    del view
    third = recycler.array((5, 4), FLOAT)
    assert recycler.made == [80, 80]
    assert (third.dtype, third.shape, third.flags.writeable, third.flags.c_contiguous) == (FLOAT, (5, 4), True, True)
    assert (second == 8).all()


def test_other_sizes_are_made_anew_and_few_are_kept(recycler):
    sizes = [2, 3, 4, 5]
    arrays = [recycler.array((n,), FLOAT) for n in sizes]
    while arrays:
        del arrays[0]
    again = [recycler.array((n,), FLOAT) for n in sizes]
    assert len(again) == 4
    assert sorted(recycler.made) == [8, 8, 12, 16, 20]  # the first that came back did not stay


def test_memory_goes_with_the_context(device):
    device = anew(device)
    block = recycler_of(device.context).take(64)
    gone = weakref.ref(block)
    recycler_of(device.context).give_back(block)
    del block
    block = recycler_of(device.context).take(64)
    assert block is gone()
    recycler_of(device.context).give_back(block)
    del block
    assert gone() is not None
    del device
    gc.collect()
    assert gone() is None


def test_threads_do_not_share_an_array(recycler):
    """Each writes its number, and finds it again."""
    wrong = []

    def work(number):
        for _ in range(500):
            array = recycler.array((64,), FLOAT)
            array[:] = number
            if (array != number).any():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert len(recycler.made) < 100
