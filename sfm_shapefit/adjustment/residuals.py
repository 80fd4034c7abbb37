"""Reprojection errors and their derivatives, summed into the normal equations: the kernels that see pixels.

For an observation with residual r (2,), Jacobians J_p of its point, J_f of its frame and J_l of its lens, and
the 2 x 2 weight M of the loss (see `adjustment`), a pass over the points writes

    V_p += J_p^T M J_p        b_p += J_p^T w r          for each point
    W_e += J_p^T M J_e                                  for each entry e (a node that sees the point)
    U_i += J_i^T M J_i        b_i += J_i^T w r          for each node
    U_q += J_f^T M J_l                                  for each link of a frame with a lens.

Points are cut into the same chunks whatever the number of threads, and the sums of the chunks are added in
order: the same bits always.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.layout import SLOTS, Layout
from sfm_shapefit.adjustment.problem import NUM_VALUES
from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.jit import inner_kernel, kernel
from sfm_shapefit.laplacian.operators import Workers

CHUNKS = 4
"""Into which the points are cut; each has sums of all nodes of its own."""

_LEAST_DEPTH = 1e-8  # of the distance from the camera: less is behind it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Values:
    """The numbers that an adjustment changes."""

    rotations: FloatArray
    """(n, 3, 3)"""
    centers: FloatArray
    """(n, 3)"""
    points: FloatArray
    """(k, 3)"""
    lenses: FloatArray
    """(l, 8) as OPENCV models."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NormalEquations:
    """The system before the points are eliminated, without damping; gradients, not right-hand sides."""

    nodes: FloatArray
    """(N, 6, 6) U"""
    node_gradients: FloatArray
    """(N, 6)"""
    links: FloatArray
    """(q, 6, 6)"""
    points: FloatArray
    """(k, 6) V: entries 00, 01, 02, 11, 12, 22."""
    point_gradients: FloatArray
    """(k, 3)"""
    entries: FloatArray
    """(E, 3, 6) W"""


def linearize(
    layout: Layout,
    values: Values,
    loss_scale_px: float | None,
    workers: Workers,
    least_curvature: float = 1.0,
) -> NormalEquations:
    """Return the normal equations of all observations at the given values.

    Args:
        layout, values: what is adjusted, and where.
        loss_scale_px: of the Cauchy loss; None for squares.
        workers: share the chunks.
        least_curvature: of the loss along a residual, as a share of its weight. 1 gives reweighted squares,
            a bound of the loss from above; less lets it bend as it does, down to that share.
    """
    num_nodes, num_links = layout.num_nodes, len(layout.links)
    nodes = np.zeros((CHUNKS, num_nodes, SLOTS, SLOTS))
    gradients = np.zeros((CHUNKS, num_nodes, SLOTS))
    links = np.zeros((CHUNKS, num_links, SLOTS, SLOTS))
    points = np.empty((layout.num_points, 6))
    point_gradients = np.empty((layout.num_points, 3))
    entries = np.empty((len(layout.entry_node), 3, SLOTS))
    given = _inputs(layout, values, loss_scale_px)
    structure = (
        layout.lens_slots, layout.turns, layout.node_of_frame, layout.node_of_lens, layout.frame_entry,
        layout.lens_entry, layout.link_of_camera, layout.first_entry, least_curvature,
    )  # fmt: skip
    by_point_sums = (points, point_gradients, entries)

    def job(k: int, begin: int, end: int) -> Callable[[], None]:
        sums = (nodes[k], gradients[k], links[k])
        return lambda: _linearise(begin, end, given, structure, sums, by_point_sums)

    workers.run([job(k, *chunk) for k, chunk in enumerate(_chunks(layout))])
    return NormalEquations(
        nodes=nodes.sum(axis=0),
        node_gradients=gradients.sum(axis=0),
        links=links.sum(axis=0),
        points=points,
        point_gradients=point_gradients,
        entries=entries,
    )


def sum_losses(layout: Layout, values: Values, loss_scale_px: float | None, workers: Workers) -> float:
    """Return the cost of all observations, 1/2 sum rho(|r|^2), in px^2."""
    given = _inputs(layout, values, loss_scale_px)
    sums = np.zeros(CHUNKS)

    def job(k: int, begin: int, end: int) -> Callable[[], None]:
        return lambda: _sum_losses(begin, end, given, sums[k : k + 1])

    workers.run([job(k, *chunk) for k, chunk in enumerate(_chunks(layout))])
    return float(sums.sum())


def reprojection_residuals(layout: Layout, values: Values) -> FloatArray:
    """Return the residuals (m, 2) in pixels, in the problem's order; NaN behind the camera."""
    residuals = np.empty((len(layout.camera), 2))
    _write_residuals(_inputs(layout, values, None), residuals)
    ordered = np.empty_like(residuals)
    ordered[layout.observation] = residuals
    return ordered


def _inputs(layout: Layout, values: Values, loss_scale_px: float | None) -> tuple[Any, ...]:
    """Return what every kernel here reads."""
    return (
        layout.first_observation, layout.camera, layout.pixels, layout.frame_of_camera, layout.lens_of_camera,
        layout.sensor_rotations, layout.sensor_translations, values.rotations, values.centers, values.points,
        values.lenses, np.inf if loss_scale_px is None else loss_scale_px**2,
    )  # fmt: skip


def _chunks(layout: Layout) -> list[tuple[int, int]]:
    """Cut the points into ranges of about equally many observations, some perhaps empty."""
    wanted = np.arange(1, CHUNKS) * (len(layout.camera) / CHUNKS)
    cuts = np.searchsorted(layout.first_observation, wanted).tolist()
    return list(zip([0, *cuts], [*cuts, layout.num_points], strict=True))


@inner_kernel
def _look(
    rotation: Any,
    center: Any,
    sensor_rotation: Any,
    sensor_translation: Any,
    point: Any,
    body: Any,
    seen: Any,
) -> bool:
    """Write the point in axes of the frame and of the camera; return whether it is in front."""
    x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    for a in range(3):
        body[a] = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z
    x, y, z = body[0], body[1], body[2]
    for a in range(3):
        turned = sensor_rotation[a, 0] * x + sensor_rotation[a, 1] * y + sensor_rotation[a, 2] * z
        seen[a] = turned + sensor_translation[a]
    distance = np.sqrt(seen[0] ** 2 + seen[1] ** 2 + seen[2] ** 2)
    return bool(seen[2] > _LEAST_DEPTH * distance)


@inner_kernel
def _miss(seen: Any, lens: Any, observed: Any, residual: Any) -> None:
    """Write the pixel of a point in front of the camera, less the observed one."""
    u, v = seen[0] / seen[2], seen[1] / seen[2]
    s = u * u + v * v
    radial = 1.0 + s * (lens[4] + s * lens[5])
    p1, p2 = lens[6], lens[7]
    x = lens[0] * (u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)) + lens[2]
    y = lens[1] * (v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)) + lens[3]
    residual[0], residual[1] = x - observed[0], y - observed[1]


@inner_kernel
def _differentiate(
    seen: Any, body: Any, lens: Any, rotation: Any, sensor: Any, turns: bool, by_point: Any, by_frame: Any
) -> None:
    """Write the derivatives of the pixel by the point (2, 3) and by its frame (2, 6)."""
    inverse = 1.0 / seen[2]
    u, v = seen[0] * inverse, seen[1] * inverse
    s = u * u + v * v
    radial = 1.0 + s * (lens[4] + s * lens[5])
    slope = 2.0 * (lens[4] + 2.0 * s * lens[5])  # of the radial factor, by s, times 2
    p1, p2 = lens[6], lens[7]
    mixed = slope * u * v + 2.0 * (p1 * u + p2 * v)
    for row in range(2):
        # by u and v, then by the point in axes of the camera, then in those of the frame
        if row == 0:
            by_u, by_v = lens[0] * (radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u), lens[0] * mixed
        else:
            by_u, by_v = lens[1] * mixed, lens[1] * (radial + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v)
        x, y, z = by_u * inverse, by_v * inverse, -(by_u * u + by_v * v) * inverse
        g0 = x * sensor[0, 0] + y * sensor[1, 0] + z * sensor[2, 0]
        g1 = x * sensor[0, 1] + y * sensor[1, 1] + z * sensor[2, 1]
        g2 = x * sensor[0, 2] + y * sensor[1, 2] + z * sensor[2, 2]
        for a in range(3):
            by_point[row, a] = g0 * rotation[0, a] + g1 * rotation[1, a] + g2 * rotation[2, a]
            by_frame[row, a] = -by_point[row, a]
        if turns:
            by_frame[row, 3] = body[1] * g2 - body[2] * g1
            by_frame[row, 4] = body[2] * g0 - body[0] * g2
            by_frame[row, 5] = body[0] * g1 - body[1] * g0


@inner_kernel
def _differentiate_by_lens(seen: Any, lens: Any, slots: Any, by_values: Any, by_lens: Any) -> None:
    """Write the derivatives of the pixel by the unknowns of a lens (2, 6).

    Each of these is the sum over the OPENCV parameters that it stands for, see `by_values` (2, 8).
    """
    inverse = 1.0 / seen[2]
    u, v = seen[0] * inverse, seen[1] * inverse
    s = u * u + v * v
    radial = 1.0 + s * (lens[4] + s * lens[5])
    p1, p2 = lens[6], lens[7]
    by_values[0, 0] = u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
    by_values[1, 1] = v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)
    by_values[0, 4], by_values[1, 4] = lens[0] * u * s, lens[1] * v * s
    by_values[0, 5], by_values[1, 5] = lens[0] * u * s * s, lens[1] * v * s * s
    by_values[0, 6], by_values[1, 6] = lens[0] * 2.0 * u * v, lens[1] * (s + 2.0 * v * v)
    by_values[0, 7], by_values[1, 7] = lens[0] * (s + 2.0 * u * u), lens[1] * 2.0 * u * v
    by_lens[:] = 0.0
    for q in range(NUM_VALUES):
        if slots[q] >= 0:
            by_lens[0, slots[q]] += by_values[0, q]
            by_lens[1, slots[q]] += by_values[1, q]


@kernel
def _sum_losses(begin: int, end: int, given: Any, total: Any) -> None:
    """Add 1/2 rho(|r|^2) of the points begin..end-1; behind its camera, one misses by the focal length."""
    first, cameras, pixels, frame_of_camera, lens_of_camera = given[:5]
    sensor_rotations, sensor_translations, rotations, centers, points, lenses, scale = given[5:]
    body, seen, residual = np.empty(3), np.empty(3), np.empty(2)
    plain = scale == np.inf
    for p in range(begin, end):
        for k in range(first[p], first[p + 1]):
            camera = cameras[k]
            frame, lens = frame_of_camera[camera], lenses[lens_of_camera[camera]]
            sensor, shift = sensor_rotations[camera], sensor_translations[camera]
            square = lens[0] * lens[0]
            if _look(rotations[frame], centers[frame], sensor, shift, points[p], body, seen):
                _miss(seen, lens, pixels[k], residual)
                square = residual[0] * residual[0] + residual[1] * residual[1]
            total[0] += 0.5 * square if plain else 0.5 * scale * np.log1p(square / scale)


@kernel
def _write_residuals(given: Any, out: Any) -> None:
    """Write the residuals in the order of the points; NaN behind the camera."""
    first, cameras, pixels, frame_of_camera, lens_of_camera = given[:5]
    sensor_rotations, sensor_translations, rotations, centers, points, lenses, _ = given[5:]
    body, seen = np.empty(3), np.empty(3)
    for p in range(len(first) - 1):
        for k in range(first[p], first[p + 1]):
            out[k] = np.nan
            camera = cameras[k]
            frame, lens = frame_of_camera[camera], lenses[lens_of_camera[camera]]
            sensor, shift = sensor_rotations[camera], sensor_translations[camera]
            if _look(rotations[frame], centers[frame], sensor, shift, points[p], body, seen):
                _miss(seen, lens, pixels[k], out[k])


@kernel
def _linearise(begin: int, end: int, given: Any, structure: Any, sums: Any, by_point_sums: Any) -> None:
    """Add the observations of the points begin..end-1 to the normal equations."""
    first, cameras, pixels, frame_of_camera, lens_of_camera = given[:5]
    sensor_rotations, sensor_translations, rotations, centers, points, lenses, scale = given[5:]
    lens_slots, turns, node_of_frame, node_of_lens, frame_entry, lens_entry = structure[:6]
    link_of_camera, first_entry, least_curvature = structure[6:]
    nodes, gradients, links = sums
    blocks, point_gradients, entries = by_point_sums
    body, seen, residual = np.empty(3), np.empty(3), np.empty(2)
    by_point, by_values = np.empty((2, 3)), np.zeros((2, NUM_VALUES))
    by_frame, by_lens, weighted = np.zeros((2, SLOTS)), np.zeros((2, SLOTS)), np.empty((2, SLOTS))
    for p in range(begin, end):
        blocks[p] = 0.0
        point_gradients[p] = 0.0
        entries[first_entry[p] : first_entry[p + 1]] = 0.0
        for k in range(first[p], first[p + 1]):
            camera = cameras[k]
            frame, lens = frame_of_camera[camera], lens_of_camera[camera]
            rotation, sensor, shift = rotations[frame], sensor_rotations[camera], sensor_translations[camera]
            if not _look(rotation, centers[frame], sensor, shift, points[p], body, seen):
                continue
            _miss(seen, lenses[lens], pixels[k], residual)
            _differentiate(seen, body, lenses[lens], rotation, sensor, turns, by_point, by_frame)
            weights = _weigh(residual, scale, least_curvature)
            _add_point(by_point, weights, residual, blocks[p], point_gradients[p])
            if frame_entry[k] >= 0:
                node = node_of_frame[frame]
                entry = entries[frame_entry[k]]
                _add_node(
                    by_frame, by_point, weights, residual, weighted, nodes[node], gradients[node], entry
                )
            if lens_entry[k] >= 0:
                node = node_of_lens[lens]
                entry = entries[lens_entry[k]]
                _differentiate_by_lens(seen, lenses[lens], lens_slots[lens], by_values, by_lens)
                _add_node(by_lens, by_point, weights, residual, weighted, nodes[node], gradients[node], entry)
                if link_of_camera[camera] >= 0:
                    link = links[link_of_camera[camera]]
                    for a in range(SLOTS):
                        for c in range(SLOTS):
                            link[a, c] += by_frame[0, a] * weighted[0, c] + by_frame[1, a] * weighted[1, c]


@inner_kernel
def _weigh(residual: Any, scale: float, least: float) -> tuple[float, float, float, float]:
    """Return the weight of a residual in the gradient, and its 2 x 2 weight in the curvature.

    The curvature along the residual is at least the share `least` of that across it.
    """
    if scale == np.inf:
        return 1.0, 1.0, 0.0, 1.0
    x, y = residual[0], residual[1]
    square = x * x + y * y
    w = 1.0 / (1.0 + square / scale)
    bend = min(2.0 * w / scale, (1.0 - least) / max(square, 1e-300))
    return w, w * (1.0 - bend * x * x), -w * bend * x * y, w * (1.0 - bend * y * y)


@inner_kernel
def _add_point(by_point: Any, weights: Any, residual: Any, block: Any, gradient: Any) -> None:
    """Add J^T M J, packed, and J^T w r to a point."""
    w, m00, m01, m11 = weights
    at = 0
    for a in range(3):
        x, y = by_point[0, a], by_point[1, a]
        gradient[a] += w * (x * residual[0] + y * residual[1])
        mx, my = m00 * x + m01 * y, m01 * x + m11 * y
        for c in range(a, 3):
            block[at] += mx * by_point[0, c] + my * by_point[1, c]
            at += 1


@inner_kernel
def _add_node(
    by_node: Any,
    by_point: Any,
    weights: Any,
    residual: Any,
    weighted: Any,
    block: Any,
    gradient: Any,
    entry: Any,
) -> None:
    """Add J^T M J and J^T w r to a node and J_p^T M J to its entry; leave M J in `weighted`."""
    w, m00, m01, m11 = weights
    for c in range(SLOTS):
        x, y = by_node[0, c], by_node[1, c]
        gradient[c] += w * (x * residual[0] + y * residual[1])
        weighted[0, c] = m00 * x + m01 * y
        weighted[1, c] = m01 * x + m11 * y
    for a in range(SLOTS):
        x, y = by_node[0, a], by_node[1, a]
        for c in range(SLOTS):
            block[a, c] += x * weighted[0, c] + y * weighted[1, c]
    for a in range(3):
        x, y = by_point[0, a], by_point[1, a]
        for c in range(SLOTS):
            entry[a, c] += x * weighted[0, c] + y * weighted[1, c]
