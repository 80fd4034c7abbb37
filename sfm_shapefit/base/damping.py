"""The damping of Levenberg and Marquardt: how far a least-squares step is held back, in one place.

A step is tried with the damping that the last one left, and with ten times as much until it helps; one that
helps leaves a tenth of its own (Marquardt). Where it is known by how much a step should help, the damping
rises 2, 8, 64 times, and who proposes steps says what is left of it (Nielsen).

Sources: Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11 (1963);
Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, DTU (1999).
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

Point = TypeVar("Point")


class DampingRange(NamedTuple):
    """What the damping may be, relative to what it multiplies."""

    first: float = 1e-4
    least: float = 1e-9
    most: float = 1e2
    growth: float = 10.0
    """Factor of the damping after a step that does not help."""
    acceleration: float = 1.0
    """Factor of the growth each time."""


def take_damped_step(
    propose: Callable[[float], Point | None], damping: float, limits: DampingRange
) -> tuple[Point | None, float]:
    """Return the first proposal that helps, or None, and the damping for the next step.

    `propose` returns the point that a step of this damping leads to; None if its equations are singular, or
    the cost there is not low enough.
    """
    growth = limits.growth
    while damping <= limits.most:
        proposed = propose(damping)
        if proposed is not None:
            return proposed, max(damping / 10.0, limits.least)
        damping *= growth
        growth *= limits.acceleration
    return None, limits.first
