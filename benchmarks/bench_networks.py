"""Speed, memory and precision of the networks and of the loop around them; random weights, no download; writes JSON.

    PYTHONPATH=src python benchmarks/bench_networks.py --out networks.json --sequence FOLDER [--reference DIR]
        [--parts precision graphed reference matching dinov2 loop compiled] [--seconds 280] [--small]

FOLDER is a TUM-layout folder with depth and poses (for the loop and the matching), DIR a checkout of the public MASt3R
with its submodules, as for benchmarks/compare_reference.py. Weights are drawn on the device from a seed, at the size of
the released checkpoint; ``--small`` takes the tiny size, for a test of this file on a CPU.

"Network alone" is what the loop asks for a frame: one encoding, and one decoding of a pair whose other frame is
already encoded, with nothing else in between. ``loop`` is ``Slam.track`` over frames read from files, with a network
that runs the same layers and answers with the truth (benchmarks/truth_network.py), so that frames really track.
The file is written after every part; a part that fails is recorded in one line, and the next one runs.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from copy import deepcopy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does

import numpy as np
import torch
from torch import nn

from mastd3r.errors import SlamError
from mastd3r.networks.mast3r import Encoded, Mast3r, Mast3rConfig, weight_law
from mastd3r.networks.pair import PairNetwork

PARTS = ("precision", "graphed", "reference", "matching", "dinov2", "loop", "compiled")
SETTINGS = {  # name: (precision of ours, TF32 products allowed)
    "float32": ("float32", False),
    "float32, TF32": ("float32", True),
    "float16": ("float16", True),
    "bfloat16": ("bfloat16", True),
}
SIZE = (512, 384)
FAILURES = (RuntimeError, ValueError, TypeError, LookupError, AttributeError, AssertionError, ArithmeticError, OSError,
            ImportError, SlamError)  # fmt: skip


class Bench:
    """What the parts share: device, weights, and how time and memory are taken."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.device = options, torch.device(options.device)
        self.began = time.perf_counter()
        self.small = options.small
        self.config = Mast3rConfig.tiny() if self.small else Mast3rConfig.released()
        self.size = (160, 112) if self.small else SIZE
        self.repeats = 2 if self.small else 20
        self.auto = "float32" if self.device.type == "cpu" else "bfloat16"  # as the package chooses
        self.execution = "eager"  # of the loop: "graph", as the package chooses on CUDA, once the part of it went well
        self._master: Mast3r | None = None
        self._other = (0, 0)  # bytes on the device that belong to other things than the one measured
        self.result: dict[str, Any] = {"parts": {}, "failed": {}, "left_out": {}}

    def master(self) -> Mast3r:
        """Random weights in float32, on the device; drawn there, once."""
        if self._master is None:
            self._master = random_on(self.device, self.config)
        return self._master

    def network(self, setting: str, execution: str = "eager") -> PairNetwork:
        """Ours, in a setting of its own; TF32 is set for everything that follows."""
        precision, tf32 = SETTINGS[setting]
        allow_tf32(tf32)
        self.without(self.master(), False)
        long_side = max(self.size)
        return PairNetwork(deepcopy(self.master()), str(self.device), precision, execution, long_side)

    def left_s(self) -> float:
        return float(self.options.seconds - (time.perf_counter() - self.began))

    def images(self) -> list[torch.Tensor]:
        """Two (1, 3, h, w), in -1 … 1."""
        made = torch.Generator(self.device).manual_seed(1)
        w, h = self.size
        return [torch.rand((1, 3, h, w), generator=made, device=self.device) * 1.4 - 0.7 for _ in range(2)]

    def wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def timed(self, call: Callable[[], Any], repeats: int | None = None, warm: int = 3) -> dict[str, Any]:
        """Milliseconds of one call with the queue emptied after it (median), of many in a row, and peak memory."""
        repeats = repeats or self.repeats
        for _ in range(1 if self.small else warm):
            call()
        self.wait()
        self.reset_peak()
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            call()
            self.wait()
            times.append(1e3 * (time.perf_counter() - start))
        start = time.perf_counter()
        for _ in range(repeats):
            call()
        self.wait()
        row_ms = 1e3 * (time.perf_counter() - start) / repeats
        middle = float(np.median(times))
        found = {"ms": round(middle, 3), "ms_in_a_row": round(row_ms, 3), "per_s": round(1e3 / row_ms, 2)}
        return {**found, **self.peak()}

    def without(self, model: nn.Module, counted: bool) -> None:
        """What is on the device now is not counted in peaks, but for the weights of ``model`` where it is measured."""
        if self.device.type == "cuda":
            gc.collect()
            torch.cuda.empty_cache()
            weights = sum(p.numel() * p.element_size() for p in model.parameters()) if counted else 0
            self._other = torch.cuda.memory_allocated() - weights, torch.cuda.memory_reserved() - weights

    def reset_peak(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()

    def peak(self) -> dict[str, Any]:
        """Largest sum of tensors, and what was taken from the device for it: recordings keep memory of their own."""
        if self.device.type != "cuda":
            return {}
        tensors, taken = torch.cuda.max_memory_allocated(), torch.cuda.max_memory_reserved()
        return {
            "peak_mib": round((tensors - self._other[0]) / 2**20),
            "taken_mib": round((taken - self._other[1]) / 2**20),
        }

    def write(self) -> None:
        self.options.out.write_text(json.dumps(self.result, indent=1) + "\n", encoding="utf-8")


def random_on(device: torch.device, config: Mast3rConfig, seed: int = 0) -> Mast3r:
    """The network with weights drawn on the device by the law of ``seeded_weights``; doubled names share them."""
    with torch.device("meta"):
        model = Mast3r(config)
    model.to_empty(device=device)
    made = torch.Generator(device).manual_seed(seed)
    with torch.no_grad():
        for name, p in model.named_parameters():
            mean, deviation = weight_law(name, tuple(p.shape))
            p.normal_(0, deviation, generator=made).add_(torch.from_numpy(mean).to(device))
    return model.requires_grad_(False).eval()


def allow_tf32(yes: bool) -> None:
    """For matrix products and convolutions alike."""
    torch.set_float32_matmul_precision("high" if yes else "highest")
    torch.backends.cudnn.allow_tf32 = yes


def alone(network: PairNetwork, images: list[torch.Tensor]) -> Callable[[], Any]:
    """One frame of the network alone: encode it, decode it with one that is encoded."""
    keyframe: Encoded = network.encode_images(images[0])

    def call() -> Any:
        return network.decode_views(network.encode_images(images[1]), keyframe)

    return call


@torch.inference_mode()
def precision(b: Bench) -> dict[str, Any]:
    """Frames/s, memory and distance from float32 of every precision."""
    images, found, exact = b.images(), {}, None
    for setting in SETTINGS:
        network = b.network(setting)
        model, call = network.model, alone(network, images)
        found[setting] = b.timed(call)
        found[setting]["encode_ms"] = b.timed(lambda m=model: m.encode(images[1]))["ms_in_a_row"]
        keyframe = model.encode(images[0])
        found[setting]["decode_ms"] = b.timed(lambda m=model, k=keyframe: m.decode(k, k))["ms_in_a_row"]
        many = Encoded(keyframe.tokens.expand(8, -1, -1).contiguous(), keyframe.grid)
        found[setting]["decode_8_pairs_ms"] = b.timed(lambda m=model, k=many: m.decode(k, k))["ms_in_a_row"]
        outputs = call()
        exact = exact or outputs
        found[setting]["relative_error"] = errors(outputs, exact)
        del network, model, call, keyframe, many
    return found


def errors(ours: Any, theirs: Any) -> dict[str, list[float]]:
    """Relative error of every output over both views' pixels: median, 99 %, largest."""
    found = {}
    for name in ("points", "confidence", "descriptors", "descriptor_confidence"):
        every = []
        for a, b in zip(ours, theirs, strict=True):
            x, y = (getattr(v, name).double() for v in (a, b))
            vector = x.dim() == 4
            gap, length = ((x - y).norm(dim=-1), y.norm(dim=-1)) if vector else ((x - y).abs(), y.abs())
            every.append((gap / length.clamp_min(1e-12)).reshape(-1).cpu().numpy())
        values = np.concatenate(every)
        found[name] = [float(f"{v:.3e}") for v in (np.median(values), np.quantile(values, 0.99), values.max())]
    return found


@torch.inference_mode()
def graphed(b: Bench) -> dict[str, Any]:
    """The network alone, recorded: what is left when nothing waits for launches. What ``auto`` takes on CUDA."""
    if b.device.type != "cuda":
        return {"left_out": "no CUDA device"}
    images, found = b.images(), {}
    exact = alone(b.network("float32"), images)()
    for setting in SETTINGS:
        call = alone(b.network(setting, "graph"), images)
        found[setting] = {**b.timed(call), "relative_error": errors(call(), exact)}
    b.execution = "graph"
    return found


def compiled(b: Bench) -> dict[str, Any]:
    """torch.compile in a process of its own, which is ended when the time is up."""
    if b.options.compile_here:
        with torch.inference_mode():
            model = b.network(b.auto, "compile")
            start = time.perf_counter()
            images = b.images()
            call = alone(model, images)
            call()
            b.wait()
            first_s = round(time.perf_counter() - start, 1)
            return {b.auto: {"first_call_s": first_s, **b.timed(call)}}
    limit_s = min(b.left_s() - 5, b.options.compile_seconds)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "compiled.json"
        words = [sys.executable, __file__, "--parts", "compiled", "--compile-here", "--out", str(out)]
        words += ["--device", str(b.device), *(["--small"] if b.small else [])]
        try:
            subprocess.run(words, timeout=max(limit_s, 1), check=True, capture_output=True, text=True)
        except subprocess.TimeoutExpired:
            return {"left_out": f"not compiled within {limit_s:.0f} s"}
        except subprocess.CalledProcessError as e:
            return {"left_out": "failed: " + " ".join(e.stderr.split())[-400:]}
        found = json.loads(out.read_text(encoding="utf-8"))
    return found["parts"].get("compiled") or {"left_out": found["failed"].get("compiled", "nothing was written")}


@torch.inference_mode()
def reference(b: Bench) -> dict[str, Any]:
    """The public network with the same weights, in its own setting and others, and how far ours is from it."""
    if b.options.reference is None:
        return {"left_out": "no --reference"}
    from dataclasses import replace

    from compare_reference import own_network, reference_network, run_own, run_reference

    config = replace(b.config, dec_depth=12) if b.small else b.config  # it takes no fewer than 10 decoder layers
    state = (random_on(b.device, config) if b.small else b.master()).state_dict()
    net = reference_network(b.options.reference, config, state)
    model = own_network(net, config)
    one, two = b.images()
    b.without(net, counted=True)  # it shares the weights
    allow_tf32(False)
    theirs, ours = run_reference(net, one, two), run_own(model, one, two)
    found: dict[str, Any] = {"own_from_reference": errors(_as_outputs(ours), _as_outputs(theirs))}
    found["rope"] = type(net.rope).__module__  # "models.curope…" where its own CUDA kernel was built
    shape = torch.tensor([one.shape[-2:]])
    keyframe, at, _ = net._encode_image(one, shape)

    def call(dtype: torch.dtype | None) -> Any:
        with torch.autocast(b.device.type, dtype, enabled=dtype is not None):
            tokens, here, _ = net._encode_image(two, shape)
            dec1, dec2 = net._decoder(tokens, here, keyframe, at)
        return [net._downstream_head(n, [t.float() for t in dec], shape) for n, dec in ((1, dec1), (2, dec2))]

    # its demos and its inference: float32 without autocast, TF32 allowed for matrix products; autocast on request
    for name, tf32, dtype in (
        ("float32, TF32 (its own)", True, None),
        ("float32", False, None),
        ("autocast float16", True, torch.float16),
        ("autocast bfloat16", True, torch.bfloat16),
    ):
        if b.device.type == "cpu" and dtype is torch.float16:
            continue
        allow_tf32(tf32)
        found[name] = b.timed(lambda d=dtype: call(d))
    return found


def _as_outputs(views: list[dict[str, torch.Tensor]]) -> list[Any]:
    return [argparse.Namespace(**view) for view in views]


@contextmanager
def _evidence(b: Bench, name: str) -> Any:
    """Record what a part gave, or in one line why it gave nothing."""
    start = time.perf_counter()
    try:
        yield
    except FAILURES as e:  # whatever happened, the other parts are still to be measured
        b.result["failed"][name] = f"{type(e).__name__}: {' '.join(str(e).split())[:300]}"
        traceback.print_exc()
    b.result.setdefault("part_s", {})[name] = round(time.perf_counter() - start, 1)
    if b.device.type == "cuda":
        with torch.inference_mode():
            torch.cuda.empty_cache()
    b.write()


def machine(b: Bench) -> dict[str, Any]:
    cuda = b.device.type == "cuda"
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"), "device": torch.cuda.get_device_name() if cuda else "cpu",
        "torch": torch.__version__, "python": platform.python_version(), "cores": os.cpu_count(),
        "size": f"{b.size[0]}x{b.size[1]}", "small": b.small,
        "parameters": sum(p.numel() for p in b.master().parameters()),
        "command": "python benchmarks/bench_networks.py " + " ".join(_words()),
    }  # fmt: skip


def _words() -> list[str]:
    """The command line, with names in place of this machine's paths."""
    words = list(sys.argv[1:])
    for option, name in (
        ("--out", "benchmarks/results/networks.json"),
        ("--sequence", "SEQUENCE"),
        ("--reference", "DIR"),
    ):
        if option in words:
            words[words.index(option) + 1] = name
    return words


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON, written after every part")
    parser.add_argument("--sequence", type=Path, help="TUM-layout folder with depth and poses")
    parser.add_argument("--reference", type=Path, help="checkout of the reference implementation")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seconds", type=float, default=280, help="parts are not begun after this")
    parser.add_argument("--compile-seconds", type=float, default=150, help="torch.compile is given up after this")
    parser.add_argument("--compile-here", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--frames", type=int, default=100, help="of the sequence")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--small", action="store_true", help="the tiny network, few repeats")
    b = Bench(parser.parse_args())
    import bench_networks_loop as more  # the parts with a sequence

    parts = {
        "precision": precision, "matching": more.matching, "dinov2": more.dinov2, "reference": reference,
        "loop": more.loop, "graphed": graphed, "compiled": compiled,
    }  # fmt: skip
    b.result.update(machine(b))
    for name in b.options.parts:
        if b.left_s() < 10:
            b.result["left_out"][name] = "no time left"
            continue
        with _evidence(b, name):
            found = parts[name](b)
            left_out = found.get("left_out")
            b.result["left_out" if left_out else "parts"][name] = left_out or found
        print(f"{name}: {b.result['part_s'][name]} s", flush=True)
    b.result["seconds"] = round(time.perf_counter() - b.began, 1)
    b.write()
    print(more.summary(b.result))


if __name__ == "__main__":
    main()
