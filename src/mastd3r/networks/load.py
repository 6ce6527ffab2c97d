"""A weights file to a network that is ready to be asked. The file's sizes say which of our own constants it is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from .checkpoint import accounted_state, read_state
from .mast3r import Mast3r, Mast3rConfig
from .pair import PairNetwork

SIZES = (Mast3rConfig.released(), Mast3rConfig.tiny())  # numbers of heads cannot be read from shapes


def load_pair_network(
    path: Path, device: str, precision: str, long_side_px: int, execution: str = "eager"
) -> PairNetwork:
    """MASt3R of released or tiny size from a file. Raises CheckpointError, MissingPackage, ConfigError."""
    state = read_state(path)
    with torch.device("meta"):
        model = Mast3r(size_of(state))
    model.load_state_dict(accounted_state(model, state, path), assign=True)
    del state
    return PairNetwork(model.requires_grad_(False).eval(), device, precision, execution, long_side_px)


def size_of(state: Mapping[str, Tensor]) -> Mast3rConfig:
    """The size that the first layer has; the released one where it fits none, so that the faults are told of that."""
    first = state.get("patch_embed.proj.weight")
    width = None if first is None or not first.dim() else first.shape[0]
    return next((size for size in SIZES if size.enc_dim == width), SIZES[0])
