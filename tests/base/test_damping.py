"""The damping of least-squares steps: ten times as much until a step helps, a tenth after it."""

import pytest

from sfm_shapefit.base.damping import DampingRange, take_damped_step


def test_damping_rises_until_a_step_helps_falls_after_it_and_starts_again_where_none_helps():
    tried = []

    def propose(damping):
        tried.append(damping)
        return "there" if damping > 5e-3 else None

    assert take_damped_step(propose, 1e-4, DampingRange()) == ("there", pytest.approx(1e-3))
    assert tried == pytest.approx([1e-4, 1e-3, 1e-2])
    assert take_damped_step(lambda _: "there", 2e-9, DampingRange())[1] == 1e-9  # never below the least
    tried.clear()
    assert take_damped_step(tried.append, 1.0, DampingRange(first=1e-3, most=1e3)) == (None, 1e-3)
    assert tried == [1.0, 10.0, 100.0, 1000.0]
    tried.clear()
    rising = DampingRange(first=1e-3, most=1e3, growth=2.0, acceleration=2.0)
    assert take_damped_step(tried.append, 1.0, rising) == (None, 1e-3)
    assert tried == [1.0, 2.0, 8.0, 64.0]
