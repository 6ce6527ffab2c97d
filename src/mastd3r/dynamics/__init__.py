"""What moves and what does not (paper III-A)."""

from .belief import DynamicBelief
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput

__all__ = ["DynamicBelief", "DynamicMask", "DynamicsConfig", "DynamicsInput"]
