"""Compiled twins: lenses (`tubesight.geometry.lens`), rays of edges and contours (`rays`). Same names, same numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import part, short_part
from tubesight.geometry import lens
from tubesight.vision import rays
from tubesight.vision.line_kernels import Numbers
from tubesight.vision.math_kernels import Count, length, median, solve


class Optics(NamedTuple):
    """A camera in numbers: fx, skew, cx, fy, cy; 8 coefficients of a rational lens, or 4 of an equidistant one."""

    matrix: Numbers
    k: Numbers
    equidistant: bool


@part
def distort(x: float, y: float, optics: Optics) -> tuple[Numbers, Numbers]:
    """Distorted place of an ideal one, and the derivative (xx, xy, yx, yy)."""
    k = optics.k
    r2 = x * x + y * y
    p1, p2 = k[2], k[3]
    if optics.equidistant:
        p1 = p2 = 0.0
        limit = k[0] - 1 / 3
        scale, slope = 1 + limit * r2, limit
        if r2 >= 1e-10:
            r = np.sqrt(r2)
            theta = np.arctan(r)
            t2 = theta * theta
            scale = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
            growth = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
            slope = (growth / (1 + r2) - scale) / (2 * r2)
    else:
        top, bottom = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4])), 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
        top_slope, bottom_slope = k[0] + r2 * (2 * k[1] + 3 * k[4] * r2), k[5] + r2 * (2 * k[6] + 3 * k[7] * r2)
        scale = top / bottom
        slope = (top_slope * bottom - top * bottom_slope) / (bottom * bottom)
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    place = (
        x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    xx = scale + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = scale + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return place, (xx, cross, cross, yy)


@part
def newton(x: float, y: float, u: float, v: float, optics: Optics) -> tuple[float, float, bool, float]:
    """Twin of `lens._newton`: the step to be subtracted, whether the lens is regular there, and the residual."""
    place, (xx, xy, yx, yy) = distort(x, y, optics)
    du, dv = place[0] - u, place[1] - v
    determinant = xx * yy - xy * yx
    regular = determinant > lens.DETERMINANT_MIN and xx + yy > 0
    return (yy * du - xy * dv) / determinant, (xx * dv - yx * du) / determinant, regular, length(du, dv)


@part
def undistort(u: float, v: float, optics: Optics) -> tuple[float, float]:
    """Twin of `lens.undistort` for one place; NaN where the lens cannot be inverted."""
    x, y = u, v
    if optics.equidistant:
        angle = min(length(u, v), lens.ANGLE_MAX_RAD)
        stretch = (np.sin(angle) / angle if angle > 0 else 1.0) / np.cos(angle)
        x, y = u * stretch, v * stretch
    sx, sy, regular, error = newton(x, y, u, v, optics)
    if not regular:
        x = y = 0.0
        sx, sy, regular, error = newton(x, y, u, v, optics)
    fraction = 1.0
    for _ in range(lens.NEWTON_STEPS):
        if not error > lens.NEWTON_TOLERANCE:
            break
        tx, ty = x - fraction * sx, y - fraction * sy
        step_x, step_y, regular, trial = newton(tx, ty, u, v, optics)
        if regular and trial < error:
            x, y, sx, sy, error, fraction = tx, ty, step_x, step_y, trial, 1.0
        else:
            fraction /= 2
    return (x, y) if error < lens.INVERTED else (np.nan, np.nan)


@short_part
def unproject(px: float, py: float, optics: Optics) -> tuple[float, float]:
    """Twin of `Camera.unproject` for one pixel: x and y of the ray (x, y, 1)."""
    fx, skew, cx, fy, cy = optics.matrix
    y = (py - cy) / fy
    return undistort((px - cx - skew * y) / fx, y, optics)


@short_part
def project(x: float, y: float, z: float, optics: Optics) -> tuple[float, float]:
    """Twin of `Camera.project` for one point."""
    if not z > 0:
        return np.nan, np.nan
    fx, skew, cx, fy, cy = optics.matrix
    (u, v), _ = distort(x / z, y / z, optics)
    return fx * u + skew * v + cx, fy * v + cy


@short_part
def unit_ray(px: float, py: float, optics: Optics) -> tuple[float, float, float]:
    """Compute the unit ray of a pixel."""
    x, y = unproject(px, py, optics)
    size = np.sqrt(x * x + y * y + 1.0)
    return x / size, y / size, 1.0 / size


@part
def tangent_cone(optics: Optics, focal_px: float, contour: Array) -> tuple[Numbers, Array]:
    """Twin of `rays.tangent_cone`: axis, pixel, angle and rms as seven numbers, and the points kept."""
    count = len(contour)
    unit, off, values, keep = np.empty((count, 3)), np.empty(count), np.empty(count), np.empty(count, dtype=np.bool_)
    for n in range(count):
        unit[n, 0], unit[n, 1], unit[n, 2] = unit_ray(contour[n, 0], contour[n, 1], optics)
        keep[n] = np.isfinite(unit[n, 0])
    normal, step, a, size, angle = np.empty((3, 3)), np.empty((3, 1)), np.zeros(3), np.nan, np.nan
    for _ in range(rays.TRIMS):
        used = np.int64(0)
        for i in range(3):
            step[i, 0] = 0.0
            for j in range(3):
                normal[i, j] = 0.0
        for n in range(count):
            if keep[n]:
                used += 1
                rest = 1 - (unit[n, 0] * a[0] + unit[n, 1] * a[1] + unit[n, 2] * a[2])
                for i in range(3):
                    step[i, 0] += unit[n, i] * rest
                    for j in range(3):
                        normal[i, j] += unit[n, i] * unit[n, j]
        solve(normal, step)
        for i in range(3):
            a[i] += step[i, 0]
        size = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
        if used < 3 or not size > 1:
            return (np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan), np.empty((0, 2))
        angle = np.arccos(1 / size)
        used = np.int64(0)
        for n in range(count):
            cosine = (unit[n, 0] * a[0] + unit[n, 1] * a[1] + unit[n, 2] * a[2]) / size
            off[n] = abs(np.arccos(min(max(cosine, -1.0), 1.0)) - angle) * focal_px
            if keep[n]:
                values[used] = off[n]
                used += 1
        limit = max(rays.OFF_PX, rays.SIGMAS * median(values, used))
        for n in range(count):
            keep[n] = off[n] <= limit
    total, used, kept = 0.0, np.int64(0), np.empty((count, 2))
    for n in range(count):
        if keep[n]:
            total += off[n] * off[n]
            kept[used, 0], kept[used, 1] = contour[n, 0], contour[n, 1]
            used += 1
    px, py = project(a[0], a[1], a[2], optics)
    rms = np.sqrt(total / used)
    return (a[0] / size, a[1] / size, a[2] / size, px, py, angle, rms), kept[:used]


@part
def roughness(edges: Array, count: Count, side: int) -> float:
    """Twin of `rays.roughness` for one row of the first `count` scans."""
    if count < 4:
        return np.nan
    off = np.empty(count - 3)
    for n in range(count - 3):
        total = 0.0
        ax, ay = edges[n + 1, 0, 0] - edges[n + 1, 1, 0], edges[n + 1, 0, 1] - edges[n + 1, 1, 1]
        bx, by = edges[n + 2, 0, 0] - edges[n + 2, 1, 0], edges[n + 2, 0, 1] - edges[n + 2, 1, 1]
        a, b = 2 * length(ax, ay), 2 * length(bx, by)
        for i, across in ((0, ax / a + bx / b), (1, ay / a + by / b)):
            third = edges[n + 3, side, i] - edges[n, side, i] + 3 * (edges[n + 1, side, i] - edges[n + 2, side, i])
            total += third * across
        off[n] = abs(total)
    return max(rays.THIRD_TO_SD * median(off, count - 3), rays.ROUGH_MIN_PX)


@part
def tube_rays(
    optics: Optics, edges: Array, heading: Numbers, tip: Numbers, near: float, room: float, base: Numbers
) -> tuple[Array, Array, Array, Array, Numbers, Array]:
    """Twin of `rays.tube_rays`; of the base's ray x and y."""
    count, used = len(edges), np.int64(0)
    kept, unit = np.empty((count, 2, 2)), np.empty((count, 2, 3))
    middle, px = np.empty((count, 3)), np.empty((count, 2))
    for n in range(count):
        x, y = tip[0] - (edges[n, 0, 0] + edges[n, 1, 0]) / 2, tip[1] - (edges[n, 0, 1] + edges[n, 1, 1]) / 2
        if length(x, y) < near and not x * heading[0] + y * heading[1] > room:
            continue
        for side in range(2):
            u, v = edges[n, side, 0], edges[n, side, 1]
            kept[used, side, 0], kept[used, side, 1] = u, v
            unit[used, side, 0], unit[used, side, 1], unit[used, side, 2] = unit_ray(u, v, optics)
        z = unit[used, 0, 2] + unit[used, 1, 2]
        x, y = (unit[used, 0, 0] + unit[used, 1, 0]) / z, (unit[used, 0, 1] + unit[used, 1, 1]) / z
        middle[used, 0], middle[used, 1], middle[used, 2] = x, y, 1.0
        px[used, 0], px[used, 1] = project(x, y, 1.0, optics)
        used += 1
    rough = np.empty(2)
    for side in range(2):
        rough[side] = roughness(kept, used, side)
    return kept[:used], unit[:used], middle[:used], px[:used], unproject(base[0], base[1], optics), rough
