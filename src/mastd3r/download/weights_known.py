"""The weights that this package knows: where they come from, how large they are, which licence they have.

Sizes and checksums are those of the released files, each found in more than one public record of them. A file without
a checksum here is held to the one that the hub lists for it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Literal

HUB = "https://huggingface.co"  # HF_ENDPOINT names a mirror


@dataclass(frozen=True)
class Licence:
    """What a user must agree with before weights are fetched."""

    key: str
    title: str
    text: str


@dataclass(frozen=True)
class KnownFile:
    """One released file."""

    name: str
    size_bytes: int | None = None
    sha256: str | None = None


@dataclass(frozen=True)
class Origin:
    """A place that has all files of some weights: a revision of a hub repository, or a folder URL."""

    files: tuple[KnownFile, ...]
    hub_id: str = ""
    revision: str = "main"
    folder_url: str = ""

    @property
    def page(self) -> str:
        """Where a person finds the files."""
        return f"{hub()}/{self.hub_id}" if self.hub_id else self.folder_url

    def url(self, name: str) -> str:
        """Where a program finds one file."""
        return f"{hub()}/{self.hub_id}/resolve/{self.revision}/{name}" if self.hub_id else f"{self.folder_url}/{name}"


@dataclass(frozen=True)
class Known:
    """Weights by name. ``origins`` in order of preference; any one of them is enough."""

    name: str
    what: str
    licence: Licence
    origins: tuple[Origin, ...]
    form: Literal["file", "folder"]  # what a loader is given


def hub() -> str:
    """Address of the hub, or of the mirror that HF_ENDPOINT names."""
    return os.environ.get("HF_ENDPOINT", "").rstrip("/") or HUB


MAST3R_LICENCE = Licence(
    "mast3r",
    "CC BY-NC-SA 4.0",
    "The MASt3R weights belong to Naver Corporation and are under CC BY-NC-SA 4.0: no commercial use; name the authors;"
    " pass on under the same terms (https://creativecommons.org/licenses/by-nc-sa/4.0/). They were trained on data sets"
    " with terms of their own, the Map-free data set among them, which bind their users too:"
    " https://github.com/naver/mast3r/blob/main/CHECKPOINTS_NOTICE. The Apache-2.0 licence of this program does not"
    " cover them.",
)
DINOV2_LICENCE = Licence(
    "dinov2",
    "Apache-2.0",
    "The DINOv2 weights belong to Meta Platforms and are under the Apache License 2.0"
    " (https://github.com/facebookresearch/dinov2/blob/main/LICENSE).",
)

MAST3R = "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
MAST3R_WEIGHTS = Known(
    "mast3r",
    "MASt3R, two-view pointmaps, ViT-L, metric",
    MAST3R_LICENCE,
    (
        Origin(
            (
                KnownFile(
                    "model.safetensors",
                    2_754_661_648,
                    "0a615eb05fa9db654050aa655945ee5696e7c6c1b7f93f1ee8c37249010f6feb",
                ),
            ),
            hub_id=f"naver/{MAST3R}",
            revision="06e7259f34c3060f322df5cb0c7b9094f57e41fc",
        ),
        Origin(
            (
                KnownFile(
                    f"{MAST3R}.pth",
                    2_754_910_614,
                    "e28f91b488554653e2b46ddae9c78c1143e0bcb2e27d3e26cdb0b717f1568eb2",
                ),
            ),
            folder_url="https://download.europe.naverlabs.com/ComputerVision/MASt3R",
        ),
    ),
    "file",
)


def _dinov2(size: str, registers: bool, revision: str, weights: KnownFile) -> Known:
    name = f"dinov2-with-registers-{size}" if registers else f"dinov2-{size}"
    letter, channels = {"small": ("S", 384), "base": ("B", 768), "large": ("L", 1024)}[size]
    what = f"DINOv2 ViT-{letter}/14{' with registers' if registers else ''}, {channels} channels"
    files = (KnownFile("config.json"), weights)
    return Known(name, what, DINOV2_LICENCE, (Origin(files, f"facebook/{name}", revision),), "folder")


_UNPINNED = KnownFile("model.safetensors")
KNOWN: dict[str, Known] = {
    known.name: known
    for known in (
        MAST3R_WEIGHTS,
        _dinov2("small", True, "0d9846e56b43a21fa46d7f3f5070f0506a5795a9", _UNPINNED),
        _dinov2("base", True, "a1d738ccfa7ae170945f210395d99dde8adb1805", _UNPINNED),
        _dinov2("large", True, "e4c89a4e05589de9b3e188688a303d0f3c04d0f3", _UNPINNED),
        _dinov2(
            "small",
            False,
            "ed25f3a31f01632728cabb09d1542f84ab7b0056",
            KnownFile(
                "model.safetensors",
                88_249_960,
                "ae1e99fcefd534ed978cdeb8326f08030c96e28b7a81ffcbc98a857c84d14be1",
            ),
        ),
        _dinov2(
            "base",
            False,
            "f9e44c814b77203eaa57a6bdbbd535f21ede1415",
            KnownFile(
                "model.safetensors",
                346_345_912,
                "d73036b56966966d07975d696bde331762f37297e2f095de8cea0040c3aa0841",
            ),
        ),
        _dinov2(
            "large",
            False,
            "47b73eefe95e8d44ec3623f8890bd894b6ea2d6c",
            KnownFile(
                "model.safetensors",
                1_217_522_888,
                "399fba97a95f22c36834418bc69373364a99af3a1153da1c0fb31db567c92e23",
            ),
        ),
    )
}
DEFAULT_DINOV2 = "dinov2-with-registers-small"
