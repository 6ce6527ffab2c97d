"""Where nothing stands yet that the photographs show: seeds for what the cloud leaves open, sky and bare walls too."""

from __future__ import annotations

import cv2
import numpy as np
import torch

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


def gaps_filled(gaussians: GaussianMap, views: list[View], poses: list[Array], near: float, room: int) -> GaussianMap:
    """The map, and a Gaussian for every block of static pixels behind which no view sees anything.

    ``poses`` are the views' (4, 4) cam_from_world. Its depth is that of its neighbours in the picture (normalised
    convolution of inverse depth), far away where it has none. No more than ``room`` are added.
    """
    for view, cam_from_world in zip(views, poses, strict=True):
        if room <= 0:
            break
        added = _seeds_of_gaps(gaussians, view, cam_from_world, near, room)
        if added is not None:
            gaussians = gaussians.joined(added)
            room -= len(added)
    return gaussians


def _seeds_of_gaps(
    gaussians: GaussianMap, view: View, cam_from_world: Array, near: float, room: int
) -> GaussianMap | None:
    camera = shrunk(view.camera, max(1, round(view.camera.width / LOOK_PX)))
    size, device = (camera.width, camera.height), gaussians.means.device
    with torch.no_grad():
        pose, K = torch.from_numpy(cam_from_world), torch.from_numpy(camera.matrix).to(device)
        _, depth, alpha = (t.cpu().numpy() for t in gaussians.draw(pose, K, *size, near))
    seen = alpha > OPEN_ALPHA
    gap = ~seen & (smaller_static(view.static, camera) > OPEN_ALPHA)
    blocks = _blocks(gap)
    if len(blocks) < FEW or not seen.any():
        return None
    inverse = np.where(seen, alpha / np.maximum(depth, 1e-9), 0).astype(np.float32)
    far = 1 / np.percentile(1 / inverse[seen], FAR_PERCENTILE)
    filled = inpainted_grid(inverse, seen.astype(np.float32), float(far))
    image = cv2.resize(view.image, size, interpolation=cv2.INTER_AREA)
    blocks = blocks[:: -(-len(blocks) // room)]
    z = 1 / np.maximum(filled[blocks[:, 1], blocks[:, 0]], 1e-9)
    points = camera.rays(blocks) * z[:, None]
    world_from_cam = np.linalg.inv(cam_from_world)
    cloud = StaticCloud(
        points_world=points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3],
        colors=image[blocks[:, 1], blocks[:, 0]],
        confidence=np.ones(len(z), np.float32),
        spacing=SPACING_OF_PIXEL * z / camera.fx_px,
        kf_id=np.full(len(z), view.kf_id),
    )
    return seed_gaussians(cloud, len(z), 0, str(device), sh_degree(gaussians.sh_rest))


def _blocks(gap: Array) -> Array:
    """(n, 2) int x, y: a pixel of the gap in every block that has one in its middle."""
    y, x = np.nonzero(gap[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE])
    return np.stack([x, y], 1) * STRIDE + STRIDE // 2
