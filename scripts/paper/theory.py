"""The deterministic conditions under which ShapeFit provably recovers the locations, for a graph in space.

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

P and P_k the projections orthogonal to x - y and to the triangle x, y, t_k. In space P_k h is <n_k, h> with
the unit normal n_k of the triangle, orthogonal to x - y, so that the sum is a function of one angle, concave
between the angles at which one of its terms is zero: its minimum is at one of these.

Source: Hand, Lee, Voroninski (2015), arXiv 1506.01437, theorems of sections 2.1 and 3.1.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.forests import connected_components

_ANY_DIMENSION = 3 * 256 * 64 * 32
_THREE_DIMENSIONS = 32 * 3 * 64 * 1024
_EXCEPTIONS = 192
_FEASIBLE = 8.0
# Sine of an angle up to which three locations are on a line; rounding alone gives 1e-16.
_COLLINEAR = 1e-12


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

    typicality: Typicality
    beta: float
    """Least sine of an angle of a triangle of three cameras, over all triples."""
    beta_most: float
    """The same for all but eps_1 n cameras k of each pair (i, j), angles at i and j."""
    is_on_line: bool
    """Whether any three cameras are."""
    distance_ratio: float
    """c_0 of the theorem for any d: least distance over the greatest, over all pairs of cameras."""
    distance_bound: float
    """c_0 of the theorem in three dimensions: greatest distance over the mean length of the graph's pairs."""
    spread: float
    """c_1, the well-distributedness along the graph."""

    @property
    def granted(self) -> float:
        """The largest eps that the theorem for any dimension grants; 0 if a condition fails."""
        t = self.typicality
        constants = self.beta * self.distance_ratio * self.spread**2 * t.p_high**4
        return constants / _ANY_DIMENSION if t.holds else 0.0

    @property
    def granted_in_space(self) -> float:
        """The largest eps_0 that the theorem in three dimensions grants; 0 if a condition fails."""
        t = self.typicality
        constants = self.beta_most * self.spread**2 * t.p_high**4 / self.distance_bound**2
        return constants / _THREE_DIMENSIONS if t.holds and not self.is_on_line else 0.0

    @property
    def feasible(self) -> float:
        """The eps below which L(T0) != 0, so that a scaling of the truth is feasible (either lemma)."""
        t = self.typicality
        reach = max(self.distance_ratio, 1.0 / self.distance_bound) * t.p_high
        return reach / _FEASIBLE if t.holds else 0.0


def recovery_conditions(locations: FloatArray, edges: IntArray) -> RecoveryConditions:
    """Compute the constants of both recovery theorems.

    Args:
        locations: (n, 3) true locations, n >= 3.
        edges: (m, 2) pairs of the graph, each once.

    Raises:
        InputError: if two locations coincide.
    """
    n = len(locations)
    t = locations - locations.mean(axis=0)
    distances = np.linalg.norm(t[:, None, :] - t[None, :, :], axis=2)
    apart = distances[np.triu_indices(n, k=1)]
    if apart.min() == 0.0:
        raise InputError("two locations coincide; the theorems ask for distinct ones")
    typicality = graph_typicality(n, edges)
    bound = float(apart.max() / distances[edges[:, 0], edges[:, 1]].mean())
    exceptions = int(n * min(typicality.p_high, 1.0) / (_EXCEPTIONS * bound))
    sines = np.array([least_sines(t, i) for i in range(n)])
    sines = np.sort(sines[np.triu_indices(n, k=1)], axis=1)
    return RecoveryConditions(
        typicality=typicality,
        beta=float(sines[:, 0].min()),
        beta_most=float(sines[:, exceptions].min()),
        is_on_line=bool(sines[:, 0].min() < _COLLINEAR),
        distance_ratio=float(apart.min() / apart.max()),
        distance_bound=bound,
        spread=well_distributed(t, _adjacency(n, edges)),
    )


def _adjacency(n: int, edges: IntArray) -> BoolArray:
    """Return which cameras (n, n) are joined."""
    adjacency = np.zeros((n, n), dtype=np.bool_)
    adjacency[edges[:, 0], edges[:, 1]] = adjacency[edges[:, 1], edges[:, 0]] = True
    return adjacency


def graph_typicality(n: int, edges: IntArray) -> Typicality:
    """Return for which p a graph of n cameras is p-typical (definition in section 2.1)."""
    adjacency = _adjacency(n, edges).astype(np.int64)
    degrees = adjacency.sum(axis=0)
    shared = (adjacency @ adjacency)[np.triu_indices(n, k=1)]
    return Typicality(
        connected=int(connected_components(n, edges).max()) == 0,
        degrees=(int(degrees.min()), int(degrees.max())),
        codegrees=(int(shared.min()), int(shared.max())),
        p_low=max(degrees.max() / (2.0 * n), float(np.sqrt(shared.max() / (2.0 * n)))),
        p_high=min(2.0 * degrees.min() / n, float(np.sqrt(2.0 * shared.min() / n)), 1.0),
    )


def least_sines(t: FloatArray, i: int) -> FloatArray:
    """Return the lesser sine (j, k) of the angles at i and j of the triangles i, j, k; 1 where two are one.

    The height r of the triangle over the pair gives the sines r / |t_k - t_i| and r / |t_k - t_j|.
    """
    from_i = t - t[i]
    from_j = np.linalg.norm(t[None, :, :] - t[:, None, :], axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        units = from_i / np.linalg.norm(from_i, axis=1, keepdims=True)
        along = from_i @ units.T  # (k, j)
        heights = np.linalg.norm(from_i[:, None, :] - along[:, :, None] * units[None], axis=2).T
        sines = heights / np.maximum(np.linalg.norm(from_i, axis=1), from_j)
    sines[i], sines[:, i] = 1.0, 1.0
    np.fill_diagonal(sines, 1.0)
    return sines


def well_distributed(t: FloatArray, adjacency: BoolArray) -> float:
    """Return c_1: the least well-distributedness of the common neighbors of two cameras.

    Pairs without common neighbors ask for nothing.
    """
    pairs = zip(*np.triu_indices(len(t), k=1), strict=True)
    return min((_spread(t, i, j, adjacency[i] & adjacency[j]) for i, j in pairs), default=1.0)


def _spread(t: FloatArray, i: int, j: int, common: BoolArray) -> float:
    """Return the well-distributedness of the cameras `common` with respect to a pair.

    With phi_k in [0, pi) the angles of the triangles' heights, the sum at the angle h = phi_s is
    sum_k |sin(phi_k - phi_s)|; running sums of sines and cosines over sorted angles give all in one pass.
    """
    offsets = t[common] - t[i]
    if len(offsets) == 0:
        return 1.0
    across = np.linalg.svd((t[j] - t[i])[None])[2][1:]
    heights = offsets @ across.T
    off_line = np.linalg.norm(heights, axis=1) > _COLLINEAR * np.linalg.norm(offsets, axis=1)
    # The complement of a camera on the line is all of the plane: it contributes |h|.
    on_line = int(np.sum(~off_line))
    if on_line == len(offsets):
        return 1.0
    phi = np.sort(np.arctan2(heights[off_line, 1], heights[off_line, 0]) % np.pi)
    sines, cosines = np.sin(phi), np.cos(phi)
    # Of the angles from s on, less those before.
    ahead_sin = sines.sum() - 2.0 * (np.cumsum(sines) - sines)
    ahead_cos = cosines.sum() - 2.0 * (np.cumsum(cosines) - cosines)
    least = max(float(np.min(cosines * ahead_sin - sines * ahead_cos)), 0.0)
    return (least + on_line) / len(offsets)
