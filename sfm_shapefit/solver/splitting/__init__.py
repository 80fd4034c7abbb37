"""Splitting for large view graphs: ShapeFit and LUD by ADMM with the scalar graph Laplacian.

edges      the proximal step, fused into one pass over the edges
anderson   acceleration of the iteration
linear     the Laplacian solve: Cholesky where it fits, conjugate gradients elsewhere
engine     the iteration that both programs share
shapefit   Splitting, a run of ShapeFit
lud        solve_lud
"""

from sfm_shapefit.solver.splitting.engine import Stop
from sfm_shapefit.solver.splitting.linear import IterativeSolver, LaplacianFactor, laplacian_factor
from sfm_shapefit.solver.splitting.lud import LudResult, solve_lud
from sfm_shapefit.solver.splitting.shapefit import AdmmResult, Splitting

__all__ = [
    "AdmmResult",
    "IterativeSolver",
    "LaplacianFactor",
    "LudResult",
    "Splitting",
    "Stop",
    "laplacian_factor",
    "solve_lud",
]
