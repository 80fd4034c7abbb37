"""Result of `place` in Python: the placement of a bare graph, and whether it can be used."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.facts.warnings import graph_warnings
from sfm_shapefit.judgement.graph_grade import judge_graph
from sfm_shapefit.judgement.judged import Judged
from sfm_shapefit.judgement.reasons import ModelVerdict
from sfm_shapefit.refinement.placement_options import PlacementOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class PlacedGraph(Judged):
    """A placed view graph: `positions` of all nodes, its `verdict` and its `warnings`."""

    verdict: ModelVerdict
    """Whether the positions can be used, and why."""
    warnings: tuple[str, ...]
    """What to know and to do, a sentence each."""

    @classmethod
    def of(cls, judged: Judged, options: PlacementOptions) -> Self:
        """Return a judged graph, placed with some options, with its verdict."""
        parts = {item.name: getattr(judged, item.name) for item in fields(Judged)}
        return cls(**parts, verdict=judge_graph(judged), warnings=tuple(graph_warnings(judged, options)))

    @property
    def positions(self) -> FloatArray:
        """The centers (n, d) of all nodes, in the solver's units; NaN where a node is not placed."""
        centers = np.full((self.graph.num_nodes, self.graph.dimension), np.nan)
        centers[self.cameras] = self.locations
        return centers

    def summary(self) -> dict[str, Any]:
        """Return the main figures in plain values."""
        return Judged.summary(self) | {
            "verdict": self.verdict.statement,
            "warnings": list(self.warnings),
        }

    def _headline(self) -> str:
        return f"{self.verdict.grade.value}: {Judged._headline(self)}"
