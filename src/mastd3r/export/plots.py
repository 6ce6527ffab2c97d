"""Plots of the report as inline SVG. Colours are CSS variables, so that they follow light and dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..types import Trajectory

Array = NDArray[Any]
WIDTH = 1080  # of a plot beside which a page has room
NARROW = 340  # for a phone: the same letters, fewer ticks
STATE_NAMES = {"started": "tracked", "tracked": "tracked", "interpolated": "interpolated", "lost": "lost"}
MAX_POINTS = 1500  # of one line; more than the plot has pixels
LEAST_POINTS = NARROW / WIDTH  # of those, for a line that spans little of the plot


def top_view(
    trajectory: Trajectory,
    positions: Array,
    truth: Array | None,
    unit: str,
    error: Array | None,
    width: int = WIDTH,
) -> str:
    """The path seen from above, equal axes, the longest extent lying across; ``width`` WIDTH or NARROW.

    ``positions`` (n, 3) in ``unit``; ``truth`` (n, 3) likewise, NaN where there is none. ``error`` (n,)
    colours the path where given, otherwise its states do. Directions of view and keyframes are marked.
    """
    plane = ground_axes(trajectory, positions)
    flat = positions @ plane.T
    true_flat = truth @ plane.T if truth is not None else None
    everything = flat if true_flat is None else np.concatenate([flat, true_flat[np.isfinite(true_flat).all(1)]])
    low, high = everything.min(0), everything.max(0)
    span = float((high - low).max())
    span = span if span > 1e-9 else 1.0  # a camera that never moves: a dot in the middle
    pad = 0.06 * span
    left, right, top, bottom = 56, 24, 20, 44
    scale = min((width - left - right) / (high[0] - low[0] + 2 * pad), 460 / (high[1] - low[1] + 2 * pad))
    height = max(220.0, (high[1] - low[1] + 2 * pad) * scale + top + bottom)
    middle = (low + high) / 2
    centre = np.array([left + (width - left - right) / 2, top + (height - top - bottom) / 2])

    def place(points: Array) -> Array:
        return np.asarray((points - middle) * scale * np.array([1.0, -1.0]) + centre)

    half = np.array([(width - left - right) / 2, (height - top - bottom) / 2]) / scale
    out = _grid((middle - half, middle + half), place, (left, width - right, top, height - bottom))
    out.append(_label(width / 2, height - 6 if width == WIDTH else 12, f"from above, {unit}", "middle"))
    if true_flat is not None:
        out += _lines(place(true_flat), np.isfinite(true_flat).all(1), "truth")
    xy = place(flat)
    out += _error_path(xy, error) if error is not None else _state_path(xy, trajectory)
    out += _view_marks(trajectory, flat, plane, span, place)
    out += [_dot(p, "keyframe", 3) for p in xy[trajectory.is_keyframe]]
    out += [_dot(xy[0], "start", 6), _label(xy[0][0] - 9, xy[0][1] + 4, "start", "end", "name")]
    if error is not None and np.isfinite(error).any():
        out += _colour_bar(float(np.nanmax(error)), unit, width - right - 180, height - 18)
    return _svg(width, height, out, "trajectory from above")


def over_time(
    trajectory: Trajectory,
    positions: Array,
    truth: Array | None,
    unit: str,
    error: Array | None,
    width: int = WIDTH,
) -> str:
    """Right, down and forward of the first camera over time, and the error below where truth gives one."""
    times = trajectory.timestamps_s - trajectory.timestamps_s[0]
    names = [("right", 0), ("down", 1), ("forward", 2)]
    rows = len(names) + (error is not None)
    row_height, gap, left, right = 104.0, 34.0, 56.0, 24.0
    height = rows * (row_height + gap) + 44
    duration = max(float(times[-1]), 1e-9)
    out: list[str] = []
    x = left + times / duration * (width - left - right)
    for row in range(rows):
        top = 26 + row * (row_height + gap)
        is_error = row == len(names)
        values = error if is_error and error is not None else positions[:, min(row, 2)]
        true = truth[:, row] if truth is not None and not is_error else None
        known = np.concatenate([values] + ([true] if true is not None else []))
        known = known[np.isfinite(known)]
        low = 0.0 if is_error or not len(known) else float(known.min())
        high = float(known.max()) if len(known) else 1.0
        room = max(0.08 * (high - low), 1e-9 + 1e-6 * abs(high))
        low, high = (low if is_error else low - room), high + room

        def level(v: Array, low: float = low, high: float = high, top: float = top) -> Array:
            return np.asarray(top + (high - v) / (high - low) * row_height)

        for tick in ticks(low, high, 4):
            y = float(level(np.array(tick)))
            out.append(f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}"/>')
            out.append(_label(left - 8, y + 4, number(tick, high - low), "end"))
        title = "error" if is_error else names[row][0]
        if true is not None:
            out += _lines(np.stack([x, level(true)], 1), np.isfinite(true), "truth")
        xy = np.stack([x, level(values)], 1)
        if is_error:
            out += _lines(xy, np.isfinite(values), "error")
        else:
            out += _state_path(xy, trajectory)
            out += [_dot(p, "keyframe", 2.2) for p in xy[trajectory.is_keyframe]]
        out.append(_label(left, top - 8, f"{title}, {unit}", "start", "name"))
    foot = height - 26
    for tick in ticks(0, duration, 10 if width == WIDTH else 4):
        out.append(_label(left + tick / duration * (width - left - right), foot, number(tick, duration), "middle"))
    out.append(_label(width / 2, height - 6, "seconds from the first frame", "middle"))
    return _svg(width, height, out, "position over time")


def timing_bars(timings_s: dict[str, float], width: int = WIDTH) -> str:
    """One bar a stage, with its seconds and its share; where there is little room, its name stands above."""
    total = sum(timings_s.values())
    if total <= 0:
        return ""
    above = width < WIDTH
    left, step = (0, 46) if above else (190, 30)
    bar = width - left - 130
    longest = max(timings_s.values())
    out: list[str] = []
    for row, (stage, seconds) in enumerate(timings_s.items()):
        y = 6 + row * step
        out.append(
            _label(0, y + 8, stage, "start", "name") if above else _label(left - 10, y + 15, stage, "end", "name")
        )
        y += 14 if above else 0
        out.append(f'<rect class="bar" x="{left}" y="{y}" width="{bar * seconds / longest:.1f}" height="20" rx="3"/>')
        text = f"{seconds:.1f} s · {100 * seconds / total:.0f} %"
        out.append(_label(left + bar * seconds / longest + 8, y + 15, text, "start"))
    return _svg(width, len(timings_s) * step + 8, out, "seconds of each stage")


def ground_axes(trajectory: Trajectory, positions: Array) -> Array:
    """(2, 3) rows spanning the plane seen from above, the longest extent of the path first.

    Down is the mean of the cameras' own down: people hold cameras upright. Where it says little (a camera
    that rolls about), the two principal axes of the path are taken.
    """
    down = trajectory.world_from_cam[:, :3, 1].mean(0)
    centred = positions - positions.mean(0)
    if np.linalg.norm(down) < 0.3:
        return np.asarray(np.linalg.svd(centred, full_matrices=True)[2][:2])
    down = down / np.linalg.norm(down)
    flat = centred - np.outer(centred @ down, down)
    if np.ptp(flat, 0).max() < 1e-9:
        forward = trajectory.world_from_cam[0, :3, 2]
        flat = forward[None] - (forward @ down) * down
    along = np.linalg.svd(flat, full_matrices=True)[2][0]
    along = along - (along @ down) * down
    along = along / np.linalg.norm(along)
    if along @ (positions[-1] - positions[0]) < 0:
        along = -along
    return np.stack([along, np.cross(along, down)])  # forward is left of right, as on a map


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round values between low and high, about so many, a step of 1, 2 or 5 times a power of ten."""
    raw = (high - low) / max(about, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(s for s in (1, 2, 5, 10) if s * power >= raw * 0.999) * power
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def number(value: float, span: float) -> str:
    """A tick's value with as many decimals as its axis needs."""
    decimals = max(0, 1 - math.floor(math.log10(max(span, 1e-12))))
    return f"{0.0 if value == 0 else value:.{min(decimals, 9)}f}"


def error_colour(ratio: float) -> str:
    """0..1 to green, amber, red: dark and light backgrounds both carry it."""
    stops = np.array([[46, 160, 110], [224, 168, 46], [214, 69, 65]], float)
    at = min(max(ratio, 0.0), 1.0) * 2
    i = min(int(at), 1)
    r, g, b = (stops[i] + (at - i) * (stops[i + 1] - stops[i])).round().astype(int)
    return f"rgb({r},{g},{b})"


def _svg(width: int, height: float, parts: Sequence[str], title: str) -> str:
    body = "".join(parts)
    svg = f'<svg viewBox="0 0 {width} {height:.0f}" role="img" aria-label="{title}">{body}</svg>'
    return f'<div class="plot {"wide" if width == WIDTH else "narrow"}">{svg}</div>'


def _label(x: float, y: float, text: str, anchor: str, kind: str = "tick") -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>'


def _dot(point: Array, kind: str, radius: float) -> str:
    return f'<circle class="{kind}" cx="{point[0]:.1f}" cy="{point[1]:.1f}" r="{radius}"/>'


def _grid(bounds: tuple[Array, Array], place: Any, frame: tuple[float, float, float, float]) -> list[str]:
    (low, high), (left, right, top, bottom) = bounds, frame
    span = float((high - low).max())
    step_count = 8 if right - left > WIDTH / 2 else 3
    out: list[str] = []
    step = ticks(0, span, step_count)[1]
    for axis in (0, 1):
        for k in range(math.ceil(low[axis] / step), math.floor(high[axis] / step) + 1):
            at = place(np.array([k * step, k * step]))[axis]
            ends = f'x1="{at:.1f}" x2="{at:.1f}" y1="{top}" y2="{bottom:.1f}"'
            if axis == 1:
                ends = f'x1="{left}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"'
            out.append(f'<line class="grid" {ends}/>')
            text = number(k * step, span)
            where = (at, bottom + 16, text, "middle") if axis == 0 else (left - 8, at + 4, text, "end")
            out.append(_label(*where))
    return out


def _lines(xy: Array, valid: Array, kind: str) -> list[str]:
    """One polyline for each unbroken stretch of valid rows."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(int)))
    return [_polyline(xy[a:b], kind) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _polyline(xy: Array, kind: str) -> str:
    room = float(np.clip(np.ptp(xy, 0).max() / WIDTH, LEAST_POINTS, 1)) if len(xy) else 1.0
    step = max(1, math.ceil(len(xy) / (MAX_POINTS * room)))
    kept = xy[::step] if (len(xy) - 1) % step == 0 else np.concatenate([xy[::step], xy[-1:]])
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in kept)
    return f'<polyline class="path {kind}" points="{points}"/>'


def _state_path(xy: Array, trajectory: Trajectory) -> list[str]:
    """The path in the colour of its states; a stretch reaches to the first point of the next."""
    names = [STATE_NAMES[s] for s in trajectory.states]
    out, begin = [], 0
    for i in range(1, len(names) + 1):
        if i == len(names) or names[i] != names[begin]:
            out.append(_polyline(xy[begin : i + 1], names[begin]))
            begin = i
    return out


def _error_path(xy: Array, error: Array) -> list[str]:
    known = error[np.isfinite(error)]
    worst = max(float(known.max()), 1e-12) if len(known) else 1.0
    step = max(1, math.ceil(len(xy) / MAX_POINTS))
    out = []
    for i in range(0, len(xy) - 1, step):
        colour = error_colour(error[i] / worst) if np.isfinite(error[i]) else "var(--lost)"
        a, b = xy[i], xy[min(i + step, len(xy) - 1)]
        ends = f'x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"'
        out.append(f'<line class="path" style="stroke:{colour}" {ends}/>')
    return out


def _view_marks(trajectory: Trajectory, flat: Array, plane: Array, span: float, place: Any) -> list[str]:
    """A small open wedge at about a dozen frames: where the camera looks."""
    chosen = np.unique(np.linspace(0, len(flat) - 1, 12).round().astype(int))
    out = []
    for i in chosen:
        forward = plane @ trajectory.world_from_cam[i, :3, 2]
        length = np.linalg.norm(forward)
        if length < 0.2:  # looking straight down or up
            continue
        ahead = forward / length * 0.045 * span
        side = np.array([-ahead[1], ahead[0]]) * 0.5
        corners = place(np.stack([flat[i], flat[i] + ahead + side, flat[i] + ahead - side]))
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        out.append(f'<polygon class="view" points="{points}"/>')
    return out


def _colour_bar(worst: float, unit: str, x: float, y: float) -> list[str]:
    steps = 24
    cells = [
        f'<rect x="{x + i * 100 / steps:.1f}" y="{y}" width="{100 / steps + 0.3:.1f}" height="8" '
        f'fill="{error_colour((i + 0.5) / steps)}"/>'
        for i in range(steps)
    ]
    return [
        *cells,
        _label(x - 8, y + 8, "error 0", "end"),
        _label(x + 108, y + 8, f"{worst:.3g} {unit}", "start"),
    ]
