"""Where a run is: its stage, of how many, and how long the rest may take, by what stages usually take.

Usual seconds are believed in proportion to one another alone: what has ended, and what is counted, says how
fast they pass on this machine and with these matches.
"""

from collections.abc import Sequence

_USUAL_S = {
    "read": (0.05, 0.05),
    "matches": (0.0, 100.0),
    "relative rotations": (0.02, 0.7),
    "rotation averaging": (0.05, 0.2),
    "scores of pairs": (0.03, 0.15),
    "first placement": (0.3, 2.0),
    "directions": (0.02, 0.1),
    "solve": (0.2, 0.1),
    "adjustment": (0.5, 1.0),
    "trust": (0.1, 0.15),
    "structure": (0.01, 0.04),
    "triangulation": (0.03, 0.1),
    "model": (0.02, 0.05),
    "write": (0.15, 0.1),
    "evidence": (0.2, 0.2),
    "pictures": (0.0, 100.0),
}
"""Seconds of a stage, and more for each thousand pairs, on a quiet core: castle-P30, lego100, kerry-park."""
_COUNTED = {
    *("images", "features", "matches", "relative rotations", "directions", "structure", "triangulation"),
    *("pictures", "compiling kernels, once"),
}
"""Stages that count up to their total; solvers say how many steps they may take, and take fewer."""
_SIZED = {"matches", "relative rotations", "directions", "pictures"}
"""Stages that count the pairs of a run, or its pictures."""
_RATED_S = 1.0  # seconds before a rate is believed; what comes first loads what is needed

_AVERAGING = ("relative rotations", "rotation averaging")
_MODEL = ("trust", "structure", "triangulation", "trust", "model")
_MAPPING = (
    "scores of pairs",
    "rotation averaging",
    "first placement",
    "locate",
    "directions",
    "solve",
    *_MODEL,
)
PLANS = {
    "MODEL OUT": ("read", "directions", "solve", "adjustment", *_MODEL, "write"),
    "DATABASE OUT": ("read", *_AVERAGING, *_MAPPING, "join", "write"),
    "IMAGES OUT": (
        *("images", "features", "matches", "read", *_AVERAGING, "first placement"),
        *(*_AVERAGING, *_MAPPING, "join", "write"),
    ),
    "MODEL with a database": (
        "read",
        "second opinion",
        "read",
        *_AVERAGING,
        *_MAPPING,
        "join",
        "points",
        "directions",
        "evidence",
    ),
    "MODEL IMAGES OUT": ("read", "pictures", "model"),
}
"""Stages in their order, by what a command takes: `locate`, `map`, `map IMAGES`, `check`, `workspace`. A run
may leave some out; after one that comes again nobody knows how many are left."""


class Course:
    """A run on its way through a plan; times are seconds of any clock."""

    def __init__(self, plan: Sequence[str] = (), now: float = 0.0) -> None:
        self.plan, self.position, self.is_as_planned = plan, -1, True
        self.stage, self.done, self.total, self.first = "start", 0, 1, 0
        self.started = self.began = self.rated = self.heard = now
        self.size, self.spent_s, self.usual_s = 0, 0.0, 0.0

    def hear(self, stage: str, done: int, total: int, now: float) -> None:
        """Take what a stage reports; work done before its first report, as of a resumed run, has no rate."""
        if stage != self.stage:
            if done == total:  # a stage around this one has ended
                return
            self._begin(stage, now)
            self.total = 0
        if total != self.total:
            self.first, self.rated = done, now
        self.done, self.total, self.heard = done, total, now
        self.size = total if stage in _SIZED and total > 1 else self.size

    def _begin(self, stage: str, now: float) -> None:
        if self.size and self.stage in self.plan:
            self.spent_s += now - self.began
            self.usual_s += self._usual(self.stage) * (self._share if self.counts else 1.0)
        if stage == "read":  # how fast matches are made says nothing of what follows
            self.spent_s = self.usual_s = 0.0
        goes_on = self.stage not in self.plan and stage in self.plan[max(self.position, 0) :][:1]
        if stage in self.plan and not goes_on:
            later = self.plan[self.position + 1 :]
            self.is_as_planned &= stage in later
            self.position = self.plan.index(stage, self.position + 1 if stage in later else 0)
        self.stage, self.began = stage, now

    def _usual(self, stage: str) -> float:
        fixed, more = _USUAL_S.get(stage, (0.0, 0.0))
        return fixed + more * self.size / 1000.0

    @property
    def _share(self) -> float:
        """How much of the stage this run has done, by what it counts."""
        return (self.done - self.first) / self.total if self.counts else 0.0

    @property
    def title(self) -> str:
        """The stage, with its number where the plan has it."""
        number = f"stage {self.position + 1} of {len(self.plan)}, " if self.stage in self.plan else ""
        return f"{number}{self.stage}"

    @property
    def counts(self) -> str:
        """How much of the stage is done; empty if it does not count."""
        return f"{self.done:,} of {self.total:,}" if self.total > 1 and self.stage in _COUNTED else ""

    def rest_of_stage(self, now: float) -> float | None:
        """Return how long the stage takes yet by what it counts, seconds; None where nobody knows."""
        done, took = self.done - self.first, self.heard - self.rated
        if not self.counts or done <= 0 or took < _RATED_S:
            return None
        return max(self.heard + took * (self.total - self.done) / done - now, 0.0)

    def rest(self, now: float) -> float | None:
        """Return how long the run takes yet, seconds; None where that cannot be known."""
        if not (self.is_as_planned and self.size and self.stage in self.plan):
            return None
        here, usual = self.rest_of_stage(now), self._usual(self.stage)
        spent_s, usual_s = self.spent_s, self.usual_s
        if here is not None:
            spent_s, usual_s = spent_s + self.heard - self.began, usual_s + usual * self._share
        if spent_s < _RATED_S or usual_s == 0.0:
            return None
        rate = spent_s / usual_s
        left = 1.0 - self.done / self.total if self.counts else 1.0
        here = rate * usual * left - (now - self.began) if here is None else here
        later = rate * sum(map(self._usual, self.plan[self.position + 1 :]))
        return here + later if here >= 0.0 else None  # who takes longer than usual says no more
