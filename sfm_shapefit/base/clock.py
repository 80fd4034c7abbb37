"""How long each stage takes, and how far it is."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from sfm_shapefit.base.arrays import begin_run, hand_back_memory
from sfm_shapefit.base.executors import Cluster, Crew
from sfm_shapefit.base.threads import count_threads

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the work done so far and the work in all."""


@dataclass(slots=True)
class Clock:
    """One run of a command: its seconds by stage, who hears of its progress, and who shares its work."""

    progress: Progress = field(default=lambda _stage, _done, _total: None)
    seconds: dict[str, float] = field(default_factory=dict)
    stage: str = ""
    cluster: Cluster | None = None
    """Workers who share the work; None: all is done in this process."""
    threads: int = field(default_factory=count_threads)
    """Threads of this process."""

    @classmethod
    def of(cls, progress: Progress | None, threads: int = 0, cluster: Cluster | None = None) -> "Clock":
        """Begin a run whose caller may want to hear of its progress; 0 threads are one per core."""
        begin_run()
        clock = cls(cluster=cluster, threads=count_threads(threads))
        clock.progress = progress or clock.progress
        return clock

    @property
    def crew(self) -> Crew:
        """Who works."""
        return Crew(self.threads, self.cluster)

    def anew(self) -> "Clock":
        """Return a clock of the same run that has measured nothing."""
        return Clock(self.progress, cluster=self.cluster, threads=self.threads)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a stage; one that comes again adds to its time, and so does one that fails."""
        self.stage = stage
        hand_back_memory()
        self.progress(stage, 0, 1)
        start = time.perf_counter()
        try:
            yield
        finally:  # a component that cannot be placed has taken its time, too
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
        self.progress(stage, 1, 1)

    def advance(self, done: int, total: int) -> None:
        """Report progress inside the current stage."""
        self.progress(self.stage, done, total)
