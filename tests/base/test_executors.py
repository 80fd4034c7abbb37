"""Work is shared out in order, a few tasks ahead of the answers, and what is not needed is cancelled."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event, get_ident

import numpy as np
import pytest

from sfm_shapefit.base.executors import Crew, gathered, in_ranges, in_threads, overlapped


def square(number):
    return number * number


class Pool(ThreadPoolExecutor):
    """Threads in place of a cluster; arguments are no futures."""


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_answers_come_in_order_whoever_works(workers):
    with Pool(max(workers, 1)) as pool:
        crew = Crew(1, pool if workers else None)
        assert list(crew.stream(square, range(100))) == [k * k for k in range(100)]


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_threads_answer_in_order_and_a_single_one_is_the_callers(threads):
    seen = set()
    found = in_threads(threads, lambda task: (seen.add(get_ident()), square(task))[1], range(100))
    assert list(found) == [k * k for k in range(100)]
    assert (get_ident() in seen) == (threads <= 1)


@pytest.mark.parametrize("count", [0, 1, 5, 100])
@pytest.mark.parametrize("threads", [1, 3])
def test_ranges_fill_each_item_once(threads, count):
    filled = [0] * count

    def fill(begin, end, by):
        for k in range(begin, end):
            filled[k] += by

    in_ranges(threads, count, fill, 2)
    assert filled == [2] * count


@pytest.mark.parametrize("threads", [1, 2])
def test_answers_come_in_order_and_no_more_than_one_task_is_ahead(threads):
    made = []
    squares = overlapped(threads, square, (made.append(k) or k for k in range(20)))
    for k, found in enumerate(squares):
        assert found == k**2
        assert len(made) <= k + threads
    assert made == list(range(20))

    def failing():
        yield 1
        yield 2
        raise ValueError("damaged")

    answers = overlapped(threads, square, failing())
    assert next(answers) == 1
    with pytest.raises(ValueError, match="damaged"):
        list(answers)


def test_two_tasks_are_in_work_at_once_where_there_are_threads():
    both = Barrier(2)  # of which neither ends before the other has begun
    waits = overlapped(2, lambda _: both.wait(timeout=60), range(4))
    assert len(list(waits)) == 4


@pytest.mark.parametrize("threads", [1, 3])
def test_gathered_rows_are_those_of_the_array(threads):
    array, rows = np.arange(30, dtype=np.int32).reshape(10, 3), np.array([9, 0, 0, 4])
    found = gathered(threads, array, rows)
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array[rows])
    assert gathered(threads, array, rows[:0]).shape == (0, 3)


def test_tasks_are_made_only_a_few_ahead_of_the_answers():
    made = []
    with Pool(2) as pool:
        for square_of in Crew(1, pool).stream(square, (made.append(k) or k for k in range(100))):
            assert len(made) <= square_of**0.5 + 32
    assert made == list(range(100))


def test_what_is_not_asked_for_any_more_is_cancelled():
    begun, go_on = [], Event()

    def wait(task):
        begun.append(task)
        go_on.wait(10.0)
        return task

    with Pool(1) as pool:
        found = Crew(1, pool).stream(wait, range(20))
        go_on.set()
        assert next(found) == 0
        go_on.clear()
        found.close()
        go_on.set()
    assert len(begun) < 20
