"""Where nothing stands: seeds for what the cloud leaves open, and a backdrop for what no photograph shows."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch

from ..camera.pinhole import Camera
from ..geometry.inpainting import inpainted_grid
from ..types import StaticCloud, View
from .gaussians import Array, GaussianMap
from .seed import seed_gaussians
from .sh import sh_degree
from .targets import shrunk, smaller_static

LOOK_PX = 160  # width of the pictures in which gaps are looked for
OPEN_ALPHA = 0.5  # below: nothing stands here
STRIDE = 2  # one seed a block of this many pixels a side
SPACING_OF_PIXEL = 2.4  # spacing of the seeds over the size of a pixel: they overlap more than points of the cloud
FAR_PERCENTILE = 95  # of the depths seen: where what has no neighbours is put
FEW = 4  # blocks; fewer are left to the training
BACKDROP_ALPHA = 0.9  # below, a backdrop is put behind a pixel once the training is over
BACKDROP_LOGIT = 3.0  # of its Gaussians' opacity
SeedsOf = Callable[[GaussianMap, View, Array, float, int], GaussianMap | None]


def gaps_filled(gaussians: GaussianMap, views: list[View], poses: list[Array], near: float, room: int) -> GaussianMap:
    """The map, and a Gaussian for every block of static pixels behind which no view sees anything.

    ``poses`` are the views' (4, 4) cam_from_world. Its depth is that of its neighbours in the picture (normalised
    convolution of inverse depth), far away where it has none. No more than ``room`` are added.
    """
    return _seeded(_seeds_of_gaps, gaussians, views, poses, near, room)


def with_backdrop(gaussians: GaussianMap, views: list[View], poses: list[Array], near: float, room: int) -> GaussianMap:
    """The finished map, and behind every pixel that is still open a far Gaussian in the colours around it.

    What moves hides a part of the world from all photographs: nothing is trained there, and a viewer would look
    through a hole. Far behind everything, a backdrop hides nothing that is known. ``poses`` and ``room``: as above.
    """
    return _seeded(_seeds_of_backdrop, gaussians, views, poses, near, room)


def _seeded(
    seeds_of: SeedsOf, gaussians: GaussianMap, views: list[View], poses: list[Array], near: float, room: int
) -> GaussianMap:
    """The map with what every view adds to all that is there by then."""
    for view, cam_from_world in zip(views, poses, strict=True):
        if room <= 0:
            break
        added = seeds_of(gaussians, view, cam_from_world, near, room)
        if added is not None:
            gaussians = gaussians.joined(added)
            room -= len(added)
    return gaussians


def _seeds_of_gaps(
    gaussians: GaussianMap, view: View, cam_from_world: Array, near: float, room: int
) -> GaussianMap | None:
    camera, _, depth, alpha = _looked_at(gaussians, view, cam_from_world, near)
    seen = alpha > OPEN_ALPHA
    gap = ~seen & (smaller_static(view.static, camera) > OPEN_ALPHA)
    blocks = _blocks(gap)
    if len(blocks) < FEW or not seen.any():
        return None
    inverse = np.where(seen, alpha / np.maximum(depth, 1e-9), 0).astype(np.float32)
    far = 1 / np.percentile(1 / inverse[seen], FAR_PERCENTILE)
    filled = inpainted_grid(inverse, seen.astype(np.float32), float(far))
    image = cv2.resize(view.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    blocks = blocks[:: -(-len(blocks) // room)]
    z = 1 / np.maximum(filled[blocks[:, 1], blocks[:, 0]], 1e-9)
    return _seeds_at(gaussians, view, camera, cam_from_world, blocks, z, image)


def _seeds_of_backdrop(
    gaussians: GaussianMap, view: View, cam_from_world: Array, near: float, room: int
) -> GaussianMap | None:
    camera, color, depth, alpha = _looked_at(gaussians, view, cam_from_world, near)
    seen = alpha > BACKDROP_ALPHA
    blocks = _blocks(~seen & (smaller_static(view.static, camera) > 0))
    if len(blocks) < FEW or not seen.any():
        return None
    known = np.where(seen[..., None], color / np.maximum(alpha, 1e-9)[..., None], 0).astype(np.float32)
    filled = inpainted_grid(known, seen.astype(np.float32), known[seen].mean(0))
    image = np.rint(255 * np.clip(filled, 0, 1)).astype(np.uint8)
    blocks = blocks[:: -(-len(blocks) // room)]
    z = np.full(len(blocks), np.percentile((depth / np.maximum(alpha, 1e-9))[seen], FAR_PERCENTILE))
    seeds = _seeds_at(gaussians, view, camera, cam_from_world, blocks, z, image)
    with torch.no_grad():
        seeds.opacity_logits.fill_(BACKDROP_LOGIT)
    return seeds


def _looked_at(
    gaussians: GaussianMap, view: View, cam_from_world: Array, near: float
) -> tuple[Camera, Array, Array, Array]:
    """A small camera, and what it draws: colour over black, depth times alpha, alpha."""
    camera, device = shrunk(view.camera, max(1, round(view.camera.width / LOOK_PX))), gaussians.means.device
    with torch.no_grad():
        pose, K = torch.from_numpy(cam_from_world), torch.from_numpy(camera.matrix).to(device)
        color, depth, alpha = (t.cpu().numpy() for t in gaussians.draw(pose, K, camera.width, camera.height, near))
    return camera, color, depth, alpha


def _seeds_at(
    gaussians: GaussianMap,
    view: View,
    camera: Camera,
    cam_from_world: Array,
    blocks: Array,
    z: Array,
    image: Array,
) -> GaussianMap:
    """A Gaussian in the middle of every block (n, 2) of a view's small ``camera``, at depth z (n,), of the colour that
    ``image`` has there."""
    points = camera.rays(blocks) * z[:, None]
    world_from_cam = np.linalg.inv(cam_from_world)
    cloud = StaticCloud(
        points_world=points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3],
        colors=image[blocks[:, 1], blocks[:, 0]],
        confidence=np.ones(len(z), np.float32),
        spacing=SPACING_OF_PIXEL * z / camera.fx_px,
        kf_id=np.full(len(z), view.kf_id),
    )
    return seed_gaussians(cloud, len(z), 0, str(gaussians.means.device), sh_degree(gaussians.sh_rest))


def _blocks(gap: Array) -> Array:
    """(n, 2) int x, y: a pixel of the gap in every block that has one in its middle."""
    y, x = np.nonzero(gap[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE])
    return np.stack([x, y], 1) * STRIDE + STRIDE // 2
