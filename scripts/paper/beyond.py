"""Beyond the breakdown point: `python scripts/figure.py beyond --out docs/beyond.png`.

Figures 1 and 2 of the paper with most directions wrong: mean errors of ShapeFit, LUD and `place`, white is 0
and black is 1 or more, over the number of locations n, the odds p of a pair, and the share q of wrong
directions, random ones and such as agree with one another; and the error over the noise at q = 0.7. What is
drawn, and how errors are measured, are those of Hand, Lee, Voroninski (2015), section 4. Below, the table
published with Cycle-Sync (NeurIPS 2025), by its generator and measure, with `place` above it.
"""

import argparse
from dataclasses import dataclass, replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from benchmarks.corruption import PUBLISHED, SEEDS, draw_published, errors
from paper.trials import Cell, Results, run_trials
from sfm_shapefit import place

SHOWN = {"ShapeFit": "ShapeFit", "LUD": "LUD", "refined": "place"}
"""Methods of `paper.trials` and what they are called."""
SEED = 7
Q_TO_90 = tuple(np.round(np.linspace(0.0, 0.9, 10), 2).tolist())
Q_TO_60 = tuple(np.round(np.linspace(0.0, 0.6, 13), 2).tolist())
NUMBERS, ODDS = (20.0, 40.0, 60.0, 80.0, 100.0), (0.2, 0.35, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Row:
    """Phase diagrams of one kind of wrong directions, one per method."""

    title: str
    field: str
    """What changes upward, a field of `Cell`."""
    values: tuple[float, ...]
    q: tuple[float, ...]
    base: Cell

    def cells(self) -> list[Cell]:
        """Return all cells, upward and then by q."""
        kind = type(getattr(self.base, self.field))
        return [replace(self.base, **{self.field: kind(y)}, q=q) for y in self.values for q in self.q]


ROWS = (
    Row("random, p = 1/2", "n", NUMBERS, Q_TO_90, Cell(100, 0.0)),
    Row("random, n = 60", "p", ODDS, Q_TO_90, Cell(60, 0.0)),
    Row("self-consistent, p = 1/2", "n", NUMBERS, Q_TO_60, Cell(100, 0.0, corruption="self-consistent")),
)
NOISY = [Cell(100, 0.7, float(sigma)) for sigma in np.logspace(-6.0, -1.0, 11)]


def draw_phases(axis: Axes, row: Row, method: str, results: Results) -> QuadMesh:
    """Draw one phase diagram."""
    means = dict(zip(results.cells, results.mean_errors(method), strict=True))
    errors = np.array([means[cell] for cell in row.cells()]).reshape(len(row.values), len(row.q))
    axis.set(title=f"{SHOWN[method]}: {row.title}", xlabel="share q of wrong directions", ylabel=row.field)
    rows = np.arange(len(row.values))
    axis.set_yticks(rows, [f"{y:g}" for y in row.values])
    return axis.pcolormesh(row.q, rows, errors, cmap="gray_r", vmin=0.0, vmax=1.0, shading="nearest")


def draw_noise(axis: Axes, results: Results, noisy: list[Cell]) -> None:
    """Draw the mean errors over the noise."""
    rows = [results.cells.index(cell) for cell in noisy]
    for method, name in SHOWN.items():
        axis.loglog([cell.sigma for cell in noisy], results.mean_errors(method)[rows], ".-", label=name)
    axis.set(title=f"n = 100, p = 1/2, q = {noisy[0].q}", xlabel="noise sigma", ylabel="mean error")
    axis.grid(visible=True, alpha=0.3)
    axis.legend()


def draw_table(axis: Axes) -> None:
    """Write the published table, ours above."""
    drawn = draw_published("uniform", 0.8, 0.0, 100, SEEDS["published"])
    ours = errors(place(drawn.graph), drawn.truth)
    rows = {"place": (f"{ours.median:.1e}", f"{ours.mean:.1e}"), **PUBLISHED}
    axis.axis("off")
    axis.set_title("errors at q = 0.8, no noise")
    cells = [list(row) for row in rows.values()]
    axis.table(
        cells, rowLabels=list(rows), colLabels=["median", "mean"], loc="center", bbox=(0.4, 0.1, 0.6, 0.8)
    )


def run(args: argparse.Namespace) -> Figure:
    """Draw all, and print the largest share of wrong directions at which every problem is recovered."""
    rows, noisy, trials = ROWS, NOISY, args.trials
    if args.quick:
        small = {"values": (30.0,), "q": (0.0, 0.6)}
        rows, noisy, trials = tuple(replace(row, **small) for row in ROWS if row.field == "n"), NOISY[:2], 1
    cells = list(dict.fromkeys([cell for row in rows for cell in row.cells()] + noisy))
    results = run_trials(cells, list(SHOWN), trials, cache=args.cache, processes=args.processes, seed=SEED)
    figure = plt.figure(figsize=(14, 3.1 * len(rows)), dpi=80, layout="constrained")
    grid = figure.add_gridspec(len(rows), 4)
    for y, row in enumerate(rows):
        for x, method in enumerate(SHOWN):
            mesh = draw_phases(figure.add_subplot(grid[y, x]), row, method, results)
            print(f"{SHOWN[method]}, {row.title}: {_describe_exact(row, method, results)}")
    figure.colorbar(mesh, ax=figure.axes, label="mean relative error", shrink=0.5, location="left")
    draw_noise(figure.add_subplot(grid[:-1, 3]), results, noisy)
    draw_table(figure.add_subplot(grid[-1, 3]))
    return figure


def _describe_exact(row: Row, method: str, results: Results) -> str:
    """Say up to which share all problems of the largest value are recovered."""
    errors = results.of(method)[[results.cells.index(cell) for cell in row.cells()[-len(row.q) :]]]
    exact = np.cumprod((errors < 1e-6).all(axis=1)).sum()
    return f"all exact up to q = {row.q[exact - 1]:g}" if exact else "never all exact"
