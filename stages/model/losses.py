"""The terms of the objective, each alone (BANMo, section 3.4 and supplement).

Every term is a sum divided by a *fixed* count (rays, samples, nodes), never by the number of non-zero entries: a
term's pull must not grow as its problem shrinks. Where a gradient must not flow, the caller detaches.
"""

from __future__ import annotations

import torch
from torch import Tensor


def colour_loss(rendered: Tensor, observed: Tensor, weight: Tensor) -> Tensor:
    """Mean absolute colour error over rays (R, 3), weighted (R,)."""
    return ((rendered - observed).abs().mean(-1) * weight).mean()


def silhouette_loss(opacity: Tensor, mask: Tensor, weight: Tensor) -> Tensor:
    """L_sil: squared error of rendered opacity (R,) against the mask (R,) in 0..1, weighted (R,)."""
    return ((opacity - mask).square() * weight).mean()


def ray_error(colour: Tensor, rgb: Tensor, opacity: Tensor, mask: Tensor, weight: Tensor) -> Tensor:
    """Error a ray (...): colour (..., 3) weighted by `weight` (...), plus that of opacity against the mask (...).

    What active sampling learns. The paper's is colour alone; outlines say more about where limbs are missing.
    """
    return (colour - rgb).abs().mean(-1) * weight + (opacity - mask).square()


def huber(error: Tensor, corner: float, cap: float) -> Tensor:
    """Huber function of non-negative `error`: quadratic to `corner`, then linear, constant beyond `cap`."""
    error = error.clamp_max(cap)
    return torch.where(error < corner, 0.5 * error * error / corner, error - 0.5 * corner)


def flow_loss(rendered_px: Tensor, observed_px: Tensor, confidence: Tensor) -> Tensor:
    """L_OF: Huber of the flow's end point error (R, 2) in pixels, weighted by confidence (R,)."""
    error = torch.sqrt((rendered_px - observed_px).square().sum(-1) + 1e-6)
    return (huber(error, corner=0.5, cap=8.0) * confidence).mean()


def coverage_loss(placed_px: Tensor, pixels: Tensor, weight: Tensor, cap_px: float) -> Tensor:
    """Distance (Huber, corner 2 px, constant beyond `cap_px`) of pixels (F, P, 2) from the nearest placed point.

    `placed_px` (F, N, 2) are points of the surface in the picture, `weight` (F, P) says which pixels nothing covers.
    """
    nearest = torch.cdist(pixels, placed_px.detach()).argmin(-1)
    found = placed_px.gather(1, nearest[..., None].expand(-1, -1, 2))
    error = torch.sqrt((found - pixels).square().sum(-1) + 1e-6)
    return (huber(error, corner=2.0, cap=cap_px) * weight).mean()


def spill_loss(placed: Tensor, beside: Tensor, weight: Tensor, cap_px: float) -> Tensor:
    """How far (Huber, corner 2 px, constant beyond `cap_px`) points lie beside the mask; zero on it, or off the map.

    `placed` (F, N, 2) are x, y in cells of the maps `beside` (F, h, w) of distance to the mask in pixels; `weight`
    (F, 1) is the trust in the frame.
    """
    size = torch.tensor([beside.shape[2], beside.shape[1]], dtype=placed.dtype, device=placed.device)
    unit = placed / size * 2 - 1
    away = torch.nn.functional.grid_sample(beside[:, None], unit[:, None], align_corners=False)[:, 0, 0]
    return (huber(away, corner=2.0, cap=cap_px) * weight).mean()


def feature_loss(rendered: Tensor, observed: Tensor, weight: Tensor) -> Tensor:
    """Rendered feature: squared distance of embeddings (R, 16), weighted (R,)."""
    return ((rendered - observed).square().sum(-1) * weight).mean()


def match_loss(matched: Tensor, surface: Tensor, weight: Tensor) -> Tensor:
    """L_match (equation 12): squared distance of the matched point (P, 3) from the warped surface point (P, 3)."""
    return ((matched - surface).square().sum(-1) * weight).mean()


def cycle_2d_loss(projected_px: Tensor, pixels: Tensor, weight: Tensor, image_size_px: float) -> Tensor:
    """L_2D-cyc (equation 13): distance between a pixel (P, 2) and where its matched point projects, in image sizes."""
    error = torch.sqrt((projected_px - pixels).square().sum(-1) + 1e-6) / image_size_px
    return (error.clamp_max(1.0) * weight).mean()


def cycle_3d_loss(returned: Tensor, points: Tensor, ray_weight: Tensor) -> Tensor:
    """L_3D-cyc (equation 14): distance of W_forward(W_backward(X)) from X, both (R, S, 3), by tau (R, S)."""
    error = torch.sqrt((returned - points).square().sum(-1) + 1e-8)
    return (error * ray_weight).sum(-1).mean()


def eikonal_loss(sdf_grid: Tensor, spacing: Tensor, band: float) -> Tensor:
    """Mean of (|grad d| - 1)^2 over nodes with |d| < band; sdf (Z, Y, X), spacing (3,) along x, y, z."""
    here = sdf_grid[:-1, :-1, :-1]
    dx = (sdf_grid[:-1, :-1, 1:] - here) / spacing[0]
    dy = (sdf_grid[:-1, 1:, :-1] - here) / spacing[1]
    dz = (sdf_grid[1:, :-1, :-1] - here) / spacing[2]
    norm = torch.sqrt(dx * dx + dy * dy + dz * dz + 1e-8)
    near = (here.detach().abs() < band).to(sdf_grid.dtype)
    return ((norm - 1).square() * near).sum() / near.sum().clamp_min(1)


def smoothness_loss(sdf_grid: Tensor, spacing: Tensor, band: float) -> Tensor:
    """Mean squared second difference along each axis near the surface, in units of the spacing."""
    near = (sdf_grid.detach().abs() < band).to(sdf_grid.dtype)
    total = sdf_grid.new_zeros(())
    for axis, step in zip((2, 1, 0), spacing, strict=True):
        n = sdf_grid.shape[axis]
        middle = sdf_grid.narrow(axis, 1, n - 2)
        second = (sdf_grid.narrow(axis, 0, n - 2) + sdf_grid.narrow(axis, 2, n - 2) - 2 * middle) / step
        total = total + (second.square() * near.narrow(axis, 1, n - 2)).sum()
    return total / near.sum().clamp_min(1)


def sinkhorn_divergence(a: Tensor, b: Tensor, blur: float, sweeps: int = 30) -> Tensor:
    """Debiased entropic optimal transport between point sets a (N, 3) and b (M, 3), uniform weights, cost |x-y|^2/2.

    Log-domain Sinkhorn with epsilon annealed from the diameter to blur^2 (Feydy et al. 2019). The bone location
    term of the supplement: bones should lie where the surface is.
    """

    def cost(x: Tensor, y: Tensor) -> Tensor:
        square = (x * x).sum(-1)[:, None] + (y * y).sum(-1)[None] - 2 * x @ y.T
        return 0.5 * square.clamp_min(0)

    def transport(x: Tensor, y: Tensor) -> Tensor:
        c = cost(x, y)
        log_x = -torch.log(torch.tensor(float(len(x)), device=x.device))
        log_y = -torch.log(torch.tensor(float(len(y)), device=x.device))
        epsilon = float(c.detach().max().clamp_min(blur * blur))
        f, g = c.new_zeros(len(x)), c.new_zeros(len(y))
        with torch.no_grad():
            for _ in range(sweeps):
                epsilon = max(epsilon * 0.7, blur * blur)
                new_f = -epsilon * torch.logsumexp(log_y + (g[None] - c) / epsilon, 1)
                new_g = -epsilon * torch.logsumexp(log_x + (f[:, None] - c) / epsilon, 0)
                f, g = (f + new_f) / 2, (g + new_g) / 2
            plan = torch.exp((f[:, None] + g[None] - c) / epsilon + log_x + log_y)
            value = f.mean() + g.mean()
        # At the optimum only the cost carries gradient (envelope theorem): differentiate <plan, cost>.
        linear = (plan * c).sum()
        return value + linear - linear.detach()

    return transport(a, b) - 0.5 * transport(a, a) - 0.5 * transport(b, b)


def second_difference(values: Tensor, video_idx: Tensor) -> Tensor:
    """Mean squared second difference in time of values (T, ...) inside each video `video_idx` (T,)."""
    same = (video_idx[2:] == video_idx[:-2]).to(values.dtype)
    second = (values[2:] - 2 * values[1:-1] + values[:-2]).flatten(1).square().sum(-1)
    return (second * same).sum() / same.sum().clamp_min(1)
