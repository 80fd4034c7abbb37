"""The deterministic conditions under which ShapeFit provably recovers the locations, for a given graph.

Both recovery theorems of the paper have the same shape: if the graph is p-typical, the locations are in
general position (beta), of comparable distances (c_0) and well-distributed along the graph (c_1), then
ShapeFit returns the truth, whatever the corrupted directions are, as long as every camera has at most
eps n of them. The largest eps they grant is

    any d >= 3:   eps = beta c_0 c_1^2 p^4 / (3 * 256 * 64 * 32)               (section 2.1)
    d = 3:        eps = beta c_1^2 p^4 / (32 * 3 * 64 * 1024 c_0^2)            (section 3.1)

The second needs beta only for all but eps_1 n cameras k of each pair, eps_1 = p / (192 c_0), and bounds
distances from above only. All constants are invariant under shifts and scalings of the locations. All grow
with p, so the largest p for which the graph is p-typical gives the largest eps.

Well-distributedness with respect to a pair (x, y) asks for the smallest c with

    sum_k || P_k h ||  >=  c * number of k * || P h ||      for all h,

P and P_k the projections orthogonal to x - y and to the triangle x, y, t_k. In three dimensions P_k h is
<n_k, h> with the unit normal n_k of the triangle, orthogonal to x - y, so that the sum is a function of one
angle, concave between the angles at which one of its terms is zero: its minimum is at one of these. In more
dimensions ||P_k h||^2 = 1 - <b_k, h>^2 with b_k the direction of the triangle's height, and the sum is
bracketed: below, since a norm <= 1 is at least its square, by an eigenvalue; above by a local minimum.

Source: Hand, Lee, Voroninski (2015), arXiv 1506.01437, theorems of sections 2.1 and 3.1.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from scipy.sparse import coo_array

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.graph.viewgraph import connected_components

Part = TypeVar("Part")

_ANY_DIMENSION = 3 * 256 * 64 * 32
_THREE_DIMENSIONS = 32 * 3 * 64 * 1024
_EXCEPTIONS = 192
_FEASIBLE = 8.0
# Three locations are on a line if the sine of their angle is no larger; rounding alone gives 1e-16.
_COLLINEAR = 1e-12
_LOCAL_STEPS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Typicality:
    """For which p a graph is p-typical.

    That is: connected, degrees in [n p / 2, 2 n p], codegrees in [n p^2 / 2, 2 n p^2].
    """

    connected: bool
    degrees: tuple[int, int]
    """Least and greatest number of pairs of a camera."""
    codegrees: tuple[int, int]
    """Least and greatest number of common neighbors of two cameras, joined or not."""
    p_low: float
    """The graph is p-typical for p in [p_low, p_high], and for none if p_low > p_high."""
    p_high: float

    @property
    def holds(self) -> bool:
        """Whether there is such a p."""
        return self.connected and self.p_low <= self.p_high


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryConditions:
    """The constants of both theorems for a graph and its true locations."""

    num_cameras: int
    dimension: int
    typicality: Typicality
    beta: float
    """Least sine of an angle of a triangle of three cameras, over all triples."""
    beta_most: float
    """The same for all but `exceptions` cameras k of each pair (i, j), angles at i and j."""
    exceptions: int
    """eps_1 n of the theorem in three dimensions, at the largest p."""
    num_collinear: int
    """Triples of cameras on a line."""
    distance_ratio: float
    """c_0 of the theorem for any d: least distance over the greatest, over all pairs of cameras."""
    distance_bound: float
    """c_0 of the theorem in three dimensions: greatest distance over the mean length of the graph's pairs."""
    spread: tuple[float, float]
    """Bracket of c_1, the well-distributedness along the graph; both ends are equal in three dimensions."""

    @property
    def granted(self) -> float:
        """The largest eps that the theorem for any dimension grants; 0 if a condition fails."""
        t = self.typicality
        if not t.holds or self.dimension < 3:
            return 0.0
        return self.beta * self.distance_ratio * self.spread[0] ** 2 * t.p_high**4 / _ANY_DIMENSION

    @property
    def granted_in_space(self) -> float:
        """The largest eps_0 that the theorem in three dimensions grants; 0 if a condition fails."""
        t = self.typicality
        if not t.holds or self.dimension != 3 or self.num_collinear > 0:
            return 0.0
        constants = self.beta_most * self.spread[0] ** 2 * t.p_high**4
        return constants / (_THREE_DIMENSIONS * self.distance_bound**2)

    @property
    def feasible(self) -> float:
        """The eps below which L(T0) != 0, so that a scaling of the truth is feasible (either lemma)."""
        t = self.typicality
        if not t.holds:
            return 0.0
        return max(self.distance_ratio, 1.0 / self.distance_bound) * t.p_high / _FEASIBLE

    def guarantees_recovery(self, corrupted_degree: int) -> bool:
        """Return whether a theorem applies with at most `corrupted_degree` corrupted pairs at each camera."""
        granted = max(self.granted, self.granted_in_space)
        return granted > 0.0 and corrupted_degree <= self.num_cameras * granted


def recovery_conditions(locations: FloatArray, edges: IntArray, *, threads: int = 1) -> RecoveryConditions:
    """Compute the constants of both recovery theorems.

    Args:
        locations: (n, d) true locations, d >= 2, n >= 3.
        edges: (m, 2) pairs of the graph, each once.
        threads: of the passes over triples; the result does not depend on it.

    Time grows with n^3 (a thousand cameras: seconds).

    Raises:
        InputError: if there are fewer than three cameras or no pairs, or two locations coincide.
    """
    n, d = locations.shape
    if n < 3 or len(edges) == 0 or d < 2:
        raise InputError("the conditions need three cameras, a pair, and at least two dimensions")
    t = np.ascontiguousarray(locations - locations.mean(axis=0), dtype=np.float64)
    adjacency = np.zeros((n, n), dtype=np.bool_)
    adjacency[edges[:, 0], edges[:, 1]] = adjacency[edges[:, 1], edges[:, 0]] = True
    distances = np.linalg.norm(t[:, None, :] - t[None, :, :], axis=2)
    apart = distances[np.triu_indices(n, k=1)]
    if apart.min() == 0.0:
        raise InputError("two locations coincide; the theorems ask for distinct ones")

    typicality = graph_typicality(n, edges)
    mean = float(distances[edges[:, 0], edges[:, 1]].mean())
    bound = float(apart.max()) / mean
    exceptions = int(n * min(typicality.p_high, 1.0) / (_EXCEPTIONS * bound))
    rows = _over_rows(partial(_least_sines, t, exceptions), n, threads)
    beta, beta_most, collinear = (np.concatenate(part) for part in zip(*rows, strict=True))
    return RecoveryConditions(
        num_cameras=n,
        dimension=d,
        typicality=typicality,
        beta=float(beta.min()),
        beta_most=float(beta_most.min()),
        exceptions=exceptions,
        num_collinear=int(collinear.sum()) // 3,  # once for each pair of the triple
        distance_ratio=float(apart.min() / apart.max()),
        distance_bound=bound,
        spread=well_distributed(t, adjacency, threads=threads),
    )


def graph_typicality(num_cameras: int, edges: IntArray) -> Typicality:
    """Return for which p a graph is p-typical (definition in section 2.1)."""
    n = num_cameras
    i, j = edges.T
    ones = np.ones(len(edges))
    half = coo_array((ones, (i, j)), shape=(n, n)).tocsr()
    adjacency = (half + half.T).tocsr()
    degrees = np.diff(adjacency.indptr)
    shared = adjacency @ adjacency
    shared.setdiag(0.0)
    shared.eliminate_zeros()
    full = shared.nnz == n * (n - 1)
    codegrees = int(shared.data.min()) if full else 0, int(shared.data.max(initial=0.0))
    lowest, highest = int(degrees.min()), int(degrees.max())
    return Typicality(
        connected=n > 0 and int(connected_components(n, edges).max()) == 0,
        degrees=(lowest, highest),
        codegrees=codegrees,
        p_low=max(highest / (2.0 * n), float(np.sqrt(codegrees[1] / (2.0 * n)))),
        p_high=min(2.0 * lowest / n, float(np.sqrt(2.0 * codegrees[0] / n)), 1.0),
    )


def well_distributed(locations: FloatArray, adjacency: BoolArray, *, threads: int = 1) -> tuple[float, float]:
    """Bracket c_1: the smallest well-distributedness of the common neighbors of two cameras.

    Args:
        locations: (n, d), distinct.
        adjacency: (n, n) symmetric.
        threads: of the passes over pairs.

    Returns:
        Lower and upper bound, equal in three dimensions. In the plane every triangle spans all of it, so
        that both are 0 unless cameras are collinear. Pairs without common neighbors ask for nothing.
    """
    n, d = locations.shape
    if d == 3:
        rows = _over_rows(partial(_spread_in_space, locations, adjacency), n, threads)
        exact = float(min(part.min() for part in rows))
        return exact, exact
    pairs = itertools.combinations(range(n), 2)
    brackets = [_spread_bracket(locations, i, j, adjacency[i] & adjacency[j]) for i, j in pairs]
    return min(low for low, _ in brackets), min(high for _, high in brackets)


def _over_rows(run: Callable[[int, int], Part], n: int, threads: int) -> list[Part]:
    """Return run(low, high) for slices of the cameras 0..n-1, in order."""
    bounds = np.linspace(0, n, min(8 * threads, n) + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, bounds[:-1], bounds[1:]))


@kernel
def _least_sines(
    t: FloatArray, exceptions: int, low: int, high: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return, for the pairs (i, j > i) of rows low..high: least sine over all k, over all but some k, and
    how many k are collinear with the pair; one entry per row.

    The height r of the triangle over the pair gives the sines r / |t_k - t_i| and r / |t_k - t_j|.
    """
    n, d = t.shape
    least, most = np.ones(high - low), np.ones(high - low)
    collinear = np.zeros(high - low, dtype=np.int64)
    smallest = np.empty(exceptions + 1)
    for i in range(low, high):
        for j in range(i + 1, n):
            length = 0.0
            for a in range(d):
                length += (t[j, a] - t[i, a]) ** 2
            smallest[:] = 1.0
            for k in range(n):
                if k in (i, j):
                    continue
                along = 0.0
                for a in range(d):
                    along += (t[k, a] - t[i, a]) * (t[j, a] - t[i, a])
                along /= length
                height, from_i, from_j = 0.0, 0.0, 0.0
                for a in range(d):
                    b = t[k, a] - t[i, a]
                    height += (b - along * (t[j, a] - t[i, a])) ** 2
                    from_i += b * b
                    from_j += (t[k, a] - t[j, a]) ** 2
                sine = np.sqrt(height / max(from_i, from_j))
                collinear[i - low] += sine < _COLLINEAR
                place = exceptions
                if sine < smallest[place]:
                    while place > 0 and sine < smallest[place - 1]:
                        smallest[place] = smallest[place - 1]
                        place -= 1
                    smallest[place] = sine
            least[i - low] = min(least[i - low], smallest[0])
            most[i - low] = min(most[i - low], smallest[exceptions])
    return least, most, collinear


@kernel
def _spread_in_space(t: FloatArray, adjacency: BoolArray, low: int, high: int) -> FloatArray:
    """Return the well-distributedness of the pairs (i, j > i), the least of each row low..high; d = 3.

    With phi_k in [0, pi) the angles of the triangles' heights, the sum at the angle h = phi_s is
    sum_k |sin(phi_k - phi_s)|; running sums of sines and cosines over sorted angles give all in one pass.
    """
    n = len(t)
    worst = np.ones(high - low)
    phi = np.empty(n)
    for i in range(low, high):
        for j in range(i + 1, n):
            ax, ay, az = t[j, 0] - t[i, 0], t[j, 1] - t[i, 1], t[j, 2] - t[i, 2]
            length = np.sqrt(ax * ax + ay * ay + az * az)
            ax, ay, az = ax / length, ay / length, az / length
            ex, ey, ez = _orthogonal_axis(ax, ay, az)
            fx, fy, fz = ay * ez - az * ey, az * ex - ax * ez, ax * ey - ay * ex
            count, on_line = 0, 0
            for k in range(n):
                if adjacency[i, k] and adjacency[j, k]:
                    bx, by, bz = t[k, 0] - t[i, 0], t[k, 1] - t[i, 1], t[k, 2] - t[i, 2]
                    u, v = bx * ex + by * ey + bz * ez, bx * fx + by * fy + bz * fz
                    if u * u + v * v <= _COLLINEAR**2 * (bx * bx + by * by + bz * bz):
                        on_line += 1  # its complement is all of the plane: it contributes |h|
                    else:
                        phi[count] = np.arctan2(v, u) % np.pi
                        count += 1
            if count + on_line == 0:
                continue
            least = 0.0 if count == 0 else _least_sum_of_sines(np.sort(phi[:count]))
            worst[i - low] = min(worst[i - low], (least + on_line) / (count + on_line))
    return worst


@inner_kernel
def _orthogonal_axis(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a unit vector orthogonal to a unit vector."""
    if abs(x) < 0.6:
        size = np.sqrt(y * y + z * z)
        return 0.0, z / size, -y / size
    size = np.sqrt(x * x + y * y)
    return y / size, -x / size, 0.0


@inner_kernel
def _least_sum_of_sines(phi: FloatArray) -> float:
    """Return min over s of sum_k |sin(phi_k - phi_s)| for sorted angles in [0, pi)."""
    sines, cosines = np.sin(phi), np.cos(phi)
    ahead_sin, ahead_cos = sines.sum(), cosines.sum()  # of the angles from s on, less those before
    least = np.inf
    for s in range(len(phi)):
        least = min(least, cosines[s] * ahead_sin - sines[s] * ahead_cos)
        ahead_sin -= 2.0 * sines[s]
        ahead_cos -= 2.0 * cosines[s]
    return max(least, 0.0)


def _spread_bracket(t: FloatArray, i: int, j: int, common: BoolArray) -> tuple[float, float]:
    """Bracket the well-distributedness of the cameras `common` with respect to the pair (i, j), any d."""
    axis = (t[j] - t[i]) / np.linalg.norm(t[j] - t[i])
    offsets = t[common] - t[i]
    heights = offsets - np.outer(offsets @ axis, axis)
    sizes = np.linalg.norm(heights, axis=1)
    off_line = sizes > _COLLINEAR * np.linalg.norm(offsets, axis=1)
    units = heights[off_line] / sizes[off_line][:, None]
    on_line, k = int((~off_line).sum()), len(offsets)
    if len(units) == 0:
        return 1.0, 1.0
    values, vectors = np.linalg.eigh(units.T @ units)
    low = on_line + max(len(units) - float(values[-1]), 0.0)
    high = on_line + _local_minimum(units, vectors[:, -1])
    return low / k, max(high, low) / k


def _local_minimum(units: FloatArray, h: FloatArray) -> float:
    """Return a local minimum of sum_k sqrt(1 - <b_k, h>^2) over unit vectors h in the span of the b_k.

    The root is concave, so its tangent at h is above it: each step maximizes sum_k w_k <b_k, h>^2 with
    w_k = 1 / sqrt(1 - <b_k, h>^2), and the sum falls.
    """
    best = np.inf
    for _ in range(_LOCAL_STEPS):
        sines = np.sqrt(np.maximum(1.0 - (units @ h) ** 2, 0.0))
        total = float(sines.sum())
        if total >= best * (1.0 - 1e-12):
            return min(best, total)
        best = total
        weighted = units / np.maximum(sines, 1e-9)[:, None]
        h = np.linalg.eigh(units.T @ weighted)[1][:, -1]
    return best
