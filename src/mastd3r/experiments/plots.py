"""Small SVG plots of a suite's results: the spread of the error over seeds, and paths against the truth."""

from __future__ import annotations

import math
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .suite import suite_from_dict

Array = NDArray[Any]
WIDTH = 960
COLOURS = ("#2463c9", "#d9661f", "#1f9e78", "#a24bbf", "#c23b4b", "#7a6a17", "#3aa0c9", "#6b6f76")
INK, SOFT, GRID, TRUTH = "#1c2024", "#666d75", "#e3e4e2", "#9aa0a6"
STYLE = f"text{{font:12px system-ui,sans-serif;fill:{SOFT}}} .n{{fill:{INK};font-weight:600}}"
METRIC = "ate_rmse_all"


def plots_of(results: dict[str, Any]) -> dict[str, str]:
    """File name -> SVG text; a plot that nothing can be drawn in is absent."""
    made = {"ate_spread": spread(results), "paths": paths(results)}
    return {f"{results['suite']}_{name}.svg": svg for name, svg in made.items() if svg}


def spread(results: dict[str, Any]) -> str:
    """One row a sequence and variant: a dot a seed, on a logarithmic axis; a bar at the mean."""
    rows = _rows(results)
    if not rows:
        return ""
    values = [v for _, _, found in rows for v in found]
    low, high = math.log10(min(values)), math.log10(max(values))
    low, high = low - 0.1 * max(high - low, 0.3), high + 0.1 * max(high - low, 0.3)
    left, right, step, top = 330, 30, 22, 30
    colours = _colours(results)
    height = top + step * len(rows) + 46
    bottom = height - 44

    def x(value: float) -> float:
        return left + (math.log10(value) - low) / (high - low) * (WIDTH - left - right)

    out = [_text(left, 18, f"ATE over all frames, {len(values)} runs; a dot a seed", "start", "n")]
    for value in _log_ticks(low, high):
        out.append(f'<line x1="{x(value):.1f}" x2="{x(value):.1f}" y1="{top}" y2="{bottom}" stroke="{GRID}"/>')
        out.append(_text(x(value), bottom + 16, f"{value:g}", "middle"))
    out.append(_text((left + WIDTH - right) / 2, height - 8, "metres (the truth's unit), logarithmic", "middle"))
    for k, (sequence, variant, found) in enumerate(rows):
        y, mean = top + step * (k + 0.5), float(np.mean(found))
        if k and sequence != rows[k - 1][0]:
            out.append(f'<line x1="8" x2="{WIDTH - right}" y1="{y - step / 2}" y2="{y - step / 2}" stroke="{SOFT}"/>')
        if not k or sequence != rows[k - 1][0]:
            out.append(_text(10, y + 4, sequence, "start", "n"))
        out.append(_text(left - 12, y + 4, _titles(results)[variant], "end"))
        ends = f'x1="{x(min(found)):.1f}" x2="{x(max(found)):.1f}" y1="{y}" y2="{y}"'
        out.append(f'<line {ends} stroke="{colours[variant]}" stroke-width="1.5"/>')
        out.append(f'<rect x="{x(mean) - 1.5:.1f}" y="{y - 7}" width="3" height="14" fill="{colours[variant]}"/>')
        for value in found:
            fill = f'fill="{colours[variant]}" fill-opacity="0.65"'
            out.append(f'<circle cx="{x(value):.1f}" cy="{y}" r="4" {fill}/>')
    return _svg(height, out, "ATE of every run")


def paths(results: dict[str, Any]) -> str:
    """A panel a sequence: the true path in grey, what each variant found in colour, first seed, seen along the
    direction in which the true path extends least."""
    panels = [(s, found) for s in results["sequences"] if (found := _paths(results, s))]
    if not panels:
        return ""
    columns = min(3, len(panels))
    size = (WIDTH - 20 * (columns + 1)) / columns
    tall = min(size * 0.8, 300.0)
    drawn = list(dict.fromkeys(v for _, found in panels for v in found))
    colours, titles = _colours(results), _titles(results)
    out: list[str] = []
    for k, (sequence, found) in enumerate(panels):
        corner = np.array([20 + (size + 20) * (k % columns), 34 + (tall + 56) * (k // columns)])
        out += _panel(sequence, found, corner, np.array([size, tall]), colours)
    height = 34 + (tall + 56) * math.ceil(len(panels) / columns)
    place = 20.0
    for name, colour in [("truth", TRUTH), *((titles[v], colours[v]) for v in drawn)]:
        if place + 24 + 7 * len(name) > WIDTH - 20:
            place, height = 20.0, height + 18
        out.append(f'<rect x="{place:.0f}" y="{height - 8:.0f}" width="16" height="4" fill="{colour}"/>')
        out.append(_text(place + 21, height - 2, name, "start"))
        place += 44 + 6.6 * len(name)
    return _svg(height + 14, out, "paths against the truth")


def _panel(sequence: str, found: dict[str, Array], corner: Array, size: Array, colours: dict[str, str]) -> list[str]:
    truth = np.concatenate([rows[:, 3:] for rows in found.values()])
    centre = truth.mean(0)
    plane = np.linalg.svd(truth - centre, full_matrices=True)[2][:2]
    flat = {name: (rows[:, :3] - centre) @ plane.T for name, rows in found.items()}
    longest = max(found.values(), key=len)
    true = (longest[:, 3:] - centre) @ plane.T
    low, high = true.min(0), true.max(0)
    span = np.maximum(high - low, 0.15 * float((high - low).max())) * 1.3  # estimates that stray are cut at the frame
    span = np.maximum(span, 1e-9)
    scale = float((size / span).min())

    def place(points: Array) -> Array:
        return np.asarray(corner + size / 2 + (points - (low + high) / 2) * scale * np.array([1, -1]))

    x, y = corner
    clip = f"clip-{''.join(c if c.isalnum() else '-' for c in sequence)}"
    box = f'x="{x:.0f}" y="{y:.0f}" width="{size[0]:.0f}" height="{size[1]:.0f}"'
    out = [f'<clipPath id="{clip}"><rect {box}/></clipPath><rect {box} fill="none" stroke="{GRID}"/>']
    out.append(_text(x, y - 8, sequence, "start", "n"))
    out.append(f'<g clip-path="url(#{clip})">')
    out.append(_line(place(true), TRUTH, 5))
    out += [_line(place(points), colours[name], 1.6) for name, points in flat.items()]
    out.append("</g>")
    length = _round(0.3 * size[0] / scale)
    end, bar = x + size[0] - 10, y + size[1] - 10
    out.append(f'<line x1="{end - length * scale:.1f}" x2="{end:.1f}" y1="{bar:.1f}" y2="{bar:.1f}" stroke="{INK}"/>')
    out.append(_text(end - length * scale / 2, bar - 5, f"{length:g} m", "middle"))
    return out


def _rows(results: dict[str, Any]) -> list[tuple[str, str, list[float]]]:
    found = []
    for sequence in results["sequences"]:
        for variant in _titles(results):
            records = [r for r in results["entries"] if (r["sequence"], r["variant"]) == (sequence, variant)]
            values = [float(v) for r in records if (v := r["metrics"].get(METRIC)) is not None and v > 0]
            if values:
                found.append((sequence, variant, values))
    return found


def _paths(results: dict[str, Any], sequence: str) -> dict[str, Array]:
    order = list(_titles(results))
    records = [r for r in results["entries"] if r["sequence"] == sequence and r.get("path")]
    records.sort(key=lambda r: order.index(r["variant"]))
    found = {r["variant"]: np.array([row.split() for row in r["path"]], float) for r in records}
    return {name: rows for name, rows in found.items() if np.isfinite(rows).all()}


def _titles(results: dict[str, Any]) -> dict[str, str]:
    return {v.name: v.title for v in suite_from_dict(results["definition"], results["suite"]).variants}


def _colours(results: dict[str, Any]) -> dict[str, str]:
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(_titles(results))}


def _log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten between two exponents; 1, 2 and 5 times these, or all nine, where they are few."""
    powers = range(math.floor(low), math.ceil(high) + 1)
    ticks: list[float] = []
    for steps in ((1,), (1, 2, 5), range(1, 10)):
        ticks = [float(f"{m}e{p}") for p in powers for m in steps if low <= math.log10(m * 10.0**p) <= high]
        if len(ticks) > 2:
            break
    return ticks


def _round(length: float) -> float:
    """1, 2 or 5 times a power of ten, not above."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(m for m in (1, 2, 5) if m * power <= length * 1.0001) * power


def _line(points: Array, colour: str, width: float) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in np.clip(points, -1e4, 1e4))
    style = f'fill="none" stroke="{colour}" stroke-width="{width}" stroke-linejoin="round" stroke-linecap="round"'
    return f'<polyline points="{text}" {style}/>'


def _text(x: float, y: float, text: str, anchor: str, kind: str = "") -> str:
    mark = f' class="{kind}"' if kind else ""
    return f'<text{mark} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(height: float, parts: list[str], title: str) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" role="img"'
    ground = f'<style>{STYLE}</style><rect width="100%" height="100%" fill="#fff"/>'
    return f'{head} aria-label="{title}">{ground}{"".join(parts)}</svg>\n'
