"""Reprojection errors and their derivatives, summed into the normal equations: the kernels that see pixels.

For an observation with residual r (2,), Jacobians J_p of its point, J_f of its frame, J_l of its lens and J_s
of its sensor, and the 2 x 2 weight M of the loss (see `adjustment`), a pass over the points writes

    V_p += J_p^T M J_p        b_p += J_p^T w r          for each point
    W_e += J_p^T M J_e                                  for each entry e (a node that sees the point)
    U_i += J_i^T M J_i        b_i += J_i^T w r          for each node
    U_q += J_f^T M J_l, J_f^T M J_s, J_l^T M J_s        for each link of two of its nodes.

A frame's Jacobian by its center is that of the point with the other sign. So its part of W_e is -J_p^T M J_p,
which is also what the point and the center's corner of U_i receive, and little else is left to multiply.

A sensor with center c and rotation R in its rig sees the point at x = R (y - c), y = R_f (X - C_f). A small
turn w in axes of the rig makes R exp(w) of R. With J the derivative of the pixel by x, a row, that by c is
-J R and that by w is R^T (x cross J).

Points are cut into the same chunks whatever the number of threads, and the sums of the chunks are added in
one order: the same bits always.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.layout import SLOTS, Layout, held_of
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.projection import (
    SHIFT,
    differentiate_by_lens,
    look,
    observe,
    turn_to_frame,
    turn_to_world,
)
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.losses import weigh_residual
from sfm_shapefit.laplacian.operators import Workers, even_ranges
from sfm_shapefit.scene.lens import NUM_VALUES

# Parts of the points, each with sums of all nodes of its own: as many of 1, 2, 4, ... as leave each of them
# so many observations, and so many for each node. To make and add sums of a node takes a third of the time of
# an observation, to hand over a chunk that of a hundred.
_MOST_CHUNKS, _OBSERVATIONS, _OBSERVATIONS_OF_A_NODE = 32, 2_000, 16


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
    """(l, 8) what may change of them, see `scene.lens`."""
    sensor_rotations: FloatArray
    """Rotations (c, 3, 3) of sensor_from_rig."""
    sensor_translations: FloatArray
    """Translations (c, 3) of sensor_from_rig."""


@dataclass(slots=True, kw_only=True, eq=False)
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
    """(E, 3, 6) W; none while it is given up for the memory of a factor."""


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
        loss_scale_px: scale of the Cauchy loss; None for squares.
        workers: share the chunks.
        least_curvature: least curvature of the loss along a residual, as a share of its weight. 1 gives
            reweighted squares, a bound of the loss from above; less lets it bend as it does, down to that
            share.
    """
    num_nodes, num_links = layout.num_nodes, len(layout.links)
    points = np.empty((layout.num_points, 6))
    point_gradients = np.empty((layout.num_points, 3))
    entries = np.empty((len(layout.entry_node), 3, SLOTS))
    given = kernel_inputs(layout, values, loss_scale_px)
    structure = (
        layout.lens_of_camera, layout.lens_slots, layout.turns, layout.frame_of_camera, layout.node_of_frame,
        layout.node_of_lens, layout.frame_entry, layout.lens_entry, layout.links_of_camera,
        layout.first_entry, least_curvature, layout.sensor_of_camera, layout.node_of_sensor,
        layout.sensor_bases, layout.sensor_entry,
    )  # fmt: skip
    by_point_sums = (points, point_gradients, entries)

    def job(begin: int, end: int) -> tuple[FloatArray, ...]:
        shapes = (num_nodes, SLOTS, SLOTS), (num_nodes, SLOTS), (num_links, SLOTS, SLOTS)
        sums = tuple(np.zeros(shape) for shape in shapes)
        _linearize(begin, end, given, structure, sums, by_point_sums)
        return sums

    upper, gradients, links = workers.total([partial(job, *chunk) for chunk in chunks_of(layout)])
    return NormalEquations(
        nodes=upper + np.triu(upper, 1).transpose(0, 2, 1),
        node_gradients=gradients,
        links=links,
        points=points,
        point_gradients=point_gradients,
        entries=entries,
    )


def reprojection_residuals(problem: AdjustmentProblem, values: Values) -> FloatArray:
    """Return the residuals (m, 2) in pixels; NaN behind the camera."""
    residuals = np.empty((problem.num_observations, 2))
    held = held_of(problem.lenses)
    views = _views(problem.rig.frame_of_camera, problem.lens_of_camera, held, values)
    _write_residuals(
        problem.points_seen, problem.cameras_seeing, problem.pixels, views, values.points, residuals
    )
    return residuals


def kernel_inputs(layout: Layout, values: Values, loss_scale_px: float | None) -> tuple[Any, ...]:
    """Return what every kernel here reads."""
    views = _views(layout.frame_of_camera, layout.lens_of_camera, layout.held_of_lens, values)
    scale = np.inf if loss_scale_px is None else loss_scale_px**2
    return layout.first_observation, layout.camera, layout.pixels, views, values.points, scale


def _views(
    frame_of_camera: IntArray, lens_of_camera: IntArray, held_of_lens: FloatArray, values: Values
) -> FloatArray:
    """Return what kernels read of each camera, a row of `projection`."""
    turned = values.sensor_rotations @ values.rotations[frame_of_camera]
    return np.concatenate(
        [
            turned.reshape(-1, 9),
            values.centers[frame_of_camera],
            values.sensor_translations,
            values.sensor_rotations.reshape(-1, 9),
            values.lenses[lens_of_camera],
            held_of_lens[lens_of_camera],
        ],
        axis=1,
    )


def chunks_of(layout: Layout, of_a_node: int = _OBSERVATIONS_OF_A_NODE) -> list[tuple[int, int]]:
    """Cut the points into ranges of about equally many observations, some perhaps empty; 1, 2, 4, ...

    Each range has so many observations for every node, as it has sums of all of them.
    """
    least = max(_OBSERVATIONS, of_a_node * layout.num_nodes)
    count = min(_MOST_CHUNKS, 1 << max((len(layout.camera) // least).bit_length() - 1, 0))
    return even_ranges(layout.first_observation, count)


@kernel
def _write_residuals(points_seen: Any, cameras: Any, pixels: Any, views: Any, points: Any, out: Any) -> None:
    """Write the residual of each observation; NaN behind the camera."""
    for k in range(len(out)):
        camera = cameras[k]
        x, y, z = look(views, camera, points, points_seen[k])
        x, y, z = x + views[camera, SHIFT], y + views[camera, SHIFT + 1], z + views[camera, SHIFT + 2]
        ray = (x / z, y / z, 1.0 / z)
        ahead, rx, ry, _, _, _, _, _, _ = observe(views, camera, (x, y, z), ray, pixels, k)
        out[k, 0], out[k, 1] = (rx, ry) if ahead else (np.nan, np.nan)


@kernel
def _linearize(begin: int, end: int, given: Any, structure: Any, sums: Any, by_point_sums: Any) -> None:
    """Add the observations of the points begin..end-1, to nodes in their upper triangles only."""
    first, cameras, pixels, views, points, scale = given
    lens_of_camera, lens_slots, turns, frame_of_camera, node_of_frame, node_of_lens = structure[:6]
    frame_entry, lens_entry, links_of_camera, first_entry, least_curvature = structure[6:11]
    sensor_of_camera, node_of_sensor, sensor_bases, sensor_entry = structure[11:]
    nodes, gradients, links = sums
    blocks, point_gradients, entries = by_point_sums
    by_point, by_values = np.empty((2, 3)), np.zeros((2, NUM_VALUES))
    by_lens, by_sensor, weighted = np.zeros((2, SLOTS)), np.zeros((2, SLOTS)), np.zeros((2, SLOTS))
    for p in range(begin, end):
        entries[first_entry[p] : first_entry[p + 1]] = 0.0
        v00, v01, v02, v11, v12, v22, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(first[p], first[p + 1]):
            camera = cameras[k]
            bx, by, bz = look(views, camera, points, p)
            x, y = bx + views[camera, SHIFT], by + views[camera, SHIFT + 1]
            z = bz + views[camera, SHIFT + 2]
            inverse = 1.0 / z
            point, ray = (x, y, z), (x * inverse, y * inverse, inverse)
            # Derivatives are by the point in axes of the camera, then in those of the world.
            ahead, rx, ry, a0, a1, a2, b0, b1, b2 = observe(views, camera, point, ray, pixels, k)
            if not ahead:
                continue
            w, m00, m01, m11 = weigh_residual(rx, ry, scale, least_curvature)
            p0, p1, p2 = turn_to_world(views, camera, a0, a1, a2)
            q0, q1, q2 = turn_to_world(views, camera, b0, b1, b2)
            wx, wy = w * rx, w * ry
            t0, t1, t2 = p0 * wx + q0 * wy, p1 * wx + q1 * wy, p2 * wx + q2 * wy
            # J_p^T M, and with J_p the block of the point.
            s0, s1, s2 = m00 * p0 + m01 * q0, m00 * p1 + m01 * q1, m00 * p2 + m01 * q2
            r0, r1, r2 = m01 * p0 + m11 * q0, m01 * p1 + m11 * q1, m01 * p2 + m11 * q2
            h00, h01, h02 = s0 * p0 + r0 * q0, s0 * p1 + r0 * q1, s0 * p2 + r0 * q2
            h11, h12, h22 = s1 * p1 + r1 * q1, s1 * p2 + r1 * q2, s2 * p2 + r2 * q2
            v00, v01, v02, v11, v12, v22 = v00 + h00, v01 + h01, v02 + h02, v11 + h11, v12 + h12, v22 + h22
            g0, g1, g2 = g0 + t0, g1 + t1, g2 + t2
            # By the rotation vector, in axes of the camera, then in those of the frame.
            c0, c1, c2 = turn_to_frame(views, camera, by * a2 - bz * a1, bz * a0 - bx * a2, bx * a1 - by * a0)
            d0, d1, d2 = turn_to_frame(views, camera, by * b2 - bz * b1, bz * b0 - bx * b2, bx * b1 - by * b0)
            if not turns:
                c0, c1, c2, d0, d1, d2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            e = frame_entry[k]
            if e >= 0:
                i = node_of_frame[frame_of_camera[camera]]
                # J_p^T M J by the rotation.
                k00, k01, k02 = s0 * c0 + r0 * d0, s0 * c1 + r0 * d1, s0 * c2 + r0 * d2
                k10, k11, k12 = s1 * c0 + r1 * d0, s1 * c1 + r1 * d1, s1 * c2 + r1 * d2
                k20, k21, k22 = s2 * c0 + r2 * d0, s2 * c1 + r2 * d1, s2 * c2 + r2 * d2
                entries[e, 0, 0] -= h00
                entries[e, 0, 1] -= h01
                entries[e, 0, 2] -= h02
                entries[e, 1, 0] -= h01
                entries[e, 1, 1] -= h11
                entries[e, 1, 2] -= h12
                entries[e, 2, 0] -= h02
                entries[e, 2, 1] -= h12
                entries[e, 2, 2] -= h22
                entries[e, 0, 3] += k00
                entries[e, 0, 4] += k01
                entries[e, 0, 5] += k02
                entries[e, 1, 3] += k10
                entries[e, 1, 4] += k11
                entries[e, 1, 5] += k12
                entries[e, 2, 3] += k20
                entries[e, 2, 4] += k21
                entries[e, 2, 5] += k22
                nodes[i, 0, 0] += h00
                nodes[i, 0, 1] += h01
                nodes[i, 0, 2] += h02
                nodes[i, 1, 1] += h11
                nodes[i, 1, 2] += h12
                nodes[i, 2, 2] += h22
                nodes[i, 0, 3] -= k00
                nodes[i, 0, 4] -= k01
                nodes[i, 0, 5] -= k02
                nodes[i, 1, 3] -= k10
                nodes[i, 1, 4] -= k11
                nodes[i, 1, 5] -= k12
                nodes[i, 2, 3] -= k20
                nodes[i, 2, 4] -= k21
                nodes[i, 2, 5] -= k22
                s0, s1, s2 = m00 * c0 + m01 * d0, m00 * c1 + m01 * d1, m00 * c2 + m01 * d2
                r0, r1, r2 = m01 * c0 + m11 * d0, m01 * c1 + m11 * d1, m01 * c2 + m11 * d2
                nodes[i, 3, 3] += s0 * c0 + r0 * d0
                nodes[i, 3, 4] += s0 * c1 + r0 * d1
                nodes[i, 3, 5] += s0 * c2 + r0 * d2
                nodes[i, 4, 4] += s1 * c1 + r1 * d1
                nodes[i, 4, 5] += s1 * c2 + r1 * d2
                nodes[i, 5, 5] += s2 * c2 + r2 * d2
                gradients[i, 0] -= t0
                gradients[i, 1] -= t1
                gradients[i, 2] -= t2
                gradients[i, 3] += c0 * wx + d0 * wy
                gradients[i, 4] += c1 * wx + d1 * wy
                gradients[i, 5] += c2 * wx + d2 * wy
            if lens_entry[k] < 0 and sensor_entry[k] < 0:
                continue
            by_turn = (c0, c1, c2, d0, d1, d2)
            by_point[0, 0], by_point[0, 1], by_point[0, 2] = p0, p1, p2
            by_point[1, 0], by_point[1, 1], by_point[1, 2] = q0, q1, q2
            if lens_entry[k] >= 0:
                lens = lens_of_camera[camera]
                differentiate_by_lens(views, camera, point, ray, lens_slots, lens, by_values, by_lens)
                _multiply(m00, m01, m11, by_lens, weighted)
                _add_node(
                    by_point, by_lens, weighted, wx, wy, node_of_lens[lens], lens_entry[k],
                    nodes, gradients, entries,
                )  # fmt: skip
                _add_link(by_point, by_turn, weighted, links, links_of_camera[0, camera])
            if sensor_entry[k] >= 0:
                sensor = sensor_of_camera[camera]
                c0, c1, c2 = turn_to_frame(views, camera, a0, a1, a2)
                d0, d1, d2 = turn_to_frame(views, camera, b0, b1, b2)
                by_center = (c0, c1, c2, d0, d1, d2)
                c0, c1, c2 = turn_to_frame(views, camera, y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0)
                d0, d1, d2 = turn_to_frame(views, camera, y * b2 - z * b1, z * b0 - x * b2, x * b1 - y * b0)
                _differentiate_by_sensor(by_center, (c0, c1, c2, d0, d1, d2), sensor_bases, sensor, by_sensor)
                _multiply(m00, m01, m11, by_sensor, weighted)
                _add_node(
                    by_point, by_sensor, weighted, wx, wy, node_of_sensor[sensor], sensor_entry[k],
                    nodes, gradients, entries,
                )  # fmt: skip
                _add_link(by_point, by_turn, weighted, links, links_of_camera[1, camera])
                if links_of_camera[2, camera] >= 0:
                    _add_block(by_lens, weighted, links, links_of_camera[2, camera])
        blocks[p, 0], blocks[p, 1], blocks[p, 2] = v00, v01, v02
        blocks[p, 3], blocks[p, 4], blocks[p, 5] = v11, v12, v22
        point_gradients[p, 0], point_gradients[p, 1], point_gradients[p, 2] = g0, g1, g2


@inner_kernel
def _add_node(
    by_point: Any, by_node: Any, weighted: Any, wx: float, wy: float, node: int, e: int,
    nodes: Any, gradients: Any, entries: Any,
) -> None:  # fmt: skip
    """Add an observation to the node and the entry of its lens or sensor; `weighted` is M J."""
    for c in range(SLOTS):
        gradients[node, c] += by_node[0, c] * wx + by_node[1, c] * wy
        for a in range(c + 1):
            nodes[node, a, c] += by_node[0, a] * weighted[0, c] + by_node[1, a] * weighted[1, c]
        for a in range(3):
            entries[e, a, c] += by_point[0, a] * weighted[0, c] + by_point[1, a] * weighted[1, c]


@inner_kernel
def _add_link(by_point: Any, by_turn: Any, weighted: Any, links: Any, link: int) -> None:
    """Add an observation to the link of its frame with its lens or sensor, if that is not -1."""
    c0, c1, c2, d0, d1, d2 = by_turn
    for q in range(SLOTS if link >= 0 else 0):
        x, y = weighted[0, q], weighted[1, q]
        for a in range(3):
            links[link, a, q] -= by_point[0, a] * x + by_point[1, a] * y
        links[link, 3, q] += c0 * x + d0 * y
        links[link, 4, q] += c1 * x + d1 * y
        links[link, 5, q] += c2 * x + d2 * y


@inner_kernel
def _add_block(by_first: Any, weighted: Any, links: Any, link: int) -> None:
    """Add an observation to a link of its lens with its sensor; `weighted` is M J of the sensor."""
    for a in range(SLOTS):
        for c in range(SLOTS):
            links[link, a, c] += by_first[0, a] * weighted[0, c] + by_first[1, a] * weighted[1, c]


@inner_kernel
def _multiply(m00: float, m01: float, m11: float, jacobian: Any, weighted: Any) -> None:
    """Write M J, (2, 6)."""
    for q in range(SLOTS):
        weighted[0, q] = m00 * jacobian[0, q] + m01 * jacobian[1, q]
        weighted[1, q] = m01 * jacobian[0, q] + m11 * jacobian[1, q]


@inner_kernel
def _differentiate_by_sensor(by_center: Any, by_turn: Any, bases: Any, sensor: int, by_sensor: Any) -> None:
    """Write the derivatives of the pixel by the unknowns of a sensor (2, 6), from those in axes of the rig.

    By the center they are still those by the point, of the other sign.
    """
    c0, c1, c2, d0, d1, d2 = by_center
    for q in range(3):
        u, v, w = bases[sensor, 0, q], bases[sensor, 1, q], bases[sensor, 2, q]
        by_sensor[0, q] = -(c0 * u + c1 * v + c2 * w)
        by_sensor[1, q] = -(d0 * u + d1 * v + d2 * w)
    by_sensor[0, 3], by_sensor[0, 4], by_sensor[0, 5] = by_turn[0], by_turn[1], by_turn[2]
    by_sensor[1, 3], by_sensor[1, 4], by_sensor[1, 5] = by_turn[3], by_turn[4], by_turn[5]
