"""What a benchmark measures: a value with its unit, which direction is better, and what it has to reach.

A limit is met by the value as measured, not as printed; a value that is not finite never meets one.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Better = Literal["lower", "higher", "neither"]


@dataclass(frozen=True, slots=True)
class Quantity:
    """A column of a table: what is measured, and how two runs of it are to be compared."""

    name: str
    unit: str
    better: Better
    rel_tol: float
    """Relative change between two runs on one machine that means nothing."""
    meaning: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One measured value against the limit that it must reach."""

    name: str
    value: float
    limit: float
    better: Better = "lower"

    def __post_init__(self) -> None:
        if self.better == "neither":
            raise ValueError(f"the check of {self.name} needs a direction: lower or higher")

    @property
    def met(self) -> bool:
        """Whether the unrounded value reaches the limit; equality does."""
        if not math.isfinite(self.value):
            return False
        return self.value <= self.limit if self.better == "lower" else self.value >= self.limit

    def __str__(self) -> str:
        sign = ">" if self.better == "lower" else "<"
        return "met" if self.met else f"{self.name} {number(self.value)} {sign} {number(self.limit)}"


def check_all(values: Mapping[str, float], limits: Mapping[str, float]) -> list[Check]:
    """Return the check of each value that has an upper limit of the same name."""
    return [Check(name=name, value=values[name], limit=limit) for name, limit in limits.items()]


def verdict(checks: Sequence[Check]) -> str:
    """Return "met", "no target" where there is nothing to reach, or "missed: ..." with every failed check."""
    if not checks:
        return "no target"
    missed = [str(check) for check in checks if not check.met]
    return f"**missed**: {', '.join(missed)}" if missed else "met"


def ratio(value: float, reference: float) -> float:
    """Return value / reference; NaN if either is not finite or the reference is not positive."""
    if not (math.isfinite(value) and math.isfinite(reference) and reference > 0.0):
        return math.nan
    return value / reference


def times(value: float) -> str:
    """Return a ratio as text, such as "3.4x"; "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.2g}x" if value < 10.0 else f"{value:.0f}x"


def number(value: float) -> str:
    """Return a value with three significant digits, without an exponent where that stays short."""
    if not math.isfinite(value):
        return "-"
    if value != 0.0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.1e}"
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{digits}f}"


def numbers(values: Sequence[float]) -> str:
    """Return several values as one cell: "0.0226 / 0.0285"."""
    return " / ".join(number(value) for value in values)


def count_met(checks: Sequence[Check]) -> str:
    """Return how many limits are met, as a sentence in bold; nothing where there is no limit."""
    return f"**{sum(check.met for check in checks)} of {len(checks)} limits met.**" if checks else ""


def median(values: Sequence[float]) -> float:
    """Return the median, NaN of nothing."""
    return statistics.median(values) if values else math.nan


@dataclass(frozen=True, slots=True)
class Trials:
    """What all seeds of one case gave."""

    name: str
    problem: Any
    trials: Sequence[Any]

    def median(self, column: str) -> float:
        """Return the median of a field of the trials."""
        return median([getattr(trial, column) for trial in self.trials])
