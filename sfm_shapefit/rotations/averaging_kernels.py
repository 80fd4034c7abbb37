"""The passes over pairs and cameras that rotation averaging consists of, on unit quaternions (x, y, z, w).

With R_i = cam_i_from_world and the measured R_ij = cam_j_from_cam_i, the residual of a pair, in world axes,
is

    x = log(R_j^T R_ij R_i),        R_i <- R_i exp(s_i)  changes it to  x - (s_j - s_i)  to first order,

so that one step minimizes sum_e w_e |x_e - (s_j - s_i)|^2: a Laplacian system L s = D^T W x with (D s)_e =
s_j - s_i. Information H of a pair, in axes of camera j, becomes the block R^T H R in world axes, R half
way from R_j to R_ij R_i: so it does not matter which camera of a pair is named first. For
isotropic weights zeros of the gradient D^T W x are exact stationary points, because x is an eigenvector of
the derivative of log with eigenvalue 1; else they are so up to terms of the order |x|.

Weights are those of Geman and McClure's loss, w = 1 / (1 + (r / s)^2)^2.

Source: Govindu, "Lie-algebraic averaging for globally consistent motion estimation", CVPR 2004; Geman,
McClure, "Statistical methods for tomographic image reconstruction", 1987.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.losses import GEMAN_MCCLURE, weighed


@inner_kernel
def _multiply(
    ax: float, ay: float, az: float, aw: float, bx: float, by: float, bz: float, bw: float
) -> tuple[float, float, float, float]:
    """Return the product a b of quaternions, (x, y, z, w)."""
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


@inner_kernel
def _predict(measured: Any, is_second: bool, other: Any) -> tuple[float, float, float, float]:
    """Return what a pair says of one of its cameras by the other: R_ij R_i of j, R_ij^T R_j of i."""
    s = 1.0 if is_second else -1.0
    return _multiply(
        s * measured[0], s * measured[1], s * measured[2], measured[3], other[0], other[1], other[2], other[3]
    )


@inner_kernel
def relative_in_world(measured: Any, at_i: Any, at_j: Any) -> tuple[float, float, float, float]:
    """Return R_j^T R_ij R_i of unit quaternions, (x, y, z, w): the identity if all three agree."""
    px, py, pz, pw = _predict(measured, True, at_i)
    return _multiply(-at_j[0], -at_j[1], -at_j[2], at_j[3], px, py, pz, pw)


@inner_kernel
def fill_matrix(x: float, y: float, z: float, w: float, r: Any) -> None:
    """Fill the rotation matrix r of a unit quaternion."""
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    r[1, 0], r[1, 1], r[1, 2] = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    r[2, 0], r[2, 1], r[2, 2] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)


@inner_kernel
def _world_residual(measured: Any, at_i: Any, at_j: Any, out: Any) -> float:
    """Fill out[:3] with log(R_j^T R_ij R_i) and return its squared length."""
    x, y, z, w = relative_in_world(measured, at_i, at_j)
    sine = np.sqrt(x * x + y * y + z * z)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    angle = 2.0 * np.arctan2(sine, w)
    factor = angle / sine if sine > 1e-150 else 2.0
    out[0], out[1], out[2] = factor * x, factor * y, factor * z
    return float(angle * angle)


@inner_kernel
def _multiply_on_right(q: Any, s0: float, s1: float, s2: float) -> None:
    """Replace the unit quaternion q by q exp(s), of unit length again."""
    half = 0.5 * np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
    factor = 0.5 * (np.sin(half) / half if half > 1e-150 else 1.0)
    x, y, z, w = _multiply(q[0], q[1], q[2], q[3], factor * s0, factor * s1, factor * s2, np.cos(half))
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    q[0], q[1], q[2], q[3] = x / norm, y / norm, z / norm, w / norm


@kernel
def reweigh_pairs(
    begin: int, end: int, pairs: Any, measured: Any, turns: Any, weights: Any, scale: float, robust: Any,
    pulls: Any,
) -> None:  # fmt: skip
    """Fill robust weights W (k,), weights / (1 + (|x| / scale)^2)^2, and W x (k, 3), from begin to end."""
    for e in range(begin, end):
        square = _world_residual(measured[e], turns[pairs[e, 0]], turns[pairs[e, 1]], pulls[e])
        w = weighed(GEMAN_MCCLURE, weights[e], square / (scale * scale))
        robust[e] = w
        for c in range(3):
            pulls[e, c] *= w


@kernel
def add_at_ends(pairs: Any, rows: Any, sign: float, at_first: Any, at_second: Any) -> None:
    """Add rows (k, d) to sums (n, d) at their second cameras, and `sign` times them at their first ones."""
    for e in range(len(pairs)):
        i, j = pairs[e, 0], pairs[e, 1]
        for c in range(rows.shape[1]):
            at_first[i, c] += sign * rows[e, c]
            at_second[j, c] += rows[e, c]


@kernel
def residual_squares(begin: int, end: int, pairs: Any, measured: Any, turns: Any, squares: Any) -> None:
    """Fill the squared residual angles of the pairs begin..end-1; NaN where a camera has no rotation."""
    x = np.empty(3)
    for e in range(begin, end):
        squares[e] = _world_residual(measured[e], turns[pairs[e, 0]], turns[pairs[e, 1]], x)


@inner_kernel
def _turn_information(h: Any, q: Any, r: Any, hr: Any, block: Any) -> None:
    """Fill the block R^T H R with R of the unit quaternion q; r and hr are scratch (3, 3)."""
    fill_matrix(q[0], q[1], q[2], q[3], r)
    for a in range(3):
        for b in range(3):
            hr[a, b] = h[a, 0] * r[0, b] + h[a, 1] * r[1, b] + h[a, 2] * r[2, b]
    for a in range(3):
        for b in range(a + 1):
            value = r[0, a] * hr[0, b] + r[1, a] * hr[1, b] + r[2, a] * hr[2, b]
            block[a, b] = value
            block[b, a] = value


@kernel
def weigh_blocks(
    begin: int, end: int, pairs: Any, measured: Any, turns: Any, information: Any, limit: float, scale: float,
    distances: Any, blocks: Any, pulls: Any,
) -> None:  # fmt: skip
    """Fill Mahalanobis lengths (k,), robust blocks B = w R_j^T H R_j (k, 3, 3), and B x (k, 3).

    They are those of the pairs begin..end-1. A pair whose residual angle is beyond `limit`, in radians, has
    the length NaN and the block 0.
    """
    x, r, hr, hx, half = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(4)
    for e in range(begin, end):
        i, j = pairs[e, 0], pairs[e, 1]
        square = _world_residual(measured[e], turns[i], turns[j], x)
        block = blocks[e]
        if square > limit * limit:
            distances[e] = np.nan
            block[:] = 0.0
            pulls[e] = 0.0
            continue
        for a in range(4):
            half[a] = turns[j, a]
        _multiply_on_right(half, 0.5 * x[0], 0.5 * x[1], 0.5 * x[2])
        _turn_information(information[e], half, r, hr, block)
        length = 0.0
        for a in range(3):
            hx[a] = block[a, 0] * x[0] + block[a, 1] * x[1] + block[a, 2] * x[2]
            length += x[a] * hx[a]
        length = np.sqrt(max(length, 0.0))
        distances[e] = length
        loss = 1.0 + (length / scale) * (length / scale)
        w = 1.0 / (loss * loss)
        for a in range(3):
            pulls[e, a] = w * hx[a]
            for b in range(3):
                block[a, b] *= w


@kernel
def turn_cameras(turns: Any, steps: Any, limit: float) -> float:
    """Replace R_i by R_i exp(s_i), steps (n, 3) of limited length; return the longest one."""
    longest = 0.0
    for i in range(len(turns)):
        s0, s1, s2 = steps[i, 0], steps[i, 1], steps[i, 2]
        length = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        longest = max(longest, length)
        if length > limit:
            s0, s1, s2 = s0 * (limit / length), s1 * (limit / length), s2 * (limit / length)
        _multiply_on_right(turns[i], s0, s1, s2)
    return longest


@kernel
def follow_tree(order: Any, parents: Any, links: Any, pairs: Any, measured: Any, turns: Any) -> None:
    """Fill the rotations that the links of a tree give: R_j = R_ij R_i, or R_i = R_ij^T R_j.

    Args:
        order: (t,) cameras, parents before children; a root has parent -1, and its rotation is given.
        parents: (n,) parent of each camera.
        links: (n,) the pair that joins a camera with its parent.
        pairs, measured: (k, 2), (k, 4)
        turns: (n, 4) in place.
    """
    for k in range(len(order)):
        i = order[k]
        if parents[i] < 0:
            continue
        e, out = links[i], turns[i]
        x, y, z, w = _predict(measured[e], pairs[e, 1] == i, turns[parents[i]])
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        out[0], out[1], out[2], out[3] = x / norm, y / norm, z / norm, w / norm


@kernel
def move_to_modes(
    pointers: Any, neighbors: Any, edge_of: Any, pairs: Any, measured: Any, turns: Any, weights: Any,
    scale: float, margin: float,
) -> int:  # fmt: skip
    """Move each camera to what most of its pairs predict, one after the other; return how many moved.

    A pair (i, j) predicts R_ij R_i for camera j. A rotation's votes are the sum of weights / (1 + (angle /
    scale)^2)^2 over the predictions. A camera whose rotation has less than half of all its weights moves to
    the prediction of most votes, if these exceed its own by the margin.
    """
    n, moved, most = len(turns), 0, 0
    for c in range(n):
        most = max(most, pointers[c + 1] - pointers[c])
    predicted, weight = np.empty((most, 4)), np.empty(most)
    for c in range(n):
        count, total, own = pointers[c + 1] - pointers[c], 0.0, 0.0
        for k in range(count):
            p = pointers[c] + k
            e, other = edge_of[p], neighbors[p]
            x, y, z, w = _predict(measured[e], pairs[e, 1] == c, turns[other])
            predicted[k, 0], predicted[k, 1], predicted[k, 2], predicted[k, 3] = x, y, z, w
            weight[k] = weights[e]
            total += weights[e]
            own += weights[e] * _closeness(predicted[k], turns[c], scale)
        if own >= 0.5 * total:
            continue
        best, best_votes = -1, own * (1.0 + margin)
        for k in range(count):
            votes = 0.0
            for other in range(count):
                votes += weight[other] * _closeness(predicted[k], predicted[other], scale)
            if votes > best_votes:
                best, best_votes = k, votes
        if best >= 0:
            moved += 1
            norm = np.sqrt(
                predicted[best, 0] ** 2 + predicted[best, 1] ** 2
                + predicted[best, 2] ** 2 + predicted[best, 3] ** 2
            )  # fmt: skip
            for a in range(4):
                turns[c, a] = predicted[best, a] / norm
    return moved


@inner_kernel
def _closeness(a: Any, b: Any, scale: float) -> float:
    """Return 1 / (1 + (angle / scale)^2)^2 of two unit quaternions, with 4 sin(angle / 4) for the angle."""
    cosine = abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3])
    return float(weighed(GEMAN_MCCLURE, 1.0, 8.0 * max(1.0 - cosine, 0.0) / (scale * scale)))


@kernel
def close_triangles(
    begin: int, end: int, pointers: Any, neighbors: Any, edge_of: Any, pairs: Any, measured: Any,
    weights: Any, scale: float, closing: Any, all_votes: Any,
) -> None:  # fmt: skip
    """Fill the votes of the triangles that close, and of all of them, for the pairs begin..end-1.

    Neighbors ascend within each row. A triangle (i, j, k) has, for the pair (i, j), as many votes as the
    weaker of its other two pairs; it closes by 1 / (1 + (angle / scale)^2)^2 of R_ij^T R_kj R_ik.
    """
    around = np.empty(4)
    for e in range(begin, end):
        i, j = pairs[e, 0], pairs[e, 1]
        a, b = pointers[i], pointers[j]
        closed, total = 0.0, 0.0
        while a < pointers[i + 1] and b < pointers[j + 1]:
            if neighbors[a] < neighbors[b]:
                a += 1
            elif neighbors[a] > neighbors[b]:
                b += 1
            else:
                first, second = edge_of[a], edge_of[b]
                p, q = measured[first], measured[second]  # from i to the third, and from it to j
                s = 1.0 if pairs[first, 0] == i else -1.0
                t = 1.0 if pairs[second, 1] == j else -1.0
                x, y, z, w = _multiply(t * q[0], t * q[1], t * q[2], q[3], s * p[0], s * p[1], s * p[2], p[3])
                around[0], around[1], around[2], around[3] = x, y, z, w
                votes = min(weights[first], weights[second])
                total += votes
                closed += votes * _closeness(around, measured[e], scale)
                a += 1
                b += 1
        closing[e], all_votes[e] = closed, total
