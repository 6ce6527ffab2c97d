"""What the map may cost: image size, steps and Gaussians of a quality, on the device that it lives on."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..config import MappingConfig, MapQualityKind


@dataclass(frozen=True)
class Effort:
    """Of a quality. Images are never enlarged."""

    width_px: int  # widest
    area_px: int  # most pixels an image
    iterations: int
    max_gaussians: int
    sh_degree: int


CPU: dict[MapQualityKind, Effort] = {
    "draft": Effort(320, 320 * 240, 800, 25_000, 0),
    "standard": Effort(1280, 1280 * 375, 3600, 100_000, 0),
    "high": Effort(1280, 1280 * 720, 10_000, 300_000, 1),
}
ACCELERATOR: dict[MapQualityKind, Effort] = {
    "draft": Effort(640, 640 * 480, 2000, 100_000, 0),
    "standard": Effort(1920, 1920 * 1080, 15_000, 600_000, 3),
    "high": Effort(3840, 3840 * 2160, 30_000, 2_000_000, 3),
}


def resolved(config: MappingConfig, size: tuple[int, int], device: str) -> MappingConfig:
    """The options with a number for everything that the quality decides; what was given as a number stays.

    ``size``: width and height of the photographs.
    """
    effort = (CPU if device == "cpu" else ACCELERATOR)[config.quality]
    width, height = size
    by_area = int(width * min(1.0, (effort.area_px / max(1, width * height)) ** 0.5))
    return replace(
        config,
        width_px=config.width_px or max(8, min(width, effort.width_px, by_area)),
        iterations=config.iterations if config.iterations is not None else effort.iterations,
        max_gaussians=config.max_gaussians or effort.max_gaussians,
        sh_degree=config.sh_degree if config.sh_degree is not None else effort.sh_degree,
    )
