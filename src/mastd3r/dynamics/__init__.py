"""What moves and what does not (paper III-A)."""

from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .filter import LogOddsFilter

__all__ = ["DynamicMask", "DynamicsConfig", "DynamicsInput", "LogOddsFilter"]
