"""The parts of benchmarks/bench_networks.py that look at a sequence: matching, DINOv2, and the tracking loop."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mastd3r.config import Config
from mastd3r.dynamics.config import DynamicsConfig
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.networks.dinov2 import Dinov2Features
from mastd3r.networks.foreground import ForegroundPrior
from mastd3r.networks.matching import RecordedMatching, match_pixels
from mastd3r.networks.pair import PairNetwork
from mastd3r.offline.final_solve import final_frames, trajectory_of
from mastd3r.parts import parts_of
from mastd3r.pointmap.mast3r import Mast3rPointmaps, match_on_host, working_size_of
from mastd3r.pointmap.matching import FoundPixels, MatchOptions, subsampled
from mastd3r.slam import Slam
from mastd3r.types import Frame
from truth_network import Clip, Seen, TruthNetwork

WARM_FRAMES = 50  # of the loop, before anything is timed: kernels are compiled, caches filled


def _clip(b: Any) -> Clip | None:
    if b.options.sequence is None:
        return None
    if not hasattr(b, "clip"):
        b.clip = Clip(b.options.sequence, b.options.frames)
    return b.clip


def _matcher_of(network: PairNetwork) -> Any:
    """The matcher that the package takes with it."""
    if network.device.type == "cpu":
        return match_on_host
    search = match_pixels if network.recorder is None else RecordedMatching(network.recorder)
    return lambda *arguments: FoundPixels(*search(*arguments))


@torch.inference_mode()
def matching(b: Any) -> dict[str, Any]:
    """Matches of one pair: the loop's pixels, all pixels, and all pixels matched back as well."""
    clip = _clip(b)
    if clip is None:
        return {"left_out": "no --sequence"}
    truth = TruthNetwork(b.network("float32"), clip, run_layers=False)
    far = min(len(clip.frames) - 1, 15)
    seen = [Seen(truth.network.encode(p), p.number) for p in (truth.prepare(clip.frames[n].image) for n in (far, 0))]
    pair = truth.pair(*seen)
    h, w = pair.first.points.shape[:2]
    every = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
    cells = np.concatenate([subsampled(h, w, 10)[0], subsampled(h, w, 8)[0]])
    found = {}
    cases = [("pixels of the loop", cells, MatchOptions(), truth.network)]
    if b.execution == "graph":
        cases.append(("pixels of the loop, recorded", cells, MatchOptions(), b.network("float32", "graph")))
    cases.append(("all pixels", every, MatchOptions(), truth.network))
    cases.append(("all pixels, and back", every, MatchOptions(reciprocal_px=1.0), truth.network))
    for name, px, options, network in cases:
        matcher = _matcher_of(network)
        answer = matcher(pair.first, pair.second, px, None, options)
        timed = b.timed(lambda p=px, o=options, m=matcher: m(pair.first, pair.second, p, None, o), 5)
        found[name] = {**timed, "pixels": len(px), "matched_ratio": round(float(answer.valid.mean()), 4)}
        if len(px) < len(every):
            found[name]["against_host"] = _agreement(answer, match_on_host(pair.first, pair.second, px, None, options))
    return found


def _agreement(one: FoundPixels, other: FoundPixels) -> dict[str, float]:
    """Share of pixels on which both say found, or both not; and how far apart they found them, px."""
    both = one.valid & other.valid
    away = np.linalg.norm(one.px - other.px, axis=1)[both]
    apart = [float(f"{v:.2e}") for v in (np.median(away), np.quantile(away, 0.99))] if len(away) else [0.0, 0.0]
    same = round(float((one.valid == other.valid).mean()), 5)
    return {"same_verdict_ratio": same, "apart_px_median": apart[0], "apart_px_99": apart[1]}


@torch.inference_mode()
def dinov2(b: Any) -> dict[str, Any]:
    """DINOv2 S with registers from random weights: alone, and in one queue with the pointmap network."""
    import bench_networks as bench

    images = b.images()
    rng = np.random.default_rng(0)
    photograph = rng.integers(0, 255, (b.size[1], b.size[0], 3), np.uint8)
    call = bench.alone(b.network(b.auto, b.execution), images)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        _random_dinov2(Path(folder), b.small)

        pixels = torch.from_numpy(photograph).to(b.device).permute(2, 0, 1)[None].float() / 255
        for dtype in dict.fromkeys(["float32", b.auto]):
            features = Dinov2Features(folder, str(b.device), dtype)
            found[f"{dtype}, features on the device"] = b.timed(lambda f=features: f.tokens(pixels))
            found[f"{dtype}, from and to numpy"] = b.timed(lambda f=features: f.one(photograph))
            if b.execution == "graph":
                features = _recorded(b, features, folder, dtype, photograph, found)
        prior, cells = ForegroundPrior(), features.one(photograph).features
        found["prior of the features"] = b.timed(lambda: prior(cells))
        found["pointmap network alone"] = b.timed(call)
        found["both, one queue"] = b.timed(lambda: (call(), features.tokens(pixels)))
        if b.device.type == "cuda":
            found["both, two queues"] = b.timed(_beside(call, lambda: features.tokens(pixels)))
    return found


def _recorded(
    b: Any, plain: Dinov2Features, folder: str, dtype: str, photograph: Any, found: dict[str, Any]
) -> Dinov2Features:
    """DINOv2 as a recording, where that can be made; the plain one, and a line about it, where not."""
    try:
        played = Dinov2Features(folder, str(b.device), dtype, recorded=True)
        found[f"{dtype}, from and to numpy, recorded"] = b.timed(lambda: played.one(photograph))
        gap = np.abs(played.one(photograph).features - plain.one(photograph).features).max()
        found[f"{dtype}, largest difference of the recorded"] = float(gap)
    except RuntimeError as e:
        b.result["failed"]["DINOv2 recorded"] = " ".join(str(e).split())[:300]
        return plain
    b.dinov2_recorded = True
    return played


def _beside(one: Callable[[], Any], other: Callable[[], Any]) -> Callable[[], Any]:
    side = torch.cuda.Stream()

    def call() -> Any:
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            b = other()
        a = one()
        torch.cuda.current_stream().wait_stream(side)
        return a, b

    return call


def _random_dinov2(folder: Path, small: bool) -> None:
    from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

    torch.manual_seed(0)
    sizes = (
        {"hidden_size": 48, "num_hidden_layers": 2, "num_attention_heads": 3}
        if small
        else {"hidden_size": 384, "num_hidden_layers": 12, "num_attention_heads": 6}
    )
    config = Dinov2WithRegistersConfig(patch_size=14, image_size=518, num_register_tokens=4, **sizes)
    Dinov2WithRegistersModel(config).save_pretrained(folder)


def loop(b: Any) -> dict[str, Any]:
    """``Slam.track`` over the sequence, against the network alone in the same setting; where the time goes."""
    import bench_networks as bench

    clip = _clip(b)
    if clip is None:
        return {"left_out": "no --sequence"}
    network = b.network(b.auto, b.execution)
    with torch.inference_mode():
        images = [torch.from_numpy(network.prepare(f.image).image[None]).to(b.device) for f in clip.frames[:2]]
        network_alone = b.timed(bench.alone(network, images))
    truth = TruthNetwork(network, clip)
    b.without(network.model, counted=True)
    _tracked(b, truth, min(WARM_FRAMES, len(clip.frames)))
    b.reset_peak()
    found = {"execution": b.execution, "network_alone": network_alone, "loop": _tracked(b, truth, len(clip.frames))}
    with suppress(ImportError):  # transformers
        found["loop_with_dinov2"] = _tracked(b, truth, len(clip.frames), _dinov2_for_its_time(b))
    truth.run_layers = False
    found["loop_without_decoders"] = _tracked(b, truth, len(clip.frames))
    eager = b.result["parts"].get("precision", {}).get("bfloat16")
    if eager and b.execution != "eager":
        found["loop_over_network_layer_by_layer"] = round(found["loop"]["per_s"] / eager["per_s"], 4)
    found["loop_over_network"] = round(found["loop"]["per_s"] / network_alone["per_s"], 4)
    return found


def _dinov2_for_its_time(b: Any) -> Callable[[Frame], Frame]:
    """Features and prior as the package makes them, from random weights; the answer is that nothing is known."""
    with tempfile.TemporaryDirectory() as folder:
        _random_dinov2(Path(folder), b.small)
        recorded = getattr(b, "dinov2_recorded", False)
        features, prior = Dinov2Features(folder, str(b.device), b.auto, recorded), ForegroundPrior()
    unknown = DynamicsConfig().base_rate

    def fill(frame: Frame) -> Frame:
        return replace(frame, semantic=np.full_like(prior(features.one(frame.image).features), unknown))

    return fill


def _tracked(
    b: Any, truth: TruthNetwork, frames: int, semantic: Callable[[Frame], Frame] | None = None
) -> dict[str, Any]:
    """One pass over the first frames: frames/s, what was asked of the network, states, error, milliseconds a stage."""
    clip, config = truth.clip, Config()
    width, height = working_size_of(truth, clip.size)
    matcher = _matcher_of(truth.network)
    most = 4 if b.device.type == "cpu" else 24
    options = {"matcher": matcher, "remembered_pairs": most, "prefetches_pairs": b.device.type != "cpu"}
    provider = Mast3rPointmaps(truth, width, height, config.tracking.cell_px, **options)
    parts = parts_of(provider, config)
    if semantic is not None:
        parts.semantics.fill = semantic
    slam = Slam(config, clip.size, parts=parts)
    truth.encoded = truth.decoded = 0
    stages: dict[str, list[float]] = defaultdict(list)
    reports = []
    with _watched(stages, truth, slam):
        start = time.perf_counter()
        for frame in slam.prefetched(islice(clip.photographs(), frames)):
            reports.append(slam.track(frame))
        b.wait()
        seconds = time.perf_counter() - start
    error = ate_rmse(trajectory_of(final_frames(slam.graph)), clip.truth)
    states = [r.state for r in slam.graph.records]
    ms = {name: round(1e3 * sum(values) / frames, 2) for name, values in stages.items()}
    return {
        "frames": frames, "seconds": round(seconds, 3), "per_s": round(frames / seconds, 2),
        "encoded": truth.encoded, "decoded": truth.decoded,
        "keyframes": sum(r.is_keyframe for r in reports), "ate_rmse_m": error.rmse and round(error.rmse, 5),
        "states": {s: states.count(s) for s in sorted(set(states))},
        "stage_ms_a_frame": dict(sorted(ms.items(), key=lambda item: -item[1])), **b.peak(),
    }  # fmt: skip


@contextmanager
def _watched(stages: dict[str, list[float]], truth: TruthNetwork, slam: Slam) -> Iterator[None]:
    """Time of the stages, host side, each with what it calls; a stage that waits for the device has its time too."""
    provider, keyframes, graph = slam.parts.provider, slam.keyframes, slam.graph
    watched: list[tuple[Any, str, str]] = [
        (truth, "prepare", "network: prepare"), (truth, "encode", "network: encode"),
        (truth, "pairs", "network: pairs"),
        (provider, "matcher", "pair: match pixels"),
        (slam.observer, "observe", "observe (waits for what is looked at ahead)"),
        (provider, "look", "ahead: look, encode"), (provider, "beside", "ahead: decode, own depth"),
        (provider, "predict", "pair: predict"), (slam.masks.filter, "prior", "beside: mask, prior"),
        (slam.masks.filter, "update", "beside: mask, update"), (slam.two_view, "match", "frame: predict, weigh"),
        (slam.aligner, "coarse", "pair: coarse"), (slam.aligner, "scale", "pair: scale"),
        (slam.aligner, "fine", "pair: fine"), (keyframes, "_add", "keyframe: add"),
        (keyframes, "_known_place", "keyframe: known place"), (graph, "solve_window", "keyframe: solve window"),
        (graph, "solve_all", "keyframe: solve all"), (graph, "record", "record"),
        (slam, "track", "whole step"),
    ]  # fmt: skip
    before = [(o, attribute, o.__dict__.get(attribute)) for o, attribute, _ in watched]
    for o, attribute, name in watched:
        setattr(o, attribute, _timing(getattr(o, attribute), stages[name]))
    try:
        yield
    finally:
        for o, attribute, value in before:
            if value is not None:
                setattr(o, attribute, value)
            else:
                with suppress(AttributeError):
                    delattr(o, attribute)


def _timing(call: Callable[..., Any], times: list[float]) -> Callable[..., Any]:
    def timed(*args: Any, **named: Any) -> Any:
        start = time.perf_counter()
        try:
            return call(*args, **named)
        finally:
            times.append(time.perf_counter() - start)

    return timed


def summary(result: dict[str, Any]) -> str:
    """A short table of what was measured."""
    lines = [f"{result['device']}, torch {result['torch']}, {result['size']}, {result['date']}"]
    for part, found in result["parts"].items():
        for name, value in found.items():
            if isinstance(value, dict) and "per_s" in value:
                shown = {k: v for k, v in value.items() if k in ("ms", "peak_mib", "matched_ratio", "ate_rmse_m")}
                lines.append(f"{part:10} {name:34} {value['per_s']:9.2f} /s  {shown}")
            elif not isinstance(value, dict):
                lines.append(f"{part:10} {name:34} {value}")
        for name, value in found.get("loop", {}).get("stage_ms_a_frame", {}).items():
            lines.append(f"{part:10}   {name:32} {value:9.2f} ms a frame")
    lines += [f"{name}: {why}" for kind in ("failed", "left_out") for name, why in result[kind].items()]
    return "\n".join(lines)
