"""The variant ``ours``: log-odds of motion, depth, semantics, time and appearance, filtered and then smoothed."""

from __future__ import annotations

from .appearance import AppearanceClassifier
from .config import DynamicsConfig
from .filter import LogOddsFilter
from .smoother import ForwardBackwardSmoother


class LogOddsModel:
    """The filter while tracking, the forward-backward smoother once all poses are known."""

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config
        self.needs_features = config.appearance.enabled

    def filter(self, width: int, height: int) -> LogOddsFilter:
        """For images of this working size."""
        return LogOddsFilter(self.config, width, height)

    def smoother(
        self, width: int, height: int, appearance: AppearanceClassifier | None = None
    ) -> ForwardBackwardSmoother:
        """``appearance``: what the filter learned, and the smoother learns on; None: it begins anew."""
        return ForwardBackwardSmoother(self.config, width, height, appearance or AppearanceClassifier(self.config))


def build(config: DynamicsConfig) -> LogOddsModel:
    """For the registry."""
    return LogOddsModel(config)
