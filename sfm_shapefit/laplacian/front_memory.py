"""Where the update matrices of fronts lie while threads work on the units of a plan."""

import threading
from bisect import insort
from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue

import numpy as np

from sfm_shapefit.laplacian.symbolic import SymbolicFactor


class FrontMemory:
    """An arena for each unit that is at work, and places for what one unit leaves to another.

    One thread has these on the stack of the plan. Several come in any order: each takes the first place that
    is large enough. Which one that is changes no number.
    """

    def __init__(self, plan: SymbolicFactor, threads: int) -> None:
        """Begin with nothing in it."""
        self.units, self._places = plan.units, plan.update_offsets.copy()
        self.num_arenas = min(threads, len(self.units))
        """Number of units that can be at work."""
        parent, unit_of, arenas = plan.parent, plan.unit_of, self.num_arenas * plan.arena_size
        self._is_inside, self._areas = unit_of[parent] == unit_of, np.diff(plan.row_pointers) ** 2
        between = np.flatnonzero((parent >= 0) & ~self._is_inside)
        self.leaving: list[list[int]] = [[] for _ in self.units]
        """For each unit its supernodes whose parents are in others."""
        self.entering: list[list[int]] = [[] for _ in self.units]
        """For each unit the supernodes of others whose parents are in it."""
        for s, start, end in zip(between, unit_of[between], unit_of[parent[between]], strict=True):
            self.leaving[start].append(int(s))
            self.entering[end].append(int(s))
        self._places[between] += arenas
        self.size = arenas + plan.stack_size
        """(Block) entries in all."""
        if self.num_arenas > 1:  # enough for any order; the last places are hardly ever touched
            self.size = arenas + int(self._areas[between].sum())
        self._lock, self._arena_size = threading.Lock(), plan.arena_size
        self.begin()

    def begin(self) -> None:
        """Begin anew, with nothing in it."""
        self.offsets = self._places.copy()
        """(S,) start of each update matrix, in (block) entries, once it has a place."""
        self._free = [(self.num_arenas * self._arena_size, self.size)]
        self._arenas = SimpleQueue[int]()
        for k in range(self.num_arenas):
            self._arenas.put(k)

    @contextmanager
    def room(self, unit: int, made: list[int], used: list[int]) -> Iterator[int]:
        """Have an arena, whose number is yielded, and places for `made`; free that and those of `used`."""
        begin, end = self.units[unit]
        arena = self._arenas.get()
        self.offsets[begin:end] += arena * self._arena_size * self._is_inside[begin:end]
        self._take(made)
        yield arena
        self._give(used)
        self._arenas.put(arena)

    def _take(self, made: list[int]) -> None:
        if self.num_arenas == 1:
            return
        with self._lock:
            for s in made:
                size = int(self._areas[s])
                k = next(k for k, (begin, end) in enumerate(self._free) if end - begin >= size)
                self.offsets[s], end = self._free[k]
                self._free[k] = int(self.offsets[s]) + size, end

    def _give(self, used: list[int]) -> None:
        if self.num_arenas == 1:
            return
        with self._lock:
            for s in used:
                begin = int(self.offsets[s])
                insort(self._free, (begin, begin + int(self._areas[s])))
            joined = [self._free[0]]
            for begin, end in self._free[1:]:
                first, last = joined[-1]
                joined[-1:] = [(first, end)] if begin == last else [(first, last), (begin, end)]
            self._free = joined
