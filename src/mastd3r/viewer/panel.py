"""The panel beside the scene: what is shown, the frame under the slider, layers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from viser import ViserServer

Array = NDArray[Any]
POINT_SIZES = (0.1, 5.0, 0.1)  # least, most, step, of the size that a cloud comes with
NO_IMAGE = np.zeros((1, 1, 3), np.uint8)


class Panel:
    """Widgets, and who is told of them. ``clients`` of a callback: those who asked, None: all."""

    def __init__(self, server: ViserServer) -> None:
        gui = server.gui
        self._gui = gui
        self._notices = gui.add_markdown("")
        with gui.add_folder("Time"):
            self.frame = gui.add_slider("Frame", 0, 1, 1, 0, disabled=True)
            self._about_frame = gui.add_markdown("")
            self.jump = gui.add_button("Jump to this camera", disabled=True)
            self.follow = gui.add_checkbox("Follow", False, hint="the view goes along with the frame")
            self._image = gui.add_image(NO_IMAGE, visible=False)
            self.masked = gui.add_checkbox("What moves", True, visible=False)
            self._about_image = gui.add_markdown("")
        self._layers = gui.add_folder("Layers")
        with self._layers:
            self.point_size = gui.add_slider("Point size", *POINT_SIZES, 1.0, visible=False)

    def say(self, lines: list[str]) -> None:
        """What is to be known of the whole, a line each."""
        self._notices.content = "\n\n".join(_plain(line) for line in lines)

    def add_layer(self, label: str, visible: bool, told: Callable[[bool], None]) -> None:
        """A checkbox; ``told`` whenever it changes."""
        with self._layers:
            box = self._gui.add_checkbox(label, visible)
        box.on_update(lambda _: told(bool(box.value)))

    def show_point_size(self) -> None:
        """There is a cloud."""
        self.point_size.visible = True

    def set_count(self, count: int) -> None:
        """How many frames the slider goes over."""
        self.frame.max = max(1, count - 1)
        self.frame.disabled = count < 2
        self.jump.disabled = count < 1

    def set_frame(self, text: str) -> None:
        """What is known of the frame under the slider."""
        self._about_frame.content = _plain(text)

    def set_image(self, image: Array | None, has_mask: bool, text: str) -> None:
        """The picture of that frame (h, w, 3) uint8, or none; and where it comes from, or what is missing."""
        if image is not None:
            self._image.image = image
        self._image.visible = image is not None
        self.masked.visible = has_mask
        self._about_image.content = _plain(text)


def _plain(text: str) -> str:
    """Text that Markdown shows as it is, but for line ends."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>#|!~$" else c for c in text)
