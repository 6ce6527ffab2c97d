"""A graph correction that deforms the world: a Gaussian follows all keyframes that see it, not its anchor alone.

Training has put a Gaussian where the views that see it agree best. Where those hang on keyframes that had drifted
apart, that is between them; so its motion is theirs, averaged. What a view says is counted from the camera that it was
trained with, which pose refinement had already moved some of the way. And where the poses of views were refined, they
are fitted anew to the Gaussians where they are now, so that every view shows what it showed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..geometry.quaternion import quaternion_from_rotation
from ..geometry.se3 import inverse
from ..geometry.sim3 import Sim3
from .gaussians import Array, GaussianMap, quaternion_product

RAY_SHARE = 0.2  # what a view says of depth, as a share of what it says across its ray
ANCHOR_PX = 1.0  # the anchor counts as a view in which the Gaussian covers this many pixels
FIT_POINTS = 4000  # Gaussians that a view's pose is fitted to, those that make up most of its picture
FIT_PRIOR = 0.3  # holds a pose correction near none: mean square error in the image per (shift / depth)², per turn²


@dataclass(frozen=True)
class Visibility:
    """How much of one view's picture each Gaussian makes up, and what the correction does to what it shows."""

    change: Sim3  # new_world_from_old_world
    cam_from_world: Array  # (4, 4) that the view was trained with, before the correction
    weight_px: torch.Tensor  # (n,) sum of blending weights over the pixels


def changes_of(old_world_from_kf: dict[int, Array], new_world_from_kf: dict[int, Array]) -> dict[int, Sim3]:
    """Of each keyframe in both dicts, new_world_from_old_world: its new pose (4, 4) over its old one."""
    both = sorted(set(old_world_from_kf) & set(new_world_from_kf))
    return {kf: Sim3.from_rigid(new_world_from_kf[kf] @ np.linalg.inv(old_world_from_kf[kf])) for kf in both}


def deformation(changes: Iterable[Sim3], point: Array) -> float:
    """How far apart the changes would put one point: the largest distance from the mean. 0 for a rigid correction."""
    moved = np.stack([change.apply(point) for change in changes])
    return float(np.linalg.norm(moved - moved.mean(0), axis=1).max())


def visibility(
    gaussians: GaussianMap,
    change: Sim3,
    cam_from_world: torch.Tensor,
    intrinsics: torch.Tensor,
    pixel_weight: torch.Tensor,
    near: float,
) -> Visibility:
    """What one view (h, w) sees of the map; ``pixel_weight`` is what the pixels count in training.

    A picture is linear in the colours: its gradient in a colour is the weight of that Gaussian.
    """
    colors = torch.zeros_like(gaussians.colors).requires_grad_()
    plain = replace(gaussians, colors=colors, sh_rest=gaussians.sh_rest[:, :0])
    height, width = pixel_weight.shape
    color, _, _ = plain.draw(cam_from_world.detach(), intrinsics, width, height, near)
    (weight_px,) = torch.autograd.grad((color[..., 0] * pixel_weight).sum(), colors)
    return Visibility(change, cam_from_world.detach().cpu().numpy(), weight_px[:, 0].detach())


def followed(gaussians: GaussianMap, changes: dict[int, Sim3], visibilities: Iterable[Visibility]) -> GaussianMap:
    """The map after a correction, each Gaussian moved by the mean of what its views say.

    Its centre: least squares over the views, where a view counts by its pixels, and along its ray only by
    ``RAY_SHARE``, because it hardly tells depth. Its turn and its scale: the mean by pixels. What no view sees moves
    with its anchor, and so do harmonics. Where all changes are equal, so is the motion. Keyframes without a change
    stand still.
    """
    anchored = gaussians.moved(changes)
    before, device = gaussians.means.detach().double(), gaussians.means.device
    eye = torch.eye(3, dtype=torch.float64, device=device)
    anchor_turn, anchor_scale = _anchor_motion(gaussians, changes)
    total = ANCHOR_PX * eye.expand(len(before), 3, 3)
    shift = ANCHOR_PX * (anchored.means.detach().double() - before)
    turn, log_scale = ANCHOR_PX * anchor_turn, ANCHOR_PX * anchor_scale
    pixels = torch.full((len(before),), ANCHOR_PX, dtype=torch.float64, device=device)
    for seen in visibilities:
        change, weight, centre_ = seen.change, seen.weight_px.double(), inverse(seen.cam_from_world)[:3, 3]
        linear, offset, centre = (
            torch.from_numpy(np.array(a, float)).to(device)
            for a in (change.matrix[:3, :3], change.translation, centre_)
        )
        ray = torch.nn.functional.normalize(before - centre, dim=1)
        across = (1 + RAY_SHARE) * eye - ray[:, :, None] * ray[:, None, :]
        information = weight[:, None, None] * across
        motion = before @ linear.T + offset - before
        total = total + information
        shift = shift + (information @ motion[..., None])[..., 0]
        step, scale = (
            torch.from_numpy(quaternion_from_rotation(change.rotation)).to(device),
            float(np.log(change.scale)),
        )
        step = step * torch.where((anchor_turn @ step) < 0, -1.0, 1.0)[:, None]
        turn, log_scale, pixels = turn + weight[:, None] * step, log_scale + weight * scale, pixels + weight
    means = before + torch.linalg.solve(total, shift)
    turn = torch.nn.functional.normalize(turn, dim=1)
    quats = quaternion_product(turn, gaussians.quats.detach().double())
    log_scales = gaussians.log_scales.detach() + (log_scale / pixels)[:, None].to(gaussians.log_scales)
    leaves = {"means": means.to(gaussians.means), "quats": quats.to(gaussians.quats), "log_scales": log_scales}
    return replace(anchored, **{name: tensor.requires_grad_() for name, tensor in leaves.items()})


def fitted_pose(before_cam: Array, after_cam: Array, weight: Array, depth: float) -> tuple[Array, Array]:
    """Shift (3,) in units of ``depth`` and turn (3,) of a camera, that show a moved map as the old one was shown.

    before_cam (n, 3): points in the camera that the view was trained with, after_cam (n, 3): where they are now, in
    the camera that is to be corrected, weight (n,): pixels. The correction acts on the left of cam_from_world. One
    step of weighted least squares in the image, with a prior, because a shift aside and a turn look much alike. Zero
    where hardly a point is in front of both cameras.
    """
    rows = np.argsort(-weight, kind="stable")[:FIT_POINTS]
    rows = rows[(weight[rows] > 0) & (before_cam[rows, 2] > 0.05 * depth) & (after_cam[rows, 2] > 0.05 * depth)]
    if len(rows) < 8:
        return np.zeros(3), np.zeros(3)
    (x, y, z), share = after_cam[rows].T, weight[rows] / weight[rows].sum()
    u, v, zero = x / z, y / z, np.zeros(len(rows))
    jacobian = np.stack(
        [
            np.stack([depth / z, zero, -depth * u / z, -u * v, 1 + u * u, -v], 1),
            np.stack([zero, depth / z, -depth * v / z, -1 - v * v, u * v, u], 1),
        ],
        1,
    )
    error = before_cam[rows, :2] / before_cam[rows, 2:] - np.stack([u, v], 1)
    normal = np.einsum("n,nki,nkj->ij", share, jacobian, jacobian) + FIT_PRIOR * np.eye(6)
    found = np.linalg.solve(normal, np.einsum("n,nki,nk->i", share, jacobian, error))
    return found[:3], found[3:]


def _anchor_motion(gaussians: GaussianMap, changes: dict[int, Sim3]) -> tuple[torch.Tensor, torch.Tensor]:
    """(n, 4) turn and (n,) logarithm of the scale of every Gaussian's anchor."""
    found, row = np.unique(gaussians.kf_id.cpu().numpy(), return_inverse=True)
    motions = [changes.get(int(kf), Sim3.identity()) for kf in found]
    turns = quaternion_from_rotation(np.stack([m.rotation for m in motions]))[row]
    scales = np.log([m.scale for m in motions])[row]
    device = gaussians.means.device
    return torch.from_numpy(turns).to(device), torch.from_numpy(scales).to(device)
