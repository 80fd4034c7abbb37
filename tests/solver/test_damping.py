"""The damping of least-squares steps: ten times as much until a step helps, a tenth after it."""

import pytest

from sfm_shapefit.solver.damping import DampingRange, take_damped_step


def test_damping_rises_until_a_step_helps_and_falls_after_it():
    tried = []

    def propose(damping):
        tried.append(damping)
        return "there" if damping > 5e-3 else None

    found, damping = take_damped_step(propose, 1e-4, DampingRange())
    assert (found, damping) == ("there", pytest.approx(1e-3))
    assert tried == pytest.approx([1e-4, 1e-3, 1e-2])


def test_damping_never_falls_below_its_least():
    assert take_damped_step(lambda _: "there", 2e-9, DampingRange())[1] == 1e-9


def test_where_no_damping_helps_there_is_no_step_and_the_first_damping_again():
    tried = []
    found, damping = take_damped_step(tried.append, 1.0, DampingRange(first=1e-3, most=1e3))
    assert (found, damping) == (None, 1e-3)
    assert tried == [1.0, 10.0, 100.0, 1000.0]
