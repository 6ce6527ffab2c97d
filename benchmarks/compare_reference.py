"""Our MASt3R against the public reference implementation, with the same random weights; writes JSON.

    python benchmarks/compare_reference.py --reference DIR [--sizes 512x384 512x288 384x512] [--repeats 3]

DIR is your own checkout of https://github.com/naver/mast3r with its submodules; its requirements (einops, and
torchvision for the preprocessing) must be importable. Nothing of it is in this repository and its licence is its own
(CC BY-NC-SA 4.0). No weights are needed: every weight is drawn from its name and a seed.

Errors are the largest over all pixels: length of the difference / length of the reference's vector for points and
descriptors, difference / value for confidences. Times are of encoding both images and decoding the pair once.
``--float64`` runs the reference in double precision as well and says how far from it each of the two is.

``--store FILE`` writes outputs of a small network at chosen pixels, for tests/test_networks_mast3r.py.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from mastd3r.networks.mast3r import Mast3r, Mast3rConfig, seeded_weights
from mastd3r.networks.pair import PRECISIONS, PairNetwork
from mastd3r.networks.preprocess import prepare_image

INF = float("inf")
SEED = 0
NAMES = {"points": "pts3d", "confidence": "conf", "descriptors": "desc", "descriptor_confidence": "desc_conf"}
SMALL = replace(Mast3rConfig.tiny(), dec_depth=12)  # the reference takes no fewer than 10 decoder layers
SMALL_CASES = {"landscape": ((64, 48), (64, 48)), "odd": ((80, 48), (80, 48)), "mixed": ((48, 80), (64, 48))}
SMALL_PIXELS = 120
PHOTOGRAPHS = ((640, 480), (480, 640), (1242, 375), (300, 201), (500, 500), (1023, 767), (2000, 1125))


def reference_network(
    folder: Path, config: Mast3rConfig, state: dict[str, torch.Tensor] | None = None
) -> torch.nn.Module:
    """The reference's network of our sizes, with the seeded weights or those of a state by its names."""
    sys.path[:0] = [str(folder), str(folder / "dust3r"), str(folder / "dust3r" / "croco")]
    from mast3r.model import AsymmetricMASt3R

    c = config
    with torch.device("meta"):
        net = AsymmetricMASt3R(
            pos_embed="RoPE100", patch_embed_cls="PatchEmbedDust3R", img_size=(512, 512), head_type="catmlp+dpt",
            output_mode=f"pts3d+desc{c.descriptor_dim}", depth_mode=("exp", -INF, INF), conf_mode=("exp", 1, INF),
            enc_embed_dim=c.enc_dim, enc_depth=c.enc_depth, enc_num_heads=c.enc_heads, dec_embed_dim=c.dec_dim,
            dec_depth=c.dec_depth, dec_num_heads=c.dec_heads, two_confs=True, desc_conf_mode=("exp", 0, INF),
            landscape_only=False,
        )  # fmt: skip
        if c.dpt_channels != Mast3rConfig.released().dpt_channels:
            for head in (net.downstream_head1, net.downstream_head2):
                head.dpt = type(head.dpt)(
                    num_channels=4, hooks=list(c.hooks), layer_dims=list(c.dpt_layer_dims),
                    feature_dim=c.dpt_channels, last_dim=c.dpt_last, head_type="regression",
                )  # fmt: skip
                head.dpt.init([c.enc_dim, c.dec_dim, c.dec_dim, c.dec_dim])
    if state is None:
        shapes = {name: tuple(value.shape) for name, value in net.state_dict().items()}
        state = {name: torch.from_numpy(value) for name, value in seeded_weights(shapes, SEED).items()}
    torch.nn.Module.load_state_dict(net, state, assign=True)
    return net.requires_grad_(False).eval()


def own_network(reference: torch.nn.Module, config: Mast3rConfig) -> Mast3r:
    """Ours with the reference's very tensors, by name; raises where a name or a shape differs."""
    with torch.device("meta"):
        model = Mast3r(config)
    model.load_state_dict(reference.state_dict(), strict=True, assign=True)
    return model.requires_grad_(False).eval()


def image_batch(width: int, height: int, seed: int) -> torch.Tensor:
    """(1, 3, h, w) in -1 … 1: noise at two scales, drawn by numpy."""
    rng = np.random.RandomState(seed)
    coarse = np.kron(rng.uniform(-0.7, 0.7, (3, height // 16, width // 16)), np.ones((1, 16, 16)))
    return torch.from_numpy((coarse + rng.uniform(-0.3, 0.3, (3, height, width))).astype(np.float32)[None])


def run_reference(net: torch.nn.Module, one: torch.Tensor, two: torch.Tensor) -> list[dict[str, torch.Tensor]]:
    """The reference's forward pass; one dictionary a view, with our names."""
    views = [
        {"img": image, "true_shape": torch.tensor([image.shape[-2:]]), "instance": [str(n)]}
        for n, image in enumerate((one, two))
    ]
    out1, out2 = net(*views)
    out2 = {**out2, "pts3d": out2["pts3d_in_other_view"]}
    return [{ours: out[theirs] for ours, theirs in NAMES.items()} for out in (out1, out2)]


def run_own(model: Mast3r, one: torch.Tensor, two: torch.Tensor) -> list[dict[str, torch.Tensor]]:
    """The same of ours."""
    if one.shape == two.shape:
        both = model.encode(torch.cat([one, two]))
        a, b = (type(both)(both.tokens[n : n + 1], both.grid) for n in (0, 1))
    else:
        a, b = model.encode(one), model.encode(two)
    return [{name: getattr(out, name) for name in NAMES} for out in model.decode(a, b)]


def relative_error(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    """Largest over the pixels; see the head of this file."""
    vector = ours.dim() == 4
    difference = (ours - theirs).norm(dim=-1) if vector else (ours - theirs).abs()
    size = theirs.norm(dim=-1) if vector else theirs.abs()
    return float((difference / size).max())


def timed(device: str, call: Callable[[], Any]) -> tuple[Any, float]:
    """(result, seconds), the device's queue included."""
    waits = torch.device(device).type != "cpu"
    module = torch.get_device_module(device) if waits else None
    if module:
        module.synchronize()
    start = time.perf_counter()
    result = call()
    if module:
        module.synchronize()
    return result, time.perf_counter() - start


@torch.inference_mode()
def compared(
    net: torch.nn.Module, model: Mast3r, size: tuple[int, int], repeats: int, device: str, float64: bool
) -> dict[str, Any]:
    """Errors, the spread of the reference's outputs (so that nobody takes zeros for agreement), and times."""
    one, two = (image_batch(*size, seed).to(device) for seed in (1, 2))
    calls = {"own": lambda: run_own(model, one, two), "reference": lambda: run_reference(net, one, two)}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for n in range(repeats):
        outputs = {}
        for name in list(calls)[:: 1 if n % 2 else -1]:
            outputs[name], seconds = timed(device, calls[name])
            times[name].append(round(seconds, 4))
    errors = {
        f"{name}{view}": relative_error(ours[name], theirs[name])
        for view, (ours, theirs) in enumerate(zip(outputs["own"], outputs["reference"], strict=True), 1)
        for name in NAMES
    }
    spread = {
        f"{name}{view}": [round(float(v), 4) for v in (out[name].mean(), out[name].std(), out[name].abs().max())]
        for view, out in enumerate(outputs["reference"], 1)
        for name in NAMES
    }
    truth = in_float64(net, one, two) if float64 else None
    from_truth = {
        f"{name}{view}": {who: relative_error(outputs[who][view - 1][name].double(), out[name]) for who in calls}
        for view, out in enumerate(truth or [], 1)
        for name in NAMES
    }
    middle = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "size": f"{size[0]}x{size[1]}", "max_relative_error": errors, "reference_mean_std_max": spread,
        **({"max_relative_error_from_float64": from_truth} if float64 else {}),
        "seconds": times, "own_over_reference": round(middle["own"] / middle["reference"], 4),
    }  # fmt: skip


def in_float64(net: torch.nn.Module, one: torch.Tensor, two: torch.Tensor) -> list[dict[str, torch.Tensor]]:
    """The reference in double precision. It asks for ``.float()`` before its heads, which would end that."""
    weights = net.state_dict()
    asked = torch.Tensor.float
    try:
        torch.Tensor.float = torch.Tensor.double
        net.double()
        return run_reference(net, one.double(), two.double())
    finally:
        torch.Tensor.float = asked
        torch.nn.Module.load_state_dict(net, weights, assign=True)


def photograph(width: int, height: int) -> np.ndarray:
    """(h, w, 3) uint8: smooth colours and noise, drawn by numpy."""
    rng = np.random.RandomState(width * 10000 + height)
    y, x = np.mgrid[0:height, 0:width]
    wave = np.stack([np.sin(x / 31 + c) * np.cos(y / 23 - c) for c in range(3)], -1)
    return (127.5 + 80 * wave + rng.uniform(-40, 40, (height, width, 3))).astype(np.uint8)


def compared_preprocessing() -> dict[str, Any]:
    """Largest difference of the network images, by the reference's loader and ours."""
    try:
        from dust3r.utils.image import load_images
    except ImportError as e:
        return {"left_out": f"{e}"}
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for width, height in PHOTOGRAPHS:
            image, path = photograph(width, height), Path(folder) / f"{width}x{height}.png"
            Image.fromarray(image).save(path)
            theirs = load_images([str(path)], size=512, verbose=False)[0]["img"][0].numpy()
            ours, _ = prepare_image(image)
            same = ours.shape == theirs.shape
            found[f"{width}x{height}"] = {
                "network_size": f"{ours.shape[2]}x{ours.shape[1]}",
                "max_difference": float(np.abs(ours - theirs).max()) if same else f"theirs is {theirs.shape}",
            }
    return found


@torch.inference_mode()
def stored(folder: Path, path: Path) -> dict[str, Any]:
    """Outputs of the reference's small network at chosen pixels, and the errors of ours there."""
    net = reference_network(folder, SMALL)
    model = own_network(net, SMALL)
    arrays, errors = {}, {}
    for case, (size1, size2) in SMALL_CASES.items():
        one, two = image_batch(*size1, 1), image_batch(*size2, 2)
        theirs, ours = run_reference(net, one, two), run_own(model, one, two)
        for view, out in enumerate(theirs, 1):
            h, w = out["confidence"].shape[1:]
            rng = np.random.RandomState(view)
            pixels = np.stack([rng.randint(0, h, SMALL_PIXELS), rng.randint(0, w, SMALL_PIXELS)], 1)
            arrays[f"{case}.{view}.pixels_yx"] = pixels.astype(np.int32)
            for name, value in out.items():
                arrays[f"{case}.{view}.{name}"] = value[0].numpy()[pixels[:, 0], pixels[:, 1]]
                errors[f"{case}.{view}.{name}"] = relative_error(ours[view - 1][name], value)
    np.savez_compressed(path, **arrays)
    return {"stored": path.name, "bytes": path.stat().st_size, "max_relative_error": errors}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, required=True, help="checkout of the reference implementation")
    parser.add_argument("--sizes", nargs="*", default=["512x384", "512x288", "384x512"], help="WxH of the images")
    parser.add_argument("--repeats", type=int, default=3, help="pairs of each, in turn")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--own-precision", choices=PRECISIONS, default="float32", help="of ours; theirs is float32")
    parser.add_argument("--compile", action="store_true", help="torch.compile for ours")
    parser.add_argument("--float64", action="store_true", help="judge both by double precision: 8.5 GB more memory")
    parser.add_argument("--tf32", action="store_true", help="allow TF32 products, for both")
    parser.add_argument("--store", type=Path, help="write the small network's outputs here, and do nothing else")
    parser.add_argument("--out", type=Path, help="write the JSON here as well")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    torch.set_float32_matmul_precision("high" if options.tf32 else "highest")
    if options.store:
        result = stored(options.reference, options.store)
    else:
        config = Mast3rConfig.released()
        net = reference_network(options.reference, config).to(options.device)
        model = own_network(net, config)
        PairNetwork(model, options.device, options.own_precision, "compile" if options.compile else "eager")
        sizes = [tuple(int(v) for v in size.split("x")) for size in options.sizes]
        result = {
            "torch": torch.__version__, "machine": platform.processor() or platform.machine(),
            "device": options.device, "threads": torch.get_num_threads(), "tf32": options.tf32,
            "own_precision": options.own_precision, "compiled": options.compile,
            "names": len(model.state_dict()), "parameters": sum(p.numel() for p in model.parameters()),
            "preprocessing": compared_preprocessing(),
            "pairs": [
                compared(net, model, size, options.repeats, options.device, options.float64) for size in sizes
            ],
        }  # fmt: skip
    text = json.dumps(result, indent=1)
    print(text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
