"""A saved map that has been loaded: its keyframes as the graph that images are found in."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens, lens_from_intrinsics
from ..camera.pinhole import Camera
from ..concurrency import one_blas_thread
from ..config import Config, config_from_text
from ..dynamics.soft_mask import static_at
from ..errors import ConfigError, InputError
from ..export.map_folder import SPLAT, MapRecord, read_map
from ..geometry.se3 import inverse
from ..graph.intrinsics import of_camera
from ..graph.keyframe_graph import KeyframeGraph
from ..mapping.gaussian_arrays import GaussianArrays
from ..mapping.ply import read_gaussians_ply
from ..parts import Parts, chosen_features, parts_of
from ..reading.files import is_file
from ..sources.checks import frame_is_blank
from ..tracking.localisation import Localiser, Place, Unplaced
from ..types import Frame, WorkFrame
from .working_eye import WorkingEye

Array = NDArray[Any]
SAME_SHAPE = 0.01  # by which width / height of an image may differ from that of the map's photographs


class SavedMap:
    """A map of one world: keyframes, their points and poses, the lens, perhaps a splat. Lengths are in ``unit``."""

    def __init__(self, path: Path) -> None:
        """``path``: its folder. Raises InputError, ConfigError for one that is none, or is damaged."""
        self.path, self.record = path, read_map(path)
        config = config_from_text(self.record.config, f"{path}/config.yaml")
        self.eye = WorkingEye(self.record.lens, config)
        if self.eye.provider.size != self.record.size:
            raise InputError(
                f"{path}: expected working images of {self.eye.provider.size}, as camera.json and config.yaml say, "
                f"got {self.record.size}"
            )
        self._config = config
        self._looked = 0

    def __repr__(self) -> str:
        return f"<SavedMap of {len(self.record.keyframes)} keyframes in {self.path}>"

    @property
    def timestamps_s(self) -> Array:
        """(n,) float64 seconds of the keyframes, in the video that they are from."""
        return np.array([kf.timestamp_s for kf in self.record.keyframes])

    @property
    def poses(self) -> Array:
        """(n, 4, 4) float64 world_from_cam of the keyframes."""
        return np.stack([kf.world_from_cam for kf in self.record.keyframes])

    @property
    def unit(self) -> str:
        """Of all lengths: m where the run knew metres, else map units."""
        return self.record.unit

    @property
    def camera(self) -> Camera | OpenCvLens:
        """The lens over the photographs."""
        return self.record.lens

    @cached_property
    def gaussians(self) -> GaussianArrays | None:
        """The splat; None where the run had none. Raises InputError where it is damaged."""
        file = self.path / SPLAT
        return read_gaussians_ply(file) if is_file(file) else None

    @one_blas_thread()
    def localise(
        self, image: Array, *, intrinsics: Sequence[float] = (), near: Place | None = None
    ) -> Place | Unplaced:
        """Where an image (h, w, 3) uint8 RGB was taken, or why it has no place in the map.

        intrinsics: its lens, if that is not the map's: the focal length in its pixels, or as ``--intrinsics``.
        near: the place of the image before it, in a video. Raises InputError for an image of another shape than the
        map's photographs where no lens is said, ConfigError for a lens that is none.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or min(image.shape[:2]) < 16:
            raise InputError(f"localise: expected an image (h, w, 3) of uint8, got {image.shape} of {image.dtype}")
        if frame_is_blank(image):
            return Unplaced("the image is blank")
        work, moving = self._look(image, tuple(intrinsics))
        return self.localiser.find(work, moving, near)

    @cached_property
    def localiser(self) -> Localiser:
        """The keyframes as a graph, and what finds images in it."""
        parts = parts_of(self.eye.provider, self._config)
        graph = KeyframeGraph(self._config.graph, of_camera(self.eye.camera))
        add_keyframes(graph, self.record)
        graph.hold()
        describe(parts, self._config, graph, self.record)
        return Localiser(self._config, parts, graph)

    def _look(self, image: Array, intrinsics: tuple[float, ...]) -> tuple[WorkFrame, Array]:
        """The image as the map's lens at working size would show it, and P(moving): 1 where it shows nothing."""
        self._looked += 1
        height, width = image.shape[:2]
        lens, eye = self.record.lens, self.eye
        if not intrinsics:
            check_shape(lens, (width, height), "localise")
            if (width, height) != (lens.width, lens.height):
                image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
            work = eye.look(self._looked, 0.0, image).work
            return work, np.zeros(work.gray.shape, np.float32)
        own = _lens_of_image(intrinsics, (width, height))
        return self._seen_by_map(image, own)

    def _seen_by_map(self, image: Array, own: OpenCvLens) -> tuple[WorkFrame, Array]:
        camera = self.eye.camera
        shrunk = min(1.0, camera.fx_px / own.focal_px)  # so that no pixel is stepped over
        small = own.resized(max(16, round(own.width * shrunk)), max(16, round(own.height * shrunk)))
        image = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        at = small.project(camera.rays(camera.pixel_grid()))
        seen = cv2.remap(image, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = ((at >= -0.5) & (at <= np.array([small.width, small.height]) - 0.5)).all(-1)
        work = self.eye.provider.look(Frame(self._looked, 0.0, seen))
        return work, np.asarray(~inside, np.float32)


def add_keyframes(graph: KeyframeGraph, record: MapRecord) -> None:
    """The keyframes of a map become those of a graph, with poses and depths as they are; frames before its first."""
    graph.size = record.size
    for n, kf in enumerate(record.keyframes):
        texture = kf.texture.astype(float)
        index = n - len(record.keyframes)
        work = WorkFrame(index, kf.timestamp_s, kf.gray, kf.px, record.grid, texture, None, None)
        moving = kf.moving / 255.0
        static = np.where(kf.depth_info > 0, static_at(moving, kf.px), 0.0)  # what has no depth says too little
        graph.add_keyframe(work, static, moving, inverse(kf.world_from_cam), kf.inv_depth, kf.depth_info)


def describe(parts: Parts, config: Config, graph: KeyframeGraph, record: MapRecord) -> None:
    """Let the features know the map's keyframes, the first of a graph: as the map describes them, or anew."""
    images = [kf.work.gray for kf in graph.keyframes[: len(record.keyframes)]]
    if not hasattr(parts.features, "take_descriptions"):
        return
    if record.features == chosen_features(config)[0]:
        described = [(kf.feature_px, kf.descriptors) for kf in record.keyframes]
    else:
        described = parts.features.descriptions(images)  # type: ignore[attr-defined]
    parts.features.take_descriptions(images, described)


def check_shape(lens: Camera | OpenCvLens, size: tuple[int, int], who: str) -> None:
    """Raise InputError for images of another shape than those of a map's ``lens``; ``who`` reads them."""
    if abs(size[0] * lens.height / (size[1] * lens.width) - 1) > SAME_SHAPE:
        raise InputError(
            f"{who}: expected images of the map's lens, {lens.width}x{lens.height} or of that shape, got "
            f"{size[0]}x{size[1]}; say their lens with --intrinsics"
        )


def _lens_of_image(given: tuple[float, ...], size: tuple[int, int]) -> OpenCvLens:
    if len(given) == 1:
        given = (given[0], given[0], (size[0] - 1) / 2, (size[1] - 1) / 2)
    lens = lens_from_intrinsics(given, size)
    if not size[0] / 50 < lens.focal_px < 50 * size[0]:
        raise ConfigError(f"--intrinsics: expected a focal length in pixels of {size[0]}x{size[1]}, got {given[0]:g}")
    return lens
