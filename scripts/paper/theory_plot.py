"""What the theorems grant against what is recovered: `python scripts/figure.py theory_plot --out FILE`.

Both recovery theorems say: if every camera has at most eps n wrong pairs, ShapeFit is exact, whatever these
are. For problems of the paper's random model this draws, against n (at p = 1/2) and against p (at n = 60),
the largest eps that each theorem grants with its own constants, the eps below which the truth is feasible
(the lemmas' L(T0) != 0), and the empirical one: below it every problem tried was recovered to 1e-9. Wrong
pairs here are random, not the worst there are, so the empirical curve is above what any theorem could grant.

Source: Hand, Lee, Voroninski (2015), theorems of sections 2.1 and 3.1.
"""

import argparse
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from harness.graphs import relative_error
from paper.theory import recovery_conditions
from paper.trials import METHODS
from sfm_shapefit.base.errors import ShapeFitError
from sfm_shapefit.synthetic.graphs import GraphProblem, random_graph_problem

EXACT = 1e-9
SIZES, P_OF_SIZES = (20, 30, 40, 60, 80, 120, 160, 240), 0.5
DENSITIES, N_OF_DENSITIES = (0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0), 60
QUICK_SIZES, QUICK_DENSITIES = (10, 20), (0.5, 1.0)
CURVES = {
    "any_dimension": ("granted, theorem for any d", "o"),
    "in_space": ("granted, theorem for d = 3", "s"),
    "feasible": ("truth feasible (lemmas)", "^"),
    "recovered": ("recovered: every problem below", "D"),
}


class Point(NamedTuple):
    """One setting of the model: medians over its graphs of what is granted, and what was recovered."""

    any_dimension: float
    in_space: float
    feasible: float
    recovered: float
    """Wrong pairs of the worst camera, over n: least of a problem that was lost, the largest if none was."""


def measure(n: int, p: float, trials: int, num_shares: int) -> Point:
    """Compute the constants of some graphs, and solve their problems at growing corruption."""
    granted, outcomes = [], []
    for trial in range(trials):
        clean = random_graph_problem(n, p, seed=trial)
        found = recovery_conditions(clean.locations, clean.edges)
        granted.append((found.granted, found.granted_in_space, found.feasible))
        for k, q in enumerate(np.linspace(0.0, 0.5, num_shares)[1:]):
            problem = random_graph_problem(n, p, q=float(q), seed=1000 * (k + 1) + trial)
            outcomes.append((worst_share(problem), is_recovered(problem)))
    lost = [share for share, good in outcomes if not good]
    largest = max(share for share, _ in outcomes)
    return Point(*np.median(granted, axis=0).tolist(), min(lost, default=largest))


def worst_share(problem: GraphProblem) -> float:
    """Return the largest number of wrong pairs of a camera over the number of cameras."""
    n = len(problem.locations)
    return float(np.bincount(problem.edges[problem.corrupted].ravel(), minlength=n).max() / n)


def is_recovered(problem: GraphProblem) -> bool:
    """Return whether ShapeFit is exact; a problem that is not rigid is lost."""
    try:
        locations = METHODS["ShapeFit"](problem)
    except ShapeFitError:
        return False
    return relative_error(locations, problem.locations) < EXACT


def draw(panels: Sequence[tuple[str, Sequence[float], list[Point]]]) -> Figure:
    """Draw the curves of each panel over its axis; a theorem that grants nothing leaves a gap."""
    figure, axes = plt.subplots(
        1, len(panels), figsize=(10.5, 4.2), dpi=90, sharey=True, layout="constrained"
    )
    for (label, values, points), axis in zip(panels, axes, strict=True):
        for name, (words, marker) in CURVES.items():
            eps = np.array([getattr(point, name) for point in points])
            axis.plot(values, np.where(eps > 0.0, eps, np.nan), marker=marker, markersize=4, label=words)
        axis.set(xlabel=label, yscale="log")
        axis.grid(visible=True, alpha=0.3)
    axes[0].set_ylabel("eps: wrong pairs of a camera / n")
    axes[0].legend(loc="center right", fontsize=8)
    return figure


def run(args: argparse.Namespace) -> Figure:
    """Compute and draw the curves, and print the figures behind them."""
    sizes, densities = (QUICK_SIZES, QUICK_DENSITIES) if args.quick else (SIZES, DENSITIES)
    trials, num_shares = (2, 6) if args.quick else (args.trials, 21)
    n_of_densities = QUICK_SIZES[-1] if args.quick else N_OF_DENSITIES
    by_size = [measure(n, P_OF_SIZES, trials, num_shares) for n in sizes]
    by_density = [measure(n_of_densities, p, trials, num_shares) for p in densities]
    panels = [
        (f"number of locations n (p = {P_OF_SIZES:g})", sizes, by_size),
        (f"edge probability p (n = {n_of_densities})", densities, by_density),
    ]
    for label, values, points in panels:
        print(label)
        for value, point in zip(values, points, strict=True):
            print(
                f"  {value:g}: granted {point.any_dimension:.1e} (any d), {point.in_space:.1e} (d = 3); "
                f"feasible {point.feasible:.1e}; recovered {point.recovered:.2f}"
            )
    return draw(panels)
