"""Where frames come from: videos, image folders, TUM-layout folders, and a room made in memory."""

from .checks import frame_is_blank
from .open import open_source

__all__ = ["frame_is_blank", "open_source"]
