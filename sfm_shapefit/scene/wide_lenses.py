"""Pixels of rays through lenses that are no case of OPENCV, their derivatives, and rays of pixels.

A ray (x, y, z) of any length is first brought to a plane, (u, v) = g (x, y), where g depends on
rho = x^2 + y^2 and z alone, and then distorted there:

kind        g                                                       distorted by
RATIONAL    1 / z                                                   (1 + k1 s + ..) / (1 + k4 s + ..), p1, p2
ANGLE       atan2(rho^1/2, z) / rho^1/2                             1 + k1 s + k2 s^2 + k3 s^3 + k4 s^4
THIN_PRISM  the same                                                the same, p1, p2, sx s, sy s
RAD_TAN     the same                                                1 + k0 s + .. + k5 s^6; of what that makes
                                                                    p0, p1, and s0 s + s1 s^2, s2 s + s3 s^2
FOV         atan2(rho^1/2, z / t) / (w rho^1/2), t = 2 tan(w / 2)   nothing
DIVISION    2 / (z + (z^2 - 4 k rho)^1/2)                           nothing
EUCM        1 / (a (b rho + z^2)^1/2 + (1 - a) z)                   nothing

with s = u^2 + v^2. A lens is a row of numbers: fx, fy, cx, cy, coefficients in COLMAP's order (12), kind.
Formulas are those of COLMAP's models; where these end at right angles to the camera, ANGLE, THIN_PRISM,
RAD_TAN, DIVISION and EUCM go on behind it.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.jit import inner_kernel, kernel

PLANE, RATIONAL, ANGLE, THIN_PRISM, RAD_TAN, FOV, DIVISION, EUCM = range(8)
"""Kinds of projections; PLANE is that of OPENCV."""
KIND, ROW = 16, 17  # place of the kind in a lens' row, and its length; no model has more parameters

_LEAST = 1e-8  # share of a ray's length; what is nearer to where a projection ends is not seen
_NEAR_AXIS = 1e-8  # rho over z^2; below, an angle is the first terms of its series, whose next is rounding
_LEAST_FOV = 1e-6  # radians; a FOV lens of less is a plane to rounding
# Newton steps to a ray, and their lengths in radians; 0.3 leaps over no fold of a lens in use.
_MOST_STEPS, _LONGEST_RAD, _STILL_RAD = 50, 0.3, 1e-13
_FIRST_RAD = 1.4  # radians; a first try farther from the axis would find models that end at 1.57 undefined


@kernel
def is_seen(lens: Any, x: float, y: float, z: float) -> bool:
    """Return whether a lens has a pixel for a ray."""
    kind, rho = lens[KIND], x * x + y * y
    square = rho + z * z
    if kind in (RATIONAL, FOV):
        return bool(z > 0.0 and z * z > _LEAST * _LEAST * square)
    if kind == DIVISION:
        inside = z * z - 4.0 * lens[4] * rho
        if not inside > _LEAST * _LEAST * square:
            return False
        return bool(z + np.sqrt(inside) > _LEAST * np.sqrt(square))
    if kind == EUCM:
        a, inside = lens[4], lens[5] * rho + z * z
        if not inside > 0.0:
            return False
        d = np.sqrt(inside)
        # For a > 1/2, rays farther behind have the pixels of others.
        return bool(a * d + (1.0 - a) * z > _LEAST * np.sqrt(square) and (a <= 0.5 or a * z > (a - 1.0) * d))
    return bool(z > 0.0 or rho > _LEAST * _LEAST * square)


@kernel
def see(lens: Any, x: float, y: float, z: float) -> tuple[float, ...]:
    """Return the pixel of a ray that is seen, then the derivatives by the ray: of its x, then of its y."""
    f, h = lens[0], lens[1]
    g, by_rho, by_z, _, _ = _flatten(lens, x * x + y * y, z)
    u, v = g * x, g * y
    u_by_x, u_by_y, v_by_y = g + 2.0 * by_rho * x * x, 2.0 * by_rho * x * y, g + 2.0 * by_rho * y * y
    a, b, a_by_u, a_by_v, b_by_u, b_by_v = _distort(lens, u, v)
    return (
        f * a + lens[2],
        h * b + lens[3],
        f * (a_by_u * u_by_x + a_by_v * u_by_y),
        f * (a_by_u * u_by_y + a_by_v * v_by_y),
        f * (a_by_u * x + a_by_v * y) * by_z,
        h * (b_by_u * u_by_x + b_by_v * u_by_y),
        h * (b_by_u * u_by_y + b_by_v * v_by_y),
        h * (b_by_u * x + b_by_v * y) * by_z,
    )


@kernel
def differentiate_by_values(lens: Any, x: float, y: float, z: float, out: Any) -> None:
    """Write the derivatives of a pixel by the first eight numbers of its lens' row (2, 8)."""
    kind, f, h = lens[KIND], lens[0], lens[1]
    g, _, _, by_first, by_second = _flatten(lens, x * x + y * y, z)
    u, v = g * x, g * y
    a, b, _, _, _, _ = _distort(lens, u, v)
    out[0, 0], out[1, 1], out[0, 2], out[1, 3] = a, b, 1.0, 1.0
    if kind in (FOV, DIVISION, EUCM):
        out[0, 4], out[1, 4], out[0, 5], out[1, 5] = f * x * by_first, h * y * by_first, 0.0, 0.0
        if kind == EUCM:
            out[0, 5], out[1, 5] = f * x * by_second, h * y * by_second
        return
    s = u * u + v * v
    power = s
    if kind == RATIONAL:
        power /= 1.0 + s * (lens[9] + s * (lens[10] + s * lens[11]))
    uu, uv, vu, vv = 1.0, 0.0, 0.0, 1.0
    if kind == RAD_TAN:
        radial, _ = _stretch(lens, s)
        uu, uv, vu, vv = _slopes_of_shift(lens, radial * u, radial * v)
        uu, vv = 1.0 + uu, 1.0 + vv
    for q in range(4, 8):
        out[0, q], out[1, q] = f * power * (uu * u + uv * v), h * power * (vu * u + vv * v)
        power *= s
    if kind in (RATIONAL, THIN_PRISM):
        out[0, 6], out[1, 6] = f * 2.0 * u * v, h * (s + 2.0 * v * v)
        out[0, 7], out[1, 7] = f * (s + 2.0 * u * u), h * 2.0 * u * v


@kernel
def write_rays(lens: Any, pixels: Any, rays: Any) -> None:
    """Write the unit rays (m, 3) of pixels (m, 2), by Newton's method; NaN where it fails.

    A ray is sought from one as far from the axis as the pixel asks for, and then from the axis itself, where
    short steps do not leap over an angle at which the picture is folded.
    """
    for k in range(len(pixels)):
        u, v = (pixels[k, 0] - lens[2]) / lens[0], (pixels[k, 1] - lens[3]) / lens[1]
        radius = np.sqrt(u * u + v * v)
        angle = min(radius, _FIRST_RAD)
        share = np.sin(angle) / radius if radius > 0.0 else 1.0
        rays[k, 0], rays[k, 1], rays[k, 2] = share * u, share * v, np.cos(angle)
        if _seek(lens, pixels[k], rays[k]):
            continue
        rays[k, 0], rays[k, 1], rays[k, 2] = 0.0, 0.0, 1.0
        if not _seek(lens, pixels[k], rays[k]):
            rays[k, 0] = rays[k, 1] = rays[k, 2] = np.nan


@inner_kernel
def _seek(lens: Any, pixel: Any, ray: Any) -> bool:
    """Move a unit ray to that of a pixel; return whether it is, and the picture is not folded there."""
    for _ in range(_MOST_STEPS):
        x, y, z = ray[0], ray[1], ray[2]
        if not is_seen(lens, x, y, z):
            return False
        a, b, a0, a1, a2, b0, b1, b2 = see(lens, x, y, z)
        # The shortest step to the pixel: it is across the ray, along which no pixel changes.
        aa, ab, bb = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
        off_a, off_b, determinant = pixel[0] - a, pixel[1] - b, aa * bb - ab * ab
        by_a, by_b = (bb * off_a - ab * off_b) / determinant, (aa * off_b - ab * off_a) / determinant
        d0, d1, d2 = a0 * by_a + b0 * by_b, a1 * by_a + b1 * by_b, a2 * by_a + b2 * by_b
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        share = min(1.0, _LONGEST_RAD / length) if length > 0.0 else 1.0
        x, y, z = x + share * d0, y + share * d1, z + share * d2
        norm = np.sqrt(x * x + y * y + z * z)
        ray[0], ray[1], ray[2] = x / norm, y / norm, z / norm
        if not length > _STILL_RAD:  # NaN ends it too
            upright = x * (a1 * b2 - a2 * b1) + y * (a2 * b0 - a0 * b2) + z * (a0 * b1 - a1 * b0)
            return bool(upright > 0.0)
    return False


@inner_kernel
def _flatten(lens: Any, rho: float, z: float) -> tuple[float, float, float, float, float]:
    """Return g and its derivatives by rho, z and the first two coefficients, as far as it has these."""
    kind = lens[KIND]
    if kind == DIVISION:
        root = np.sqrt(z * z - 4.0 * lens[4] * rho)
        g = 2.0 / (z + root)
        return g, g * g * lens[4] / root, -0.5 * g * g * (1.0 + z / root), g * g * rho / root, 0.0
    if kind == EUCM:
        a, b = lens[4], lens[5]
        d = np.sqrt(b * rho + z * z)
        g = 1.0 / (a * d + (1.0 - a) * z)
        half = -0.5 * g * g * a / d
        return g, half * b, -g * g * (a * z / d + 1.0 - a), g * g * (z - d), half * rho
    if kind == RATIONAL or (kind == FOV and abs(lens[4]) < _LEAST_FOV):
        return 1.0 / z, 0.0, -1.0 / (z * z), 0.0, 0.0
    t = 2.0 * np.tan(0.5 * lens[4]) if kind == FOV else 1.0
    q = z / t
    square = rho + q * q
    if rho > _NEAR_AXIS * square:
        g = np.arctan2(np.sqrt(rho), q) / np.sqrt(rho)
        by_rho, by_q = 0.5 * (q / square - g) / rho, -1.0 / square
    else:
        g, by_rho, by_q = 1.0 / q - rho / (3.0 * q * q * q), -1.0 / (3.0 * q * q * q), -1.0 / square
    if kind != FOV:
        return g, by_rho, by_q, 0.0, 0.0
    w = lens[4]
    by_w = -(g / w + by_q * z * (1.0 + 0.25 * t * t) / (t * t)) / w
    return g / w, by_rho / w, by_q / (t * w), by_w, 0.0


@inner_kernel
def _stretch(lens: Any, s: float) -> tuple[float, float]:
    """Return the radial factor at s = u^2 + v^2, and its slope by s."""
    kind = lens[KIND]
    k1, k2, k3, k4, k5, k6 = lens[4], lens[5], lens[8], lens[9], lens[10], lens[11]
    if kind == RATIONAL:
        top, bottom = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
        slope, less = k1 + s * (2.0 * k2 + s * 3.0 * k3), k4 + s * (2.0 * k5 + s * 3.0 * k6)
        return top / bottom, (slope - less * top / bottom) / bottom
    k5, k6 = 0.0, 0.0
    if kind != THIN_PRISM:
        k3, k4 = lens[6], lens[7]
    if kind == RAD_TAN:
        k5, k6 = lens[8], lens[9]
    radial = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * (k4 + s * (k5 + s * k6)))))
    return radial, k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * (4.0 * k4 + s * (5.0 * k5 + s * 6.0 * k6))))


@inner_kernel
def _shifts(lens: Any) -> tuple[float, float, float, float, float, float]:
    """Return p1 and p2 as of OPENCV, and what shifts x and y by s and by s^2."""
    kind = lens[KIND]
    if kind == RAD_TAN:
        return lens[11], lens[10], lens[12], lens[14], lens[13], lens[15]
    if kind == THIN_PRISM:
        return lens[6], lens[7], lens[10], lens[11], 0.0, 0.0
    if kind == RATIONAL:
        return lens[6], lens[7], 0.0, 0.0, 0.0, 0.0
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


@inner_kernel
def _slopes_of_shift(lens: Any, u: float, v: float) -> tuple[float, float, float, float]:
    """Return the derivatives of the tangential and prism terms at (u, v): of x, then of y."""
    p1, p2, x1, y1, x2, y2 = _shifts(lens)
    s = u * u + v * v
    by_x, by_y, mixed = x1 + 2.0 * s * x2, y1 + 2.0 * s * y2, 2.0 * (p1 * u + p2 * v)
    return (
        2.0 * p1 * v + 6.0 * p2 * u + 2.0 * u * by_x,
        mixed + 2.0 * v * by_x,
        mixed + 2.0 * u * by_y,
        2.0 * p2 * u + 6.0 * p1 * v + 2.0 * v * by_y,
    )


@inner_kernel
def _distort(lens: Any, u: float, v: float) -> tuple[float, float, float, float, float, float]:
    """Return the distorted place of (u, v), then the derivatives: of its x, then of its y."""
    kind = lens[KIND]
    if kind in (FOV, DIVISION, EUCM):
        return u, v, 1.0, 0.0, 0.0, 1.0
    radial, slope = _stretch(lens, u * u + v * v)
    uu, uv, vv = radial + 2.0 * slope * u * u, 2.0 * slope * u * v, radial + 2.0 * slope * v * v
    a, b = radial * u, radial * v
    if kind == ANGLE:
        return a, b, uu, uv, uv, vv
    m, n = (a, b) if kind == RAD_TAN else (u, v)
    p1, p2, x1, y1, x2, y2 = _shifts(lens)
    s = m * m + n * n
    a += 2.0 * p1 * m * n + p2 * (s + 2.0 * m * m) + s * (x1 + s * x2)
    b += 2.0 * p2 * m * n + p1 * (s + 2.0 * n * n) + s * (y1 + s * y2)
    mm, mn, nm, nn = _slopes_of_shift(lens, m, n)
    if kind != RAD_TAN:
        return a, b, uu + mm, uv + mn, uv + nm, vv + nn
    return (
        a,
        b,
        uu + mm * uu + mn * uv,
        uv + mm * uv + mn * vv,
        uv + nm * uu + nn * uv,
        vv + nm * uv + nn * vv,
    )
