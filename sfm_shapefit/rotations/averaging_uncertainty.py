"""How well averaged rotations are known: the inverse of the last system, scaled by what the pairs disagree.

With the robust blocks B_e = w_e R_j^T H_e R_j of all pairs and L = D^T B D, rotations that were averaged from
pairs of covariance v H_e^-1 have, in world axes and relative to their own mean turn, the covariance

    C = c v P L^+ P,        P = I - 1 1^T / n.

c corrects for the loss: an M-estimator with weights w(d^2) of normal residuals in three dimensions has the
covariance a / b^2 (D^T H D)^-1 with a = E[w^2 d^2] / 3 and b = E[w + 2/3 w' d^2] (Huber, "Robust Statistics",
section 7.6), and L is E[w] D^T H D on average, so c = E[w] a / b^2; 0.823 for Geman and McClure's loss at
three medians. v is what residuals say: Mahalanobis lengths d_e^2 / (1 - h_e) have the median 2.366 v, where
the leverage h_e = tr(B_e (Z_ii + Z_jj - Z_ij - Z_ij^T)) / 3 is the share of its residual that a pair does not
show. Pairs whose residual says nothing (bridges have h = 1) are not asked; if all are such, v = 1: the given
information is believed.

Where the factor of L is small, the blocks of its inverse Z come from it. Else L^+ is sampled: for normal g_e,
x = L^+ D^T B^(1/2) g has the covariance L^+. Given all other cameras, camera i is normal around
m_i = A_i^-1 sum_j B_ij x_j with the covariance A_i^-1, where A_i = sum_j B_ij; so in the gauge of the mean

    P L^+ P at i = (1 - 1/n)^2 A_i^-1 + Cov[(1 - 1/n) m_i + x_i / n],

the first part exact, and the second one small in graphs whose factor is large (Siden, Lindgren, Bolin,
Villani, "Efficient covariance approximations for large sparse precision matrices", JCGS 2018).

Relative to the mean turn of some cameras only, P is I - 1 u^T with their shares u of it, the samples are
shifted to u^T x = 0, and 1/n is u_i.
"""

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, sum_by
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.rotations.annealing import AveragingPairs, Linearized
from sfm_shapefit.rotations.averaging_system import RIDGE, AveragingSystem, plan_system

_LOSS_FACTOR = 0.823  # c of the header; for Geman and McClure's loss at three medians
_MEDIAN_SQUARE = 2.366  # median of chi2 with three degrees of freedom; scales residuals to v
MOST_LEVERAGE = 0.9
"""Leverage above which a pair is left out of the residual scale: it hardly shows its residual."""
_SAMPLES = 16  # samples of L^+; they serve the second, small part of the covariance
_REDUCTION = 1e-2  # share of the residual that a sample may have; far below its own noise
_SEED = 2  # seed of the samples; same input, same answer


def estimate_sigmas(
    given: AveragingPairs,
    system: AveragingSystem,
    last: Linearized,
    references: BoolArray | None = None,
) -> FloatArray:
    """Return each camera's standard deviation per axis in radians, (n,), relative to the mean of some or all.

    Infinite for cameras that the pairs of the last system do not tie to the largest part of the others.

    Args:
        given: the pairs of n cameras.
        system: solver of these.
        last: system at the answer.
        references: (n,) cameras whose mean turn counts as exact; all if None.
    """
    references = np.ones(given.num_cameras, dtype=np.bool_) if references is None else references
    n, inside = given.num_cameras, _ties(given.num_cameras, last)
    sigmas = np.full(n, np.inf)
    labels = connected_components(n, given.pairs[inside])
    main = labels == np.argmax(np.bincount(labels))
    if main.sum() < 2:
        return sigmas
    if not main.all():
        numbers = np.cumsum(main) - 1
        kept = inside & main[given.pairs].all(axis=1)
        pairs = np.ascontiguousarray(numbers[given.pairs[kept]])
        last = Linearized(np.ascontiguousarray(last.blocks[kept]), last.distances[kept])
        weights = np.trace(last.blocks, axis1=1, axis2=2)
        system = plan_system(int(main.sum()), pairs, weights, system.threads)
    estimate = _factored if system.factors_blocks else _sampled
    variances, leverages = estimate(system, last, references[main])
    sigmas[main] = np.sqrt(_LOSS_FACTOR * residual_variance(last.distances, leverages) * variances)
    return sigmas


def _ties(num_cameras: int, last: Linearized) -> BoolArray:
    """Return which pairs (k,) hold their cameras.

    The loss leaves pairs that fit badly a share of their weight, next to nothing where the others fit to
    rounding. What is below the ridge of the rounds holds no camera: there the ridge did.
    """
    traces = np.trace(last.blocks, axis1=1, axis2=2)
    mean_diagonal = 2.0 * float(traces.sum()) / num_cameras
    return np.asarray(~np.isnan(last.distances) & (traces > RIDGE * mean_diagonal))


def residual_variance(distances: FloatArray, leverages: FloatArray) -> float:
    """Return the variance of the residuals over that of the given information; 1 if they do not say."""
    usable = (leverages <= MOST_LEVERAGE) & ~np.isnan(distances)
    if not usable.any():
        return 1.0
    return float(np.median(distances[usable] ** 2 / (1.0 - leverages[usable]))) / _MEDIAN_SQUARE


def _factored(
    system: AveragingSystem, last: Linearized, references: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return a third of the trace of P L^+ P at each camera, (n,), and the leverage of each pair, (k,)."""
    factor = system.ground_blocks(last.blocks)
    inverse = factor.selected_inverse()
    i, j = system.pairs.T
    difference = inverse.nodes[i] + inverse.nodes[j] - inverse.edges - inverse.edges.transpose(0, 2, 1)
    leverages = np.einsum("kab,kab->k", last.blocks, difference) / 3.0
    shares = np.zeros((system.num_nodes, 3, 3))
    shares[references] = np.eye(3) / references.sum()
    means = factor.solve(shares)
    covariances = inverse.nodes - means - means.transpose(0, 2, 1) + means[references].mean(axis=0)
    return np.trace(covariances, axis1=1, axis2=2) / 3.0, leverages


def _sampled(
    system: AveragingSystem, last: Linearized, references: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the same from samples; the leverages are their mean."""
    n, k = system.num_nodes, len(system.pairs)
    rng = np.random.default_rng(_SEED)
    inverses = np.linalg.inv(system.sum_at_nodes(last.blocks))
    apply = system.block_operator(last.blocks)
    share = references / references.sum()
    total, roots, (i, j) = np.zeros(n), np.zeros((k, 3, 3)), system.pairs.T
    counts = last.blocks[:, 0, 0] > 0.0
    rounding = 1e-14 * np.trace(last.blocks[counts], axis1=1, axis2=2)[:, None, None] * np.eye(3)
    roots[counts] = np.linalg.cholesky(last.blocks[counts] + rounding)  # some are singular but for it
    for _ in range(_SAMPLES):
        pulls = np.einsum("kab,kb->ka", roots, rng.normal(size=(k, 3)))
        right = sum_by(i, pulls, n) - sum_by(j, pulls, n)  # D^T B^(1/2) g
        x = system.solve_blocks(last.blocks, right, _REDUCTION)
        x = x - x[references].mean(axis=0)
        # A m = A x - L x.
        around = x - np.einsum("nab,nb->na", inverses, apply(x))
        total += np.sum(((1.0 - share)[:, None] * around + share[:, None] * x) ** 2, axis=1)
    exact = (1.0 - share) ** 2 * np.trace(inverses, axis1=1, axis2=2)
    return (exact + total / _SAMPLES) / 3.0, np.full(k, (n - 1) / np.sum(~np.isnan(last.distances)))
