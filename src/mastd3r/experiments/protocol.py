"""What has to be said beside every table: how its figures were measured. Read from the code and the results."""

from __future__ import annotations

from typing import Any

from ..config import HOLDOUT_EVERY
from ..evaluation.trajectory_error import ASSOCIATION_S
from .suite import Suite, suite_from_dict

NO_LPIPS = (
    "LPIPS is not offered: the packages that compute it (lpips, piq, torchmetrics) need torchvision and the weights of "
    "a network trained for classification, which this package does without."
)


def protocol(results: dict[str, Any]) -> list[str]:
    """One line a topic, in plain words."""
    suite = suite_from_dict(results["definition"], results["suite"])
    complete = [r for r in results["entries"] if r["status"] == "complete"]
    configs = [r["config"] for r in complete]  # as they were: an old result may have options that are gone
    return [
        _frames(complete, configs),
        *_composed(results),
        "ATE: RMSE over positions after Sim(3) alignment (Umeyama), poses paired with the nearest true pose within "
        f"{ASSOCIATION_S * 1000:g} ms. All frames: every frame has a pose and counts; keyframes: those alone.",
        "RPE: RMSE of relative poses after the same scale, from each frame to the next (a frame), and between poses a "
        "fixed distance apart along the true path, divided by it (a metre).",
        _images(configs),
        "Speed: whole run = frames read by the seconds of everything from the first frame to the last file; tracking = "
        "the first pass alone. Memory: the most that the process held; the accelerator's as torch counts it.",
        *_seeds(results),
        *_options(suite),
        *_machines(complete),
        NO_LPIPS,
    ]


def _frames(complete: list[dict[str, Any]], configs: list[dict[str, Any]]) -> str:
    if not complete:
        return "Frames: nothing has run yet."
    each = []
    for name in dict.fromkeys(r["sequence"] for r in complete):
        mine = [r for r in complete if r["sequence"] == name]
        width, height = (mine[0].get("source") or {}).get("size") or ("?", "?")
        read = _range([r["metrics"]["frames"] for r in mine])
        without = _range([r["metrics"]["frames"] - r["metrics"]["frames_posed"] for r in mine])
        each.append(f"{name}: {read} of {width}x{height} px read, {without} without a pose")
    stride = _range([c["source"]["stride"] for c in configs])
    area = _range([c["tracking"]["area_px"] for c in configs])
    return f"Frames: {'; '.join(each)}. Stride {stride}. Tracking sees images of {area} px or less."


def _composed(results: dict[str, Any]) -> list[str]:
    names = ", ".join(results.get("composed", []))
    return [f"Semi-synthetic, real images with a real person composited in: {names}."] if names else []


def _range(values: list[int]) -> str:
    return str(min(values)) if min(values) == max(values) else f"{min(values)} to {max(values)}"


def _images(configs: list[dict[str, Any]]) -> str:
    mapped = [c["mapping"] for c in configs if c["mapping"]["enabled"]]
    if not mapped:
        return "PSNR and SSIM: no map was made."
    steps, width = (_given([m[key] for m in mapped]) for key in ("iterations", "width_px"))
    if all("quality" in m for m in mapped):
        drawn, quality = (
            "the splat file alone is drawn over black from the trajectory's pose",
            f"{_qualities(mapped)}, ",
        )
    else:
        drawn, quality = "rendered from the pose that tracking found, under a fitted exposure", ""
    return (
        f"PSNR and SSIM: the holdout, every {HOLDOUT_EVERY}th frame, is never shown to the map; {drawn}, at {width} px "
        f"width, against the photograph at that size. Whole image unless the head says static pixels, which are those "
        f"that the true mask leaves. Maps are {quality}trained for {steps} steps."
    )


def _qualities(mapped: list[dict[str, Any]]) -> str:
    return "of quality " + ", ".join(sorted({m["quality"] for m in mapped}))


def _given(values: list[int | None]) -> str:
    """The range of numbers that were given; what was not is the quality's."""
    numbers = [v for v in values if v]
    return _range(numbers) if len(numbers) == len(values) else "its own"


def _seeds(results: dict[str, Any]) -> list[str]:
    seeds = sorted({r["seed"] for r in results["entries"]})
    if not seeds:
        return []
    return [
        f"Seeds: {', '.join(map(str, seeds))}. One seed gives one trajectory on one machine, so seed n also starts n "
        "frames later; figures are the mean over seeds with least and most in brackets."
    ]


def _options(suite: Suite) -> list[str]:
    """What differs from the defaults."""
    lines = [f"Options of every run: {_joined(suite.settings) if suite.settings else 'the defaults'}."]
    own = [f"{s.name}: {_joined(s.overrides)}" for s in suite.sequences or () if s.overrides]
    lines += [f"Options of a sequence: {'; '.join(own)}."] if own else []
    variants = [f"{v.title}: {_joined(v.overrides)}" for v in suite.variants]
    return [*lines, f"Options of the variants: {'; '.join(variants)}."]


def _joined(overrides: tuple[str, ...]) -> str:
    return ", ".join(f"`{o}`" for o in overrides) or "none"


def _machines(complete: list[dict[str, Any]]) -> list[str]:
    if not complete:
        return []
    machines = sorted({_machine(r["machine"]) for r in complete})
    commits = sorted({str(r["machine"].get("git_commit")) for r in complete})
    dates = sorted({r["date"] for r in complete})
    jobs = max(r["jobs"] for r in complete)
    beside = f", up to {jobs} runs at once on cores of their own" if jobs > 1 else ", one run at a time"
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    return [f"Machine: {' and '.join(machines)}{beside}. Commit {' and '.join(commits)}. {when}."]


def _machine(machine: dict[str, Any]) -> str:
    card = machine.get("accelerator") or "no accelerator"
    return f"{machine.get('processor')}, {machine.get('cores')} cores a run, {card}"
