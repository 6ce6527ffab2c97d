"""What moves and what does not (paper III-A)."""

from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .filter import LogOddsFilter
from .smoother import ForwardBackwardSmoother

__all__ = ["DynamicMask", "DynamicsConfig", "DynamicsInput", "ForwardBackwardSmoother", "LogOddsFilter"]
