"""Compiled twins: contours of the tip (`tip`). Same names, same numbers.

A contour is its outcome, its points (K, 2), and middle, radius, rms, doubt and share of lines seen as six numbers.
"""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Mask
from tubesight.core.kernels import part, short_part
from tubesight.vision import edges, tip
from tubesight.vision.edge_kernels import colour_profiles, measure_edges, window
from tubesight.vision.ending import FOUND
from tubesight.vision.kernels import nearest_fall, spacing
from tubesight.vision.line_kernels import WORK_ROWS, Numbers, Picture, profile
from tubesight.vision.math_kernels import Count, length, median, solve

Found = tuple[int, Array, Numbers]


@short_part
def failed(outcome: int, radius: float) -> Found:
    """Twin of `tip.failed`."""
    return outcome, np.empty((0, 2)), (np.nan, np.nan, radius, np.nan, np.nan, 0.0)


@part
def fan(heading: Numbers, half: float, count: int) -> tuple[Array, Array]:
    """Twin of `tip._fan`: the angles' cosines (N,) and unit directions (N, 2)."""
    cosine, directions = np.empty(count), np.empty((count, 2))
    for n in range(count):
        angle = -half + 2 * half / (count - 1) * n
        c, s = np.cos(angle), np.sin(angle)
        cosine[n] = c
        directions[n, 0], directions[n, 1] = c * heading[0] + s * heading[1], c * heading[1] - s * heading[0]
    return cosine, directions


@short_part
def on_circle(x: float, y: float, radius: float, way: Array, origin: Array) -> None:
    """Points (N, 2) of a circle, written to `origin`."""
    for n in range(len(way)):
        origin[n, 0], origin[n, 1] = x + radius * way[n, 0], y + radius * way[n, 1]


@part
def rough(
    picture: Picture,
    origin: Array,
    way: Array,
    every: int,
    radius: float,
    sweep: int,
    blur: float,
    outwards: float,
    careful: bool,
    found: Array,
) -> None:
    """Twin of `tip._rough` on every so many-th line; writes the edges (N,), NaN for the others."""
    reach, step = tip.SWEEPS[sweep] * radius, spacing(2 * radius)
    low = -reach - tip.SWEEP_IN_PX
    count = int((reach + tip.SWEEP_OUT_PX - low) / step) + 2
    work, guess = np.empty((WORK_ROWS, count)), np.empty((len(origin) + every - 1) // every)
    lines = (2.0, 2 * edges.LINE_PX) if careful else (1.0, 0.0)
    for n in range(len(origin)):
        found[n] = np.nan
        if n % every == 0:
            start, direction = (origin[n, 0], origin[n, 1]), (way[n, 0], way[n, 1])
            profile(picture, start, direction, 0.0, low, step, lines, work)
            found[n] = nearest_fall(work, low, step, tip.DROP_MIN) + outwards
            guess[n // every] = found[n]
    if careful:
        colour, behind = colour_profiles(picture, origin, way, every, low, step, count, edges.LINE_PX)
        position, _, _ = measure_edges(colour, behind, low, step, guess, blur, picture.image.shape[2] < 3)
        for n in range(len(position)):
            found[n * every] = position[n]


@part
def fine(
    picture: Picture,
    origin: Array,
    way: Array,
    radius: float,
    blur: float,
    apart: float,
    shift: float,
    found: Array,
) -> float:
    """Twin of `tip._fine`; writes the edges (N,), all moved by the shift, and returns the doubt."""
    low, count = window(blur, radius)
    rows, step = len(origin), edges.SPACING_PX
    lines = colour_profiles(picture, origin, way, np.int64(1), low, step, count, apart)
    gray = picture.image.shape[2] < 3
    position, _, doubt = measure_edges(lines[0], lines[1], low, step, np.zeros(rows), blur, gray)
    for n in range(rows):
        found[n] = position[n] + shift
    return doubt


@part
def circle(points: Array, count: Count, keep: Mask) -> tuple[float, float, float]:
    """Twin of `tip._circle` for the first `count` points; writes which it keeps."""
    weight, off, values = np.ones(count), np.empty(count), np.empty(count)
    normal, right = np.empty((3, 3)), np.empty((3, 1))
    mx = my = cx = cy = radius = 0.0
    for n in range(count):
        mx += points[n, 0] / count
        my += points[n, 1] / count
    for k in range(tip.LEAST_ABSOLUTE + tip.TRIMS):
        xx = xy = yy = x1 = y1 = one = xz = yz = z1 = 0.0
        for n in range(count):
            w, x, y = weight[n], 2 * (points[n, 0] - mx), 2 * (points[n, 1] - my)
            z = (x * x + y * y) / 4
            xx += w * x * x
            xy += w * x * y
            yy += w * y * y
            x1 += w * x
            y1 += w * y
            one += w
            xz += w * x * z
            yz += w * y * z
            z1 += w * z
        u, v, uv = xx - x1 * x1 / one, yy - y1 * y1 / one, xy - x1 * y1 / one
        if not u * v - uv * uv > tip.ON_LINE * max(u + v, 1.0) ** 2:
            return mx, my, np.nan
        normal[0, 0], normal[0, 1], normal[0, 2], right[0, 0] = xx, xy, x1, xz
        normal[1, 0], normal[1, 1], normal[1, 2], right[1, 0] = xy, yy, y1, yz
        normal[2, 0], normal[2, 1], normal[2, 2], right[2, 0] = x1, y1, one, z1
        solve(normal, right)
        cx, cy = right[0, 0], right[1, 0]
        radius = np.sqrt(max(right[2, 0] + cx * cx + cy * cy, 0.0))
        for n in range(count):
            off[n] = abs(length(points[n, 0] - mx - cx, points[n, 1] - my - cy) - radius)
            values[n] = off[n]
        limit = min(max(tip.OFF_SIGMAS * median(values, count), tip.OFF_PX), tip.OFF_PX + tip.OFF_CIRCLE * radius)
        for n in range(count):
            keep[n] = off[n] <= limit
            weight[n] = 1 / max(off[n], tip.OFF_PX) if k < tip.LEAST_ABSOLUTE else (1.0 if keep[n] else 0.0)
    return mx + cx, my + cy, radius


@part
def ball(
    picture: Picture,
    centre: Numbers,
    heading: Numbers,
    expected: float,
    half: float,
    blur: float,
    outwards: float,
    careful: bool,
) -> Found:
    """Twin of `tip.ball`."""
    count = max(int(tip.BALL_LINES * half / np.pi), 12)
    _, way = fan(heading, half, count)
    origin, position, points = np.empty((count, 2)), np.empty(count), np.empty((count, 2))
    keep = np.empty(count, dtype=np.bool_)
    cx, cy, radius, doubt, used = centre[0], centre[1], expected, 0.0, 0
    sweep = -1
    for _ in range(len(tip.SWEEPS) + tip.MEASURES):
        sweep += 1
        on_circle(cx, cy, radius, way, origin)
        first = sweep < len(tip.SWEEPS)
        if first:
            rough(picture, origin, way, tip.ROUGH_EVERY, expected, sweep, blur, outwards, careful, position)
        else:
            doubt = fine(picture, origin, way, radius, blur, edges.LINE_PX, blur * blur / (2 * radius), position)
        found = np.int64(0)
        for n in range(count):
            if np.isfinite(position[n]):
                points[found, 0] = origin[n, 0] + way[n, 0] * position[n]
                points[found, 1] = origin[n, 1] + way[n, 1] * position[n]
                found += 1
        if found < max(tip.POINTS_MIN, tip.SEEN_MIN * count) / (tip.ROUGH_EVERY if first else 1):
            return failed(tip.FAINT, np.nan)
        x, y, size = circle(points, found, keep)
        used = 0
        for n in range(found):
            if keep[n]:
                points[used, 0], points[used, 1] = points[n, 0], points[n, 1]
                used += 1
        if not abs(size / expected - 1) < (2 * tip.RADIUS_OFF if sweep == 0 else tip.RADIUS_OFF):
            return failed(tip.RADIUS, size)
        moved = length(x - cx, y - cy) + abs(size - radius)
        cx, cy, radius = x, y, expected if first and sweep + 1 < len(tip.SWEEPS) else size
        if not first and moved < tip.MOVED_PX:
            break
        if first and moved < tip.NEAR_PX:
            sweep, radius = len(tip.SWEEPS) - 1, size
    if used < tip.SEEN_MIN * count:
        return failed(tip.NOT_ROUND, np.nan)
    total = 0.0
    for n in range(used):
        off = length(points[n, 0] - cx, points[n, 1] - cy) - radius
        total += off * off
    return FOUND, points[:used], (cx, cy, radius, np.sqrt(total / used), doubt, used / count)


@part
def round_end(
    picture: Picture, centre: Numbers, heading: Numbers, radius: float, blur: float, outwards: float
) -> Found:
    """Twin of `tip.round_end`."""
    count = tip.ROUND_LINES
    cosine, way = fan(heading, tip.ROUND_HALF_RAD, count)
    origin, off, points = np.empty((count, 2)), np.empty(count), np.empty((count, 2))
    cx, cy, doubt, rms, used = centre[0], centre[1], 0.0, 0.0, 0
    limit = tip.OFF_ROUND * radius + tip.OFF_ROUND_PX
    for sweep in range(len(tip.SWEEPS) + tip.MEASURES):
        on_circle(cx, cy, radius, way, origin)
        if sweep < len(tip.SWEEPS):
            rough(picture, origin, way, 1, radius, sweep, blur, outwards, False, off)
        else:
            doubt = fine(picture, origin, way, radius, blur, edges.LINE_PX, blur * blur / (2 * radius), off)
        across, square, used = 0.0, 0.0, 0
        for n in range(count):
            if abs(off[n]) < limit and abs(off[count - 1 - n]) < limit:
                points[used, 0] = origin[n, 0] + way[n, 0] * off[n]
                points[used, 1] = origin[n, 1] + way[n, 1] * off[n]
                across += cosine[n] * off[n]
                square += cosine[n] * cosine[n]
                used += 1
        if used < tip.SEEN_MIN * count:
            return failed(tip.FAINT, np.nan)
        shift, total = across / square, 0.0
        for n in range(count):
            if abs(off[n]) < limit and abs(off[count - 1 - n]) < limit:
                rest = off[n] - shift * cosine[n]
                total += rest * rest
        rms = np.sqrt(total / used)
        cx, cy = cx + shift * heading[0], cy + shift * heading[1]
        if sweep >= len(tip.SWEEPS) and abs(shift) < tip.MOVED_PX:
            break
    return FOUND, points[:used], (cx, cy, radius, rms, doubt, 0.0)


@short_part
def along_face(d: float, model: Array) -> float:
    """Place that a face's model (3, 1) predicts at a distance from its middle, in widths."""
    return float(model[0, 0] + model[1, 0] * np.sqrt(1 - 4 * d * d) + model[2, 0] * d)


@part
def fit_face(d: Array, place: Array, keep: Mask) -> tuple[Array, Count]:
    """Twin of `tip._fit_face`: the model (3, 1) and how many places it keeps; writes which."""
    count, used = len(place), np.int64(0)
    normal, model, row, off, values = np.empty((3, 3)), np.zeros((3, 1)), np.empty(3), np.empty(count), np.empty(count)
    for n in range(count):
        keep[n] = np.isfinite(place[n])
        used += 1 if keep[n] else 0
    for _ in range(tip.FACE_TRIMS):
        if used < tip.FACE_MIN:
            for n in range(count):
                keep[n] = False
            return model, np.int64(0)
        for i in range(3):
            model[i, 0] = 0.0
            for j in range(3):
                normal[i, j] = 0.0
        for n in range(count):
            if keep[n]:
                row[0], row[1], row[2] = 1.0, np.sqrt(1 - 4 * d[n] * d[n]), d[n]
                for i in range(3):
                    model[i, 0] += row[i] * place[n]
                    for j in range(3):
                        normal[i, j] += row[i] * row[j]
        solve(normal, model)
        used = np.int64(0)
        for n in range(count):
            off[n] = abs(place[n] - along_face(d[n], model))
            if keep[n]:
                values[used] = off[n]
                used += 1
        limit, used = max(tip.OFF_FACE_PX, tip.FACE_SIGMAS * median(values, used)), np.int64(0)
        for n in range(count):
            keep[n] = off[n] <= limit
            used += 1 if keep[n] else 0
    return model, used


@part
def face(picture: Picture, end: Numbers, heading: Numbers, width: float, blur: float, outwards: float) -> Found:
    """Twin of `tip.face`."""
    count = tip.FACE_LINES
    d, origin, way, start = np.empty(count), np.empty((count, 2)), np.empty((count, 2)), np.empty((count, 2))
    place, expected, keep = np.empty(count), np.empty(count), np.empty(count, dtype=np.bool_)
    for n in range(count):
        d[n] = -tip.FACE_WIDTHS + 2 * tip.FACE_WIDTHS / (count - 1) * n
        origin[n, 0], origin[n, 1] = end[0] + d[n] * width * heading[1], end[1] - d[n] * width * heading[0]
        way[n, 0], way[n, 1] = heading[0], heading[1]
    rough(picture, origin, way, 1, width / 2, 0, blur, outwards, False, place)
    model, used = fit_face(d, place, keep)
    doubt = 0.0
    for _ in range(tip.MEASURES):
        if used < tip.FACE_MIN:
            return failed(tip.FAINT, np.nan)
        for n in range(count):
            expected[n] = along_face(d[n], model)
            start[n, 0], start[n, 1] = origin[n, 0] + way[n, 0] * expected[n], origin[n, 1] + way[n, 1] * expected[n]
        doubt = fine(picture, start, way, width / 2, blur, 0.0, 0.0, place)
        for n in range(count):
            place[n] += expected[n]
        model, used = fit_face(d, place, keep)
        step = 0.0
        for n in range(count):
            step = max(step, abs(along_face(d[n], model) - expected[n]))
        if step < tip.MOVED_PX:
            break
    if used < tip.FACE_MIN:
        return failed(tip.FAINT, np.nan)
    points, total, used = np.empty((count, 2)), 0.0, 0
    for n in range(count):
        if keep[n]:
            points[used, 0], points[used, 1] = origin[n, 0] + way[n, 0] * place[n], origin[n, 1] + way[n, 1] * place[n]
            off = place[n] - along_face(d[n], model)
            total += off * off
            used += 1
    a = model[0, 0]
    return (
        FOUND,
        points[:used],
        (end[0] + heading[0] * a, end[1] + heading[1] * a, np.nan, np.sqrt(total / used), doubt, 0.0),
    )
