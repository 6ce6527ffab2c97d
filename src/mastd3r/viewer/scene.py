"""What the browser shows, as stages would say it: frames, clouds, a splat, the picture of a frame.

A finished run fills it once (``show_run.py``); a run under way can fill it frame by frame, from any thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..export.mesh_files import linear
from ..export.pictures import fitted, mask_overlay
from ..mapping.gaussian_arrays import GaussianArrays
from ..types import State
from .panel import Panel
from .path import FOV_UNKNOWN_RAD, SELECTED_COLOUR, CameraPath, corner_rays, upright
from .server import close_server
from .splat import splat_buffers

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

Array = NDArray[Any]
Layer = Literal["splat", "dense", "mesh", "sparse", "path"]
LABELS: dict[Layer, str] = {
    "splat": "Splat",
    "dense": "Dense cloud",
    "mesh": "Mesh",
    "sparse": "Sparse cloud",
    "path": "Camera path",
}
FRAMES_A_NODE = 64  # a frame that is added sends again the lines of at most so many
FRUSTUM_RATIO, LINE_PX = 0.03, 1.5  # frusta in typical depths
NEAR_RATIO, FAR_RATIO = 1e-3, 1e4  # clipping planes in typical depths
IMAGE_WIDTH_PX = 640
WORLD_FROM_GLB = (0.0, 1.0, 0.0, 0.0)  # quaternion wxyz: glTF is right, up, back, a half turn about x
POINT_SIZE_RATIO = 1 / 500  # of the typical depth, where a cloud does not say what its points stand for


class Scene:
    """The scene of a server and the panel beside it. Lengths are map units, axes OpenCV's, the world's up is -y.

    Every method may be called from any thread, and again: what was there is replaced. Splat and clouds are sent whole.
    """

    def __init__(self, server: ViserServer, camera: Camera | None = None, typical_depth: float = 1.0) -> None:
        """``server``: of ``open_server``; ``close`` ends it. ``camera``: the lens over the full-size image, None where
        it is not known. ``typical_depth``: of the scene from a camera, which sizes are drawn by."""
        self._server, self._camera, self._depth = server, camera, float(typical_depth)
        self._lock = threading.RLock()
        self._path = CameraPath(corner_rays(camera), FRUSTUM_RATIO * self._depth)
        self._times_s: list[float] = []
        self._clouds: dict[Layer, tuple[Any, float]] = {}  # handle, point size
        self._layers: dict[Layer, Any] = {}
        self._image: Array | None = None
        self._mask: Array | None = None
        self._about_image = ""
        self._selected = -1
        self._on_select: Callable[[int], None] = lambda index: None
        server.scene.set_background_image(np.zeros((1, 1, 3), np.uint8))
        server.initial_camera.near = NEAR_RATIO * self._depth
        server.initial_camera.far = FAR_RATIO * self._depth
        self.panel = Panel(server)
        self.panel.frame.on_update(lambda _: self.select(int(self.panel.frame.value)))
        self.panel.jump.on_click(lambda event: self.jump(None if event.client is None else [event.client]))
        self.panel.follow.on_update(lambda _: self._followed())
        self.panel.masked.on_update(lambda _: self._show_image())
        self.panel.point_size.on_update(lambda _: self._size_points())
        server.on_client_connect(lambda _: self._on_select(self._selected) if self._selected >= 0 else None)

    # frames

    def add_frame(self, timestamp_s: float, world_from_cam: Array | None, state: State) -> None:
        """One more frame, in order of time: its pose (4, 4), None where it has none. The view opens at the first."""
        self.add_frames([timestamp_s], [world_from_cam], [state])

    def add_frames(
        self, times_s: Sequence[float], world_from_cam: Sequence[Array | None], states: Sequence[State]
    ) -> None:
        """Several at once, as ``add_frame``."""
        with self._lock:
            first = len(self._path)
            for pose, state in zip(world_from_cam, states, strict=True):
                self._path.add(pose, state)
            self._times_s += [float(t) for t in times_s]
            self._draw_path(first)
            self.panel.set_count(len(self._path))
            opening = next((i for i in range(len(self._path)) if self._path.pose(i) is not None), None)
            if opening is not None and opening >= first:
                self._open_at(opening)
            if self._selected < 0 and len(self._path):
                self.select(0 if opening is None else opening)

    def replace_frames(
        self, times_s: Sequence[float], world_from_cam: Sequence[Array | None], states: Sequence[State]
    ) -> None:
        """All frames anew, as after a joint optimisation has moved them; the view stays where it is."""
        with self._lock:
            drawn, kept = len(self._path), self._selected
            self._path = CameraPath(corner_rays(self._camera), FRUSTUM_RATIO * self._depth)
            for pose, state in zip(world_from_cam, states, strict=True):
                self._path.add(pose, state)
            self._times_s = [float(t) for t in times_s]
            for node in range(-(-len(self._path) // FRAMES_A_NODE), -(-drawn // FRAMES_A_NODE)):
                self._server.scene.remove_by_name(f"/path/{node}")
            self._draw_path(0)
            self.panel.set_count(len(self._path))
            self._selected = -1
            if len(self._path):
                self.select(min(max(kept, 0), len(self._path) - 1))

    def on_select(self, told: Callable[[int], None]) -> None:
        """``told`` gets the index of the frame under the slider whenever it changes, and when a browser comes.

        It may call ``set_image``.
        """
        self._on_select = told

    def select(self, index: int) -> None:
        """Put the slider on a frame."""
        with self._lock:
            if index == self._selected or not 0 <= index < len(self._path):
                return
            self._selected = index
            if int(self.panel.frame.value) != index:
                self.panel.frame.value = index
            pose = self._path.pose(index)
            where = "" if pose is not None else ", no pose"
            self.panel.set_frame(f"frame {index} · {self._times_s[index]:.3f} s · {self._path.state(index)}{where}")
            self._draw_selected(index)
            if self.panel.follow.value:
                self.jump()
        self._on_select(index)

    @property
    def count(self) -> int:
        """Frames so far."""
        return len(self._path)

    @property
    def selected(self) -> int:
        """Index of the frame under the slider, -1 where there is none."""
        return self._selected

    def jump(self, clients: Sequence[ClientHandle] | None = None) -> None:
        """Bring the view of some browsers, by default of all, to the camera under the slider, where it has a pose."""
        pose = self._path.pose(self._selected) if self._selected >= 0 else None
        if pose is None:
            return
        for client in self._server.get_clients().values() if clients is None else clients:
            with client.atomic():
                client.camera.up_direction = upright(pose)
                client.camera.position = pose[:3, 3]
                client.camera.look_at = pose[:3, 3] + self._depth * pose[:3, 2]
                client.camera.fov = self._fov_rad()

    # layers

    def set_splat(self, gaussians: GaussianArrays) -> int:
        """The Gaussians; gives how many are not finite and left out. Spherical harmonics are not shown."""
        buffers = splat_buffers(gaussians)
        with self._lock:
            self._layer("splat")
            self._server.scene.add_gaussian_splats(
                "/splat/gaussians",
                centers=buffers.centers,
                covariances=buffers.covariances,
                rgbs=buffers.colours,
                opacities=buffers.opacities,
                scale=buffers.scale,
            )
        return buffers.left_out

    def set_cloud(
        self,
        layer: Literal["sparse", "dense"],
        points_world: Array,
        colors: Array,
        spacing: float | None = None,
        visible: bool = True,
    ) -> None:
        """Points (n, 3) with colours (n, 3) uint8 RGB. ``spacing``: between neighbours, in map units."""
        size = POINT_SIZE_RATIO * self._depth if spacing is None else spacing
        finite = np.isfinite(points_world).all(1)
        with self._lock:
            self._layer(layer, visible)
            handle = self._server.scene.add_point_cloud(
                f"/{layer}/points",
                np.asarray(points_world[finite], np.float32),
                np.asarray(colors[finite], np.uint8),
                point_size=size * float(self.panel.point_size.value),
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )
            self._clouds[layer] = (handle, size)
            self.panel.show_point_size()

    def set_mesh(self, glb: bytes, visible: bool = True) -> None:
        """Triangles as ``export.mesh_files.glb_bytes`` writes them: right, up, back, unlit colours."""
        with self._lock:
            self._layer("mesh", visible)
            self._server.scene.add_glb("/mesh/glb", glb, wxyz=WORLD_FROM_GLB, cast_shadow=False, receive_shadow=False)

    # panel

    def set_image(self, image: Array | None, mask: Array | None, text: str = "") -> None:
        """The picture of the frame under the slider, (h, w, 3) uint8 RGB, and P(moving) (h', w') uint8, 255 = certain.

        Either may be None. ``text`` says where they come from, or what is missing.
        """
        with self._lock:
            self._image, self._mask, self._about_image = image, mask, text
            self._show_image()

    def say(self, *lines: str) -> None:
        """What is to be known of the whole, at the top of the panel."""
        self.panel.say(list(lines))

    def close(self) -> None:
        """End the server."""
        close_server(self._server)

    def _show_image(self) -> None:
        with self._lock:
            image, mask = self._image, self._mask
            if image is None and mask is not None:
                image = np.repeat(mask[..., None], 3, 2)
                mask = None
            elif image is not None:
                image = fitted(image, IMAGE_WIDTH_PX)
                if mask is not None and self.panel.masked.value:
                    image = mask_overlay(image, mask)
            self.panel.set_image(image, mask is not None, self._about_image)

    def _layer(self, layer: Layer, visible: bool = True) -> None:
        """The node that holds a layer, with its checkbox, made when it is first asked for."""
        if layer in self._layers:
            return
        node = self._server.scene.add_frame(f"/{layer}", show_axes=False, visible=visible)
        self._layers[layer] = node

        def told(shown: bool) -> None:
            node.visible = shown

        self.panel.add_layer(LABELS[layer], visible, told)

    def _draw_path(self, first: int) -> None:
        """The lines of all frames from ``first`` on."""
        self._layer("path")
        for node in range(first // FRAMES_A_NODE, -(-len(self._path) // FRAMES_A_NODE)):
            start = node * FRAMES_A_NODE
            points, colours = self._path.segments(start, min(start + FRAMES_A_NODE, len(self._path)))
            self._lines(f"/path/{node}", points, colours, LINE_PX)

    def _draw_selected(self, index: int) -> None:
        points = self._path.selected(index)
        self._lines("/path/selected", points, np.full(points.shape, SELECTED_COLOUR, np.uint8), 2 * LINE_PX)

    def _lines(self, name: str, points: Array, colours: Array, width_px: float) -> None:
        if len(points):
            light = np.rint(255 * linear(colours / 255)).astype(np.uint8)  # viser takes colours of lines for light
            self._server.scene.add_line_segments(name, points, light, thickness=width_px, thickness_units="screen")
        else:
            self._server.scene.remove_by_name(name)

    def _open_at(self, index: int) -> None:
        """Where browsers that come later look from; those that are there go along."""
        pose = self._path.pose(index)
        if pose is None:
            return
        opening = self._server.initial_camera
        opening.position, opening.look_at = pose[:3, 3], pose[:3, 3] + self._depth * pose[:3, 2]
        opening.up, opening.fov = upright(pose), self._fov_rad()
        self.select(index)
        self.jump()

    def _fov_rad(self) -> float:
        """Vertical field of view; viser's camera looks through the middle of its image."""
        return FOV_UNKNOWN_RAD if self._camera is None else fov_rad(self._camera)

    def _followed(self) -> None:
        if self.panel.follow.value:
            self.jump()

    def _size_points(self) -> None:
        with self._lock:
            for handle, size in self._clouds.values():
                handle.point_size = size * float(self.panel.point_size.value)


def fov_rad(camera: Camera) -> float:
    """Vertical field of view of a lens, distortion left out."""
    return float(2 * np.arctan(camera.height / (2 * camera.fy_px)))
