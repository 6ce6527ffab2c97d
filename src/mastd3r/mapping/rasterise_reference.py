"""The slow, obvious rasteriser that holds the fast ones: every Gaussian at every pixel, plain torch.

Rules of the field (gsplat): 2-D covariance by the Jacobian at the centre (clamped 15 % outside the image)
plus eps2d on the diagonal; alpha = min(0.999, o exp(-d^T conic d / 2)), dropped below 1/255; near to far;
a pixel is finished before the Gaussian that would leave it a transmittance of 1e-4 or less.
"""

from __future__ import annotations

import torch


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """(N, 4) wxyz, any length, to (N, 3, 3)."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def _project(
    points_cam: torch.Tensor, covariance_cam: torch.Tensor, intrinsics: torch.Tensor, width: int, height: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixels (N, 2), integers at pixel centres, and 2-D covariances (N, 2, 2)."""
    x, y, z = points_cam.unbind(-1)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2] + 0.5, intrinsics[1, 2] + 0.5
    x_used = z * (x / z).clamp(-(cx + 0.15 * width) / fx, (1.15 * width - cx) / fx)
    y_used = z * (y / z).clamp(-(cy + 0.15 * height) / fy, (1.15 * height - cy) / fy)
    zero = torch.zeros_like(z)
    row_x = torch.stack([fx / z, zero, -fx * x_used / z**2], -1)
    row_y = torch.stack([zero, fy / z, -fy * y_used / z**2], -1)
    jacobian = torch.stack([row_x, row_y], -2)
    pixels = torch.stack([fx * x / z + cx - 0.5, fy * y / z + cy - 0.5], -1)
    return pixels, jacobian @ covariance_cam @ jacobian.transpose(-1, -2)


def rasterise_reference(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near: float = 0.01,
    eps2d: float = 0.3,
    background: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """See ``rasterise.rasterization``. Memory grows with N·H·W: for tests only."""
    rotation, translation = viewmats[:3, :3], viewmats[:3, 3]
    points_cam = means @ rotation.T + translation
    order = torch.argsort(points_cam[:, 2].detach(), stable=True)
    order = order[(points_cam[order, 2] > near) & (opacities[order] >= 1 / 255)]
    shape = rotation @ (rotation_matrices(quats[order]) * scales[order][:, None, :])
    points_cam = points_cam[order]
    pixels, covariance = _project(points_cam, shape @ shape.transpose(-1, -2), Ks, width, height)
    conic = torch.linalg.inv(covariance + eps2d * torch.eye(2).to(means))
    y, x = torch.meshgrid(torch.arange(height).to(means), torch.arange(width).to(means), indexing="ij")
    offset = torch.stack([x, y], -1).reshape(-1, 1, 2) - pixels
    power = 0.5 * torch.einsum("pni,nij,pnj->pn", offset, conic, offset)
    alpha = (opacities[order] * torch.exp(-power)).clamp_max(0.999)
    alpha = torch.where(alpha < 1 / 255, torch.zeros_like(alpha), alpha)
    alpha = alpha * (torch.cumprod(1 - alpha, 1) > 1e-4)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = alpha * before
    color = (weight @ colors[order]).reshape(height, width, 3)
    depth = (weight @ points_cam[:, 2]).reshape(height, width)
    total = weight.sum(1).reshape(height, width)
    if background is not None:
        color = color + (1 - total)[..., None] * background
    return color, depth, total
