"""report.html: one page that shows a run, pictures first. It needs no network; videos and links need its folder."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ..reading.files import is_file, whole_text
from ..types import Trajectory
from .evidence import FULL_SCALE_LOG, EvidenceSample, panel
from .files import write_text
from .metric_names import described, in_order, shown, summary_line
from .pictures import DIFFERENCE_FULL_SCALE, data_uri, difference, fitted, mask_overlay
from .plots import NARROW, WIDTH, over_time, timing_bars, top_view
from .report_files import RunFile, size_shown

Array = NDArray[Any]
OVERLAY_WIDTH_PX = 480
SCALE = re.compile(r'<p class="scale">[^<]*</p>')


@dataclass(frozen=True)
class MaskSample:
    """One photograph and what was thought to move in it."""

    timestamp_s: float
    image: Array  # (h, w, 3) uint8 RGB
    probability: Array  # (h', w') uint8, P(moving) * 255


@dataclass(frozen=True)
class RenderSample:
    """One holdout view: the photograph at the render's size, and the splat."""

    label: str  # "best", "median", "worst"
    timestamp_s: float
    photograph: Array  # (h, w, 3) uint8 RGB
    splat: Array  # (h, w, 3) uint8 RGB
    psnr_db: float


@dataclass(frozen=True)
class ReportData:
    """All that the page shows. Positions are in ``unit``, axes of the first camera."""

    title: str
    trajectory: Trajectory
    positions: Array  # (n, 3) float64
    truth: Array | None  # (n, 3) float64, NaN where a frame has none; None without truth
    unit: str  # "m" where truth or run.json gives the scale, otherwise "map units"
    renders: tuple[RenderSample, ...]
    masks: tuple[MaskSample, ...]
    metrics: Mapping[str, Any]
    record: Mapping[str, Any]  # run.json
    config: str  # YAML text
    evidence: EvidenceSample | None = None
    files: tuple[RunFile, ...] = ()  # of the run folder, which the page lies in


def write_report(run_dir: Path, data: ReportData) -> Path:
    """Write report.html into the run folder; gives its path. Raises OutputError."""
    path = run_dir / "report.html"
    write_text(path, report_html(data))
    return path


def report_html(data: ReportData) -> str:
    """The page as text."""
    template = Template(files(__package__).joinpath("report_template.html").read_text(encoding="utf-8"))
    sections = [
        _videos(data),
        _renders(data.renders),
        _masks(data.masks),
        _evidence(data.evidence),
        _trajectory(data),
        _numbers(data.metrics, data.record.get("camera") or {}),
        _timings(data.record.get("timings_s") or {}),
        _choices(data),
        _files(data.files),
    ]
    return template.substitute(
        title=escape(data.title),
        summary=escape(summary_line(data.metrics)),
        scale=_scale(data.record),
        banner=_banner(data.record),
        sections="\n".join(s for s in sections if s),
    )


def say_scale(run_dir: Path, record: Mapping[str, Any]) -> None:
    """Put what ``record`` says of metres into the report that is there; the rest of it stays. Raises OutputError."""
    path = run_dir / "report.html"
    if not is_file(path):
        return
    text = whole_text(path, "a readable report")
    if SCALE.search(text) is not None:
        write_text(path, SCALE.sub(lambda _: _scale(record), text, count=1))


def _scale(record: Mapping[str, Any]) -> str:
    """The paragraph of ``SCALE``: empty where nobody asked for metres."""
    facts = record.get("scale") or {}
    said = facts.get("said")
    if said:
        here = "in the metres of before" if facts.get("before") else "in map units"
        where = "all lengths are metres" if facts.get("applied") else f"exports are in metres, this folder {here}"
        said = f"{said} (--scale {facts.get('asked')}): {where}."
    elif facts.get("refused"):
        said = f"Lengths are map units: {facts['refused']}"
    return f'<p class="scale">{escape(said or "")}</p>'


def _banner(record: Mapping[str, Any]) -> str:
    said = (record.get("observability") or {}).get("said")
    lines = [] if not said else [escape(str(said))]
    if record.get("status") == "incomplete":
        lines.append(f"<b>Incomplete run.</b> {escape(str(record.get('reason') or 'no reason recorded'))}")
    return "".join(f'<p class="banner">{line}</p>' for line in lines)


def _section(title: str, text: str, body: str) -> str:
    note = f"<p>{text}</p>" if text else ""
    return f"<section><h2>{title}</h2>{note}{body}</section>"


def _figure(image: Array, caption: str, alt: str) -> str:
    height, width = image.shape[:2]
    picture = f'<img src="{data_uri(image)}" alt="{escape(alt)}" width="{width}" height="{height}">'
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _scale_bar(kind: str, high: str) -> str:
    return f'<span class="nowrap">0<span class="{kind}"></span>{high}</span>'


def _videos(data: ReportData) -> str:
    """The run's videos, which lie beside the page; a picture stands for one until it plays, or if it is not there."""
    here = {file.name for file in data.files}
    render = data.renders[0].splat if data.renders else None
    overlay = _overlay(data.masks[0]) if data.masks else None
    known = (
        ("flight.mp4", "flight through the splat, along the smoothed path", render, "autoplay loop"),
        ("masks.mp4", "what moves, over the frames", overlay, "loop"),
    )
    figures = []
    for name, words, poster, how in known:
        if name in here:
            still = "" if poster is None else f' poster="{data_uri(poster)}"'
            video = f'<video src="{name}" controls muted playsinline preload="metadata" {how}{still}></video>'
            figures.append(f"<figure>{video}<figcaption>{words}</figcaption></figure>")
    return f'<section class="first"><div class="row videos">{"".join(figures)}</div></section>' if figures else ""


def _files(files: Sequence[RunFile]) -> str:
    """Links to all that lies beside the page."""
    rows = []
    for f in files:
        address, known = quote(f.name) + ("" if f.count is None else "/"), "known" if f.words else ""
        link = f'<a class="{known}" href="{address}">{escape(f.name)}</a>'
        rows.append(
            f'<tr><td>{link}</td><td class="words">{escape(f.words)}</td><td class="value">{size_shown(f)}</td></tr>'
        )
    text = "Links lead to what lies beside this page in its run folder."
    return _section("Files", text, f"<table>{''.join(rows)}</table>") if rows else ""


def _renders(samples: Sequence[RenderSample]) -> str:
    if not samples:
        return ""
    rows = []
    for s in samples:
        rows.append(
            f'<div class="caption"><b>{escape(s.label.capitalize())}</b> of the holdout views · '
            f"{s.psnr_db:.1f} dB · at {s.timestamp_s:.3f} s</div>"
            '<div class="row three">'
            + _figure(s.photograph, "photograph", f"photograph at {s.timestamp_s:.3f} s")
            + _figure(s.splat, "splat", f"splat at {s.timestamp_s:.3f} s")
            + _figure(difference(s.photograph, s.splat), "difference", f"difference at {s.timestamp_s:.3f} s")
            + "</div>"
        )
    text = (
        "Frames that the map was never shown, and the map seen from their poses. Difference: "
        f"{_scale_bar('heat', f'{DIFFERENCE_FULL_SCALE:.0%}')} of the range or more. "
        "Where something moved, photograph and splat are meant to differ."
    )
    return _section("Photograph, splat, difference", text, "".join(rows))


def _overlay(sample: MaskSample) -> Array:
    return mask_overlay(fitted(sample.image, OVERLAY_WIDTH_PX), sample.probability)


def _masks(samples: Sequence[MaskSample]) -> str:
    if not samples:
        return ""
    figures = []
    for s in samples:
        picture = _overlay(s)
        ratio = float((s.probability > 127).mean())
        caption = f"<b>{s.timestamp_s:.3f} s</b> · {ratio:.1%} called moving"
        figures.append(_figure(picture, caption, f"P(moving) over the frame at {s.timestamp_s:.3f} s"))
    text = f"P(moving) over the photograph: {_scale_bar('heat moving', '1')}, with P = 0.5 outlined in white."
    return _section("What moves", text, f'<div class="row cells">{"".join(figures)}</div>')


def _evidence(sample: EvidenceSample | None) -> str:
    if sample is None:
        return ""
    cells = [(name, fitted(picture, OVERLAY_WIDTH_PX)) for name, picture in panel(sample)]
    figures = [_figure(picture, escape(name), f"{name} at {sample.timestamp_s:.3f} s") for name, picture in cells]
    text = (
        f"The frame at {sample.timestamp_s:.3f} s. Log-likelihood ratios: red speaks for moving, blue for standing "
        f"still, full colour at {FULL_SCALE_LOG:g}; grey says nothing. The video of all frames is masks.mp4."
    )
    return _section("What speaks for it", text, f'<div class="row cells">{"".join(figures)}</div>')


def _trajectory(data: ReportData) -> str:
    if len(data.trajectory.timestamps_s) == 0:
        return _section("Trajectory", "No frame has a pose.", "")
    error = None if data.truth is None else np.linalg.norm(data.positions - data.truth, axis=1)
    shared = (data.trajectory, data.positions, data.truth, data.unit, error)
    keyframes = int(data.trajectory.is_keyframe.sum())
    text = f"{len(data.positions)} poses, {keyframes} of them keyframes. "
    if data.truth is not None:
        text += "Scaled and turned to fit truth (Sim(3), all frames); the view from above is coloured by error."
    else:
        text += "A single camera cannot tell the scale: lengths are map units." if data.unit != "m" else ""
    legend = _legend(data, error is not None)
    plots = "".join(plot(*shared, width=width) for plot in (top_view, over_time) for width in (WIDTH, NARROW))
    return _section("Trajectory", text, plots + legend)


def _legend(data: ReportData, has_truth: bool) -> str:
    entries = [("tracked", "tracked")]
    entries += [(s, s) for s in ("interpolated", "lost") if s in data.trajectory.states]
    entries += [("truth", "truth")] if has_truth else []
    items = [f'<span><i style="background:var(--{colour})"></i>{name}</span>' for colour, name in entries]
    items.append('<span><i class="round"></i>keyframe</span>')
    items.append("<span>wedges: where the camera looks</span>")
    return f'<div class="legend">{"".join(items)}</div>'


def _numbers(metrics: Mapping[str, Any], camera: Mapping[str, Any]) -> str:
    if not metrics:
        return ""
    rows = []
    for key, value in in_order(metrics):
        of_name, of_value = _of_focal(camera) if key == "focal_px" and value is not None else ("", "")
        name, cell = escape(described(key) + of_name), _value_cell(key, value, of_value)
        rows.append(f"<tr><td>{name}</td>{cell}</tr>")
    half = (len(rows) + 1) // 2
    tables = "".join(f"<table>{''.join(part)}</table>" for part in (rows[:half], rows[half:]) if part)
    return _section("Figures", "", f'<div class="row two">{tables}</div>')


def _value_cell(key: str, value: Any, addition: str = "") -> str:
    kind = "value text" if isinstance(value, str) else "value"
    return f'<td class="{kind}">{escape(shown(key, value) + addition)}</td>'


def _of_focal(camera: Mapping[str, Any]) -> tuple[str, str]:
    """What is added to the focal length's name and value, from the camera section of run.json.

    An assumed one is what most cameras have: the video hardly speaks of it.
    """
    sigma_ratio = camera.get("focal_sigma_ratio")
    if camera.get("found") == "given":
        return ", given", ""
    if sigma_ratio is None:
        return "", ""
    percent = 100 * sigma_ratio
    digits = "under 0.01" if percent < 0.01 else f"{percent:.2g}" if percent < 10 else f"{percent:.0f}"
    said = ", assumed (1σ of most cameras)" if camera.get("found") == "assumed" else ", from the video (1σ)"
    return said, f" ± {digits} %"


def _timings(timings_s: Mapping[str, float]) -> str:
    plots = "".join(timing_bars(dict(timings_s), width) for width in (WIDTH, NARROW))
    return _section("Time of each stage", "", plots) if timings_s else ""


def _choices(data: ReportData) -> str:
    record = data.record
    parts = []
    choices = record.get("choices") or []
    if choices:
        parts.append("<ul>" + "".join(f"<li>{escape(str(c))}</li>" for c in choices) + "</ul>")
    command = record.get("command") or []
    if command:
        parts.append(f"<pre>{escape(shlex.join(map(str, command)))}</pre>")
    machine = record.get("machine") or {}
    packages = machine.get("packages") or {}
    facts = {k.replace("_", " "): v for k, v in machine.items() if k != "packages" and v is not None}
    facts |= {k: record[k] for k in ("started", "finished", "status") if record.get(k)}
    facts |= {"packages": ", ".join(f"{k} {v}" for k, v in packages.items() if v)} if packages else {}
    rows = "".join(f"<tr><td>{escape(k)}</td><td>{escape(str(v))}</td></tr>" for k, v in facts.items())
    if rows:
        parts.append(f"<details><summary>Machine and versions</summary><table>{rows}</table></details>")
    if data.config:
        parts.append(f"<details><summary>Configuration</summary><pre>{escape(data.config)}</pre></details>")
    return _section("Choices made", "", "".join(parts)) if parts else ""
