"""The section of docs/results.md that benchmarks/bench_networks.py's JSON becomes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

OUTPUTS = {
    "points": "points", "confidence": "confidence", "descriptors": "descriptors",
    "descriptor_confidence": "descriptor confidence",
}  # fmt: skip


def networks(path: Path) -> list[str]:
    """Lines, or none where the file is not there."""
    if not path.is_file():
        return []
    e: dict[str, Any] = json.loads(path.read_text())
    parts = e["parts"]
    out = ["", "## The networks on an accelerator", ""]
    out.append(
        f"{e['device']}, {e['cores']} CPU cores, torch {e['torch']}, {e['date']}; random weights, {e['parameters']:,} "
        f"parameters, images of {e['size']}. By `{e['command']}`. A frame of the network alone is one encoding and one "
        "decoding of a pair whose other frame is encoded already; memory is that of weights and layers together."
    )
    rows = [_row("ours, " + name + ", layer by layer", v) for name, v in parts.get("precision", {}).items()]
    rows += [_row("ours, " + name + ", recorded", v) for name, v in parts.get("graphed", {}).items()]
    rows += [_row("ours, " + name + ", torch.compile", v) for name, v in parts.get("compiled", {}).items()]
    against = {k: v for k, v in parts.get("reference", {}).items() if "per_s" in v}
    rows += [_row("reference, " + name, v) for name, v in against.items()]
    out += _table(["network alone", "ms", "frames/s", "memory [MiB]"], rows)
    out += _ratios(parts, against)
    out += _errors(parts)
    out += _others(parts)
    out += _loop(parts.get("loop"))
    out += ["", *(f"- not measured: {name} ({why})" for k in ("failed", "left_out") for name, why in e[k].items())]
    return out


def _row(name: str, v: dict[str, Any]) -> list[str]:
    return [name, f"{v['ms_in_a_row']:.2f}", f"{v['per_s']:.1f}", f"{v.get('peak_mib', '–')}"]


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    lines = ["", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows)] if rows else []


def _ratios(parts: dict[str, Any], against: dict[str, Any]) -> list[str]:
    """Ours over the reference's own setting, in every setting of ours."""
    own = next((v for k, v in against.items() if "its own" in k), None)
    if own is None:
        return []
    found = [
        f"{name}, {how} {v['per_s'] / own['per_s']:.2f}"
        for part, how in (("precision", "layer by layer"), ("graphed", "recorded"), ("compiled", "compiled"))
        for name, v in parts.get(part, {}).items()
    ]
    said = ["", "Frames/s over those of the reference in its own setting: " + "; ".join(found) + "."]
    if "curope" not in parts["reference"].get("rope", ""):
        said[-1] += (
            " Its optional CUDA kernel for rotary positions was not built; its own PyTorch code ran in its place."
        )
    return said


def _errors(parts: dict[str, Any]) -> list[str]:
    cases = [(f"ours {k} from ours float32", v["relative_error"]) for k, v in parts.get("precision", {}).items()]
    cases = [case for case in cases if any(value[2] for value in case[1].values())]
    reference = parts.get("reference", {}).get("own_from_reference")
    if reference:
        cases.append(("ours from the reference, both float32", reference))
    rows = [[name, *(f"{v[0]:.1e}, {v[1]:.1e}, {v[2]:.1e}" for v in (e[k] for k in OUTPUTS))] for name, e in cases]
    return _table(["relative error: median, 99 %, largest", *OUTPUTS.values()], rows)


def _others(parts: dict[str, Any]) -> list[str]:
    rows = [["matching: " + k, *_row(k, v)[1:]] for k, v in parts.get("matching", {}).items()]
    rows += [["DINOv2: " + k, *_row(k, v)[1:]] for k, v in parts.get("dinov2", {}).items() if isinstance(v, dict)]
    lines = _table(["beside it", "ms", "a second", "memory [MiB]"], rows)
    for name, v in parts.get("matching", {}).items():
        if agreed := v.get("against_host"):
            lines += ["", f"Matching, {name}, against numba on the host: {agreed['same_verdict_ratio']:.2%} of the "
                      f"verdicts are the same, pixels {agreed['apart_px_median']:.1e} px apart in the median, "
                      f"{agreed['apart_px_99']:.1e} px at 99 %."]  # fmt: skip
    return lines


def _loop(found: dict[str, Any] | None) -> list[str]:
    if not found:
        return []
    e, dino = found["loop"], found.get("loop_with_dinov2")
    states = ", ".join(f"{n} {s}" for s, n in e["states"].items())
    error = "–" if e["ate_rmse_m"] is None else f"{e['ate_rmse_m']:.4f} m"
    out = ["", f"The tracking loop over {e['frames']} frames ({states}; ATE {error}; {e['encoded']} encodings, "
           f"{e['decoded']} decodings): **{e['per_s']:.1f} frames/s, {found['loop_over_network']:.2f} of the network "
           f"alone** ({found['network_alone']['per_s']:.1f}, {found['execution']}). Without the decoders' time: "
           f"{found['loop_without_decoders']['per_s']:.1f}."]  # fmt: skip
    if "loop_over_network_layer_by_layer" in found:
        out[-1] += f" Over the network launched layer by layer: {found['loop_over_network_layer_by_layer']:.2f}."
    out[-1] += f" With DINOv2 beside it: {dino['per_s']:.1f}." if dino else ""
    rows = [[name, f"{value:.2f}"] for name, value in e["stage_ms_a_frame"].items() if value >= 0.05]
    return out + _table(["stage, what it calls included; ahead and beside: in other threads", "ms a frame"], rows)
