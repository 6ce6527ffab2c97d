"""The section of docs/results.md on robustness, and its picture, from the stress.json of benchmarks/stress.py."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))
from stress import SEQUENCES

Array = NDArray[Any]
Entries = list[dict[str, Any]]
PICTURE = "stress.png"
TIMES_BASE, FLOOR_RATIO = 2.0, 0.005  # a run holds: ATE at most twice the base's, or half a percent of the path
SHARES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)  # of the path's length
HEAD = """
## Robustness: sequences and twelve variants of each

By `python benchmarks/stress.py --data DATA --vary VARY --out DIR`, whose stress.json is {source}: tracking and the
joint optimisation, default options{options}{maps}, {count} runs. VARY makes variants of a sequence with exact truth; a
third of them are sums of three, applied from left to right. ATE is the RMSE over all frames after Sim(3) alignment, in
percent of the length of the true path; refused and failed runs count as infinite.
*holds*: variants with an ATE of at most {times:g} x that of the base, or {floor:g} % of the path. *never joined*: runs
that end in pieces that were never recognised, placed side by side by continuity. *focal off*: median of
|ln(f / f_true)|; *in 1 sigma*: runs in which that is within the run's own 1 sigma, of those that give one.
"""
COLUMNS = (
    "runs", "base [%]", "median [%]", "worst [%]", "holds", "never joined", "refused", "failed", "focal off [%]",
    "in 1 sigma",
)  # fmt: skip
SIZE, LEFT, RIGHT, TOP, BOTTOM = (960, 480), 70, 30, 44, 60
INK, SOFT, GRID = (36, 32, 28), (117, 109, 102), (226, 228, 227)  # BGR
CURVES = {
    "all": INK,
    "base": (201, 99, 36),
    "one change": (120, 158, 31),
    "three changes": (31, 102, 217),
}  # BGR


def stress(path: Path, picture: Path) -> list[str]:
    """Markdown lines, with the picture drawn beside the page; nothing where the file is not there."""
    if not path.is_file():
        return []
    entries: Entries = list(json.loads(path.read_text()).values())
    if not entries:
        return []
    draw(entries, picture)
    first = entries[0]["configuration"]
    said = [] if first["semantics"] == "auto" else [f"--semantics {first['semantics']}"]
    said += [f"--set {o}" for o in first["overrides"]]
    maps = ", semantic maps where a sequence brings them" if first["semantics"] == "auto" else ""
    options = f" but `{' '.join(said)}`" if said else ""
    head = HEAD.format(
        source=f"benchmarks/results/{path.name}", options=options, maps=maps, count=len(entries), times=TIMES_BASE,
        floor=100 * FLOOR_RATIO,
    )  # fmt: skip
    missing = [name for name in SEQUENCES if not any(e["configuration"]["sequence"] == name for e in entries)]
    if missing:
        head += f"\nNot run, and so in none of these figures: {', '.join(missing)}.\n"
    priors = ("semantics: people", "semantics: maps", "semantics: dinov2")
    bare = sum(not any(c.startswith(priors) for c in e.get("choices", ())) for e in entries)
    if bare and first["semantics"] == "auto":
        head += f"\n{bare} runs are of commits that looked for no people where a sequence brings no maps.\n"
    lines = [*head.splitlines(), "", f"![share of runs below an error]({picture.name})", ""]
    lines += ["| ATE at most, of the path | " + " | ".join(f"{100 * s:g} %" for s in SHARES) + " |"]
    lines.append("|---" * (len(SHARES) + 1) + "|")
    for name, group in groups(entries).items():
        cells = [f"{np.mean([ratio(e) <= s for e in group]):.0%}" for s in SHARES]
        lines.append(f"| {name}, {len(group)} runs | " + " | ".join(cells) + " |")
    for key in ("sequence", "variant"):
        lines += ["", f"| {key} | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
        names = list(dict.fromkeys(e["configuration"][key] for e in entries))
        for name in names:
            group = [e for e in entries if e["configuration"][key] == name]
            label = f"{name}{_piece(group[0]['configuration'])}" if key == "sequence" else name
            lines.append(f"| {label} | " + " | ".join(_row(group, entries, key == "sequence")) + " |")
        lines.append("| all | " + " | ".join(_row(entries, entries, False)) + " |")
    return [*lines, "", *_foot(entries)]


def other_options(path: Path) -> list[str]:
    """Markdown lines of variants run under other options: ATE of each, in the truth's own lengths."""
    if not path.is_file():
        return []
    entries: Entries = list(json.loads(path.read_text()).values())
    first = entries[0]["configuration"]
    said = [f"--semantics {first['semantics']}", *(f"--set {o}" for o in first["overrides"])]
    sequences = list(dict.fromkeys(e["configuration"]["sequence"] for e in entries))
    lines = [
        "",
        f"The same under `{' '.join(said)} --only {','.join(sequences)}` (benchmarks/results/{path.name}), ATE in m:",
        "",
        "| sequence | variant | ATE | tracked | keyframes | commit |",
        "|---|---|---|---|---|---|",
    ]
    for e in entries:
        name, ate = e["configuration"], e.get("ate_rmse_all")
        cells = [name["sequence"], name["variant"], "none" if ate is None else f"{ate:.4f}"]
        cells += [f"{e[k]}" if k in e else "–" for k in ("frames_tracked", "keyframes")]
        lines.append("| " + " | ".join([*cells, str(e["git_commit"])[:12]]) + " |")
    found = sorted(math.inf if e.get("ate_rmse_all") is None else e["ate_rmse_all"] for e in entries)
    return [*lines, "", f"Median {_median(found):.4f}, worst {found[-1]:.4f}. {_foot(entries)[-1]}"]


def ratio(entry: dict[str, Any]) -> float:
    """ATE over all frames / length of the true path; infinite where there is none."""
    ate, length = entry.get("ate_rmse_all"), entry.get("path_length")
    return math.inf if ate is None or not length else ate / length


def holds(entry: dict[str, Any], base: dict[str, Any] | None) -> bool:
    """Whether a run is about as good as its base, or good in itself."""
    known = base is not None and math.isfinite(ratio(base))
    bound = max(FLOOR_RATIO, TIMES_BASE * ratio(base)) if base is not None and known else FLOOR_RATIO
    return ratio(entry) <= bound


def focal_error(entry: dict[str, Any]) -> float | None:
    """|ln(f / f_true)|; None where either is not known."""
    found, true = entry.get("focal_px"), entry.get("focal_true_px")
    return None if not found or not true else abs(math.log(found / true))


def groups(entries: Entries) -> dict[str, Entries]:
    """The curves of the picture: all, and by how many changes were made."""

    def changes(entry: dict[str, Any]) -> str:
        variant = entry["configuration"]["variant"]
        return "base" if variant == "base" else "three changes" if "+" in variant else "one change"

    found = {name: entries if name == "all" else [e for e in entries if changes(e) == name] for name in CURVES}
    return {name: group for name, group in found.items() if group}


def _piece(configuration: dict[str, Any]) -> str:
    """Which frames of which folder, where they are not all of them."""
    first, last = configuration["first"], configuration["last"]
    return "" if (first, last) == (0, None) else f" ({configuration['folder']} {first}–{last - 1})"


def _row(group: Entries, entries: Entries, with_base: bool) -> list[str]:
    bases = {
        e["configuration"]["sequence"]: e for e in entries if e["configuration"]["variant"] == "base"
    }  # what "holds" compares with
    ratios = [ratio(e) for e in group]
    focal = [(d, e.get("focal_sigma_ratio")) for e in group if (d := focal_error(e)) is not None]
    told = [d <= sigma for d, sigma in focal if sigma]
    base = bases.get(group[0]["configuration"]["sequence"]) if with_base else None
    return [
        str(len(group)),
        "–" if base is None else _percent(ratio(base)),
        _percent(_median(ratios)),
        _percent(max(ratios)),
        _share([holds(e, bases.get(e["configuration"]["sequence"])) for e in group if e not in bases.values()]),
        _share([e["never_joined"] > 0 for e in group if "never_joined" in e]),
        str(sum("refused" in e for e in group)),
        str(sum("error" in e for e in group)),
        "–" if not focal else f"{100 * _median(d for d, _ in focal):.1f}",
        _share(told),
    ]


def _median(values: Iterable[float]) -> float:
    """The upper median, so that infinite values have one."""
    ordered = sorted(values)
    return ordered[len(ordered) // 2]


def _percent(share: float) -> str:
    return "none" if math.isinf(share) else f"{100 * share:.2f}"


def _share(flags: list[bool]) -> str:
    return "–" if not flags else f"{sum(flags)} of {len(flags)}"


def _foot(entries: Entries) -> list[str]:
    """What went wrong, and what it all ran on."""
    out = []
    for e in entries:
        name = f"{e['configuration']['sequence']}, {e['configuration']['variant']}"
        for key, verb in (("refused", "refused"), ("error", "failed")):
            out += [f"- {name} {verb}: {e[key]}"] if key in e else []
    seconds = sum(e.get("processor_s", 0) for e in entries) / 3600
    made = {key: sorted({str(e[key]) for e in entries}) for key in ("git_commit", "date", "processor", "cores")}
    line = f"Commit {', '.join(made['git_commit'])}; {made['date'][0]} to {made['date'][-1]}; "
    line += f"{', '.join(made['processor'])}, {', '.join(made['cores'])} cores; {seconds:.1f} hours of processor time."
    return [*out, *([""] if out else []), line]


def draw(entries: Entries, picture: Path) -> None:
    """The survival curve: the share of runs whose ATE / path is at most x, on a logarithmic axis of 0.01 to 100 %."""
    width, height = SIZE
    canvas = np.full((height, width, 3), 255, np.uint8)
    low, high = -4.0, 0.0  # powers of ten

    def at(error_ratio: float, share: float) -> tuple[int, int]:
        power = min(max(math.log10(max(error_ratio, 1e-9)), low), high)
        x = LEFT + (power - low) / (high - low) * (width - LEFT - RIGHT)
        return round(x), round(height - BOTTOM - share * (height - TOP - BOTTOM))

    for k in range(5):
        (x, _), (_, y) = at(10.0 ** (low + k), 0), at(1, k / 4)
        cv2.line(canvas, (x, TOP), (x, height - BOTTOM), GRID, 1)
        cv2.line(canvas, (LEFT, y), (width - RIGHT, y), GRID, 1)
        _text(canvas, f"{100 * 10.0 ** (low + k):g} %", (x - 20, height - BOTTOM + 20))
        _text(canvas, f"{k / 4:.0%}", (LEFT - 50, y + 5))
    _text(canvas, "ATE over all frames / length of the true path", (LEFT + 260, height - 14))
    place = LEFT
    for name, group in groups(entries).items():
        ordered = sorted(r for e in group if math.isfinite(r := ratio(e)))
        points = [at(10.0**low, 0)]
        for k, r in enumerate(ordered):
            points += [at(r, k / len(group)), at(r, (k + 1) / len(group))]
        points.append(at(10.0**high, len(ordered) / len(group)))
        line = np.array(points, np.int32)
        cv2.polylines(canvas, [line], False, CURVES[name], 3 if name == "all" else 2, cv2.LINE_AA)
        cv2.line(canvas, (place, 22), (place + 24, 22), CURVES[name], 3, cv2.LINE_AA)
        _text(canvas, f"{name} ({len(group)})", (place + 32, 27))
        place += 200
    cv2.imwrite(str(picture), canvas)


def _text(canvas: Array, text: str, place: tuple[int, int]) -> None:
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.47, SOFT, 1, cv2.LINE_AA)
