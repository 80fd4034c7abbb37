"""Figure 1 of the paper and its extensions: `python scripts/figure.py phase_transition --out FILE`.

Mean relative error over 10 problems of the random model for every number of locations n and probability q of
corruption, drawn as in the paper: white is 0, black is 1. `--figure` picks what is compared; interrupted runs
go on where they were. Source: Hand, Lee, Voroninski (2015), section 4.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, get_args

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from paper.trials import Cell, Results, run_trials
from sfm_shapefit.synthetic.graphs import Corruption

SEED = 0
EXACT = 1e-9
NOISE = 0.05


@dataclass(frozen=True)
class Panel:
    """One picture of a figure: a method on one setting of the model."""

    title: str
    method: str
    n: tuple[int, ...]
    q: tuple[float, ...]
    sigma: float = 0.0
    p: float = 0.5
    d: int = 3
    corruption: Corruption = "uniform"

    def cells(self) -> list[Cell]:
        return [Cell(n, q, self.sigma, self.p, self.d, self.corruption) for n in self.n for q in self.q]

    @property
    def doubles(self) -> bool:
        """Whether each n is twice the one before: drawn on a logarithmic axis."""
        return all(later == 2 * n for n, later in pairwise(self.n))


def _shares(num: int) -> tuple[float, ...]:
    return tuple(np.round(np.linspace(0.0, 0.5, num), 4).tolist())


NOISES = ((0.0, "no noise"), (NOISE, f"noise {NOISE}"))
FINE, COARSE = (tuple(range(10, 81, 2)), _shares(21)), (tuple(range(10, 81, 5)), _shares(11))


def _coarse(title: str, method: str, **settings: Any) -> Panel:
    return Panel(title, method, *COARSE, **settings)


METHODS_SHOWN = ("ShapeFit", "refined", "LUD", "least squares")
FIGURES: dict[str, list[Panel]] = {
    "paper": [Panel(f"ShapeFit, {words}", "ShapeFit", *FINE, sigma=s) for s, words in NOISES],
    "methods": [_coarse(f"{m}, {words}", m, sigma=s) for s, words in NOISES for m in METHODS_SHOWN],
    "corruption": [
        _coarse(f"{m}, {kind}", m, corruption=kind)
        for kind in get_args(Corruption)
        for m in METHODS_SHOWN[:3]
    ],
    "density": [_coarse(f"ShapeFit, p = {p}", "ShapeFit", p=p) for p in (0.25, 0.5, 0.75)],
    "dimension": [
        *(_coarse(f"ShapeFit, d = {d}", "ShapeFit", d=d) for d in (2, 3, 10)),
        Panel("ShapeFit, d = 50", "ShapeFit", tuple(range(10, 61, 10)), _shares(6), d=50),
    ],
    "large": [Panel("ShapeFit, n to 320", "ShapeFit", (20, 40, 80, 160, 320), COARSE[1])],
}


def image(panel: Panel, results: Results) -> np.ndarray:
    """Return the mean errors of a panel, rows by n, columns by q."""
    means = dict(zip(results.cells, results.mean_errors(panel.method), strict=True))
    return np.array([means[cell] for cell in panel.cells()]).reshape(len(panel.n), len(panel.q))


def draw(shown: Sequence[Panel], results: Results) -> Figure:
    """Draw the panels as the paper does."""
    columns = min(len(shown), 3 if len(shown) % 3 == 0 else 4)
    rows = -(-len(shown) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.2 * columns, 3.9 * rows), dpi=80, squeeze=False, layout="constrained"
    )
    for panel, axis in zip(shown, axes.ravel(), strict=False):
        picture = axis.pcolormesh(
            panel.q, panel.n, image(panel, results), cmap="gray_r", vmin=0.0, vmax=1.0, shading="nearest"
        )
        if panel.doubles:
            axis.set_yscale("log")
            axis.set_yticks(panel.n, [str(n) for n in panel.n])
            axis.minorticks_off()
        axis.set(title=panel.title, xlabel="corruption probability q", ylabel="number of locations n")
    for axis in axes.ravel()[len(shown) :]:
        axis.set_axis_off()
    figure.colorbar(picture, ax=axes, label="mean relative error", shrink=0.7)
    return figure


def report(shown: Sequence[Panel], results: Results) -> str:
    """Say what the paper's text says of its figure."""
    lines = [f"{len(results.cells)} cells"]
    for panel in shown:
        errors = results.of(panel.method)[[results.cells.index(cell) for cell in panel.cells()]]
        exact = errors < EXACT
        lines.append(f"{panel.title}: {exact.mean():.1%} of {exact.size} problems recovered below {EXACT:g}")
        largest = [cell.n == max(panel.n) and cell.q <= 0.3 for cell in panel.cells()]
        if panel.sigma == 0.0 and any(largest):
            lost = ~exact[largest]
            lines.append(f"  n = {max(panel.n)}, q <= 0.3: {lost.sum()} of {lost.size} not recovered")
    return "\n".join([*lines, *_noisy_where_exact(shown, results)])


def _noisy_where_exact(shown: Sequence[Panel], results: Results) -> list[str]:
    """Say how large the errors with noise are in the cells that are exact without."""
    lines, known = [], {replace(panel, title=""): panel for panel in shown}
    for noisy in shown:
        clean = known.get(replace(noisy, title="", sigma=0.0))
        if clean is None or noisy.sigma == 0.0:
            continue
        errors = image(noisy, results)[image(clean, results) < EXACT]
        largest = errors.max(initial=0.0)
        lines.append(f"{noisy.title}: at most {largest:.2g} in the {errors.size} cells exact without")
    return lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare which figure is drawn."""
    parser.add_argument("--figure", choices=FIGURES, default="paper")


def run(args: argparse.Namespace) -> Figure:
    """Compute and draw a figure, and say what the paper's text says of its own.

    Every method runs on every cell.
    """
    shown, trials = FIGURES[args.figure], args.trials
    if args.quick:
        shown, trials = [replace(panel, n=(10, 30), q=(0.0, 0.2)) for panel in shown], 2
    cells = list(dict.fromkeys(cell for panel in shown for cell in panel.cells()))
    methods = list(dict.fromkeys(panel.method for panel in shown))
    results = run_trials(cells, methods, trials, cache=args.cache, processes=args.processes, seed=SEED)
    print(report(shown, results))
    return draw(shown, results)
