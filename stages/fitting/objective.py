"""The objective of one step: render a batch, compare it with what was seen, add the regularisers (section 3.4)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from stages.fitting.active import Uncertainty
from stages.fitting.batches import Batch, Draws
from stages.fitting.observations import BESIDE_UNITS
from stages.fitting.schedule import PhaseSettings, flow_speaks_alone
from stages.fitting.team import ALONE, Team
from stages.geometry.cameras import pixel_directions, project, ray_box, transform
from stages.geometry.rotations import so3_log
from stages.model import losses, rendering
from stages.model.banmo import Banmo, FrameState
from stages.model.correspondence import soft_argmax
from stages.model.fields import GridField

_GIVEN_TURN, _GIVEN_SHIFT = 0.4, 0.015
"""Radians, units: how far given root poses that may move are off. Pictures tell a turn well and a
distance badly, so places are held, turns hardly."""
_PICTURE_TERMS = ("silhouette", "rgb", "cover", "spill", "feature", "match", "cycle_2d")


class Rendered(NamedTuple):
    """Samples along the rays of a batch; F frames, P pixels, S samples."""

    points: Tensor  # (F, P, S, 3) object space
    canonical: Tensor  # (F, P, S, 3)
    weights: Tensor  # (F, P, S): tau
    opacity: Tensor  # (F, P)
    colour: Tensor  # (F, P, 3), normalised by opacity
    surface: Tensor  # (F, P, 3): expected canonical point


def rays(state: FrameState, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Origins (F, 1, 3) and directions (F, P, 3) in object space; a depth z in camera space is ``o + z d``."""
    rotation = state.camera_from_object[:, :3, :3]
    directions = pixel_directions(state.intrinsics, pixels) @ rotation
    origins = -(rotation.transpose(1, 2) @ state.camera_from_object[:, :3, 3:]).transpose(1, 2)
    return origins, directions


def render(
    model: Banmo,
    prepared: Tensor,
    state: FrameState,
    boxes: Tensor,
    pixels: Tensor,
    beta: float,
    settings: PhaseSettings,
    draws: Draws | None,
) -> Rendered:
    """Volume-render `pixels` (F, P, 2) through per-frame object-space boxes (F, 2, 3) (equations 2, 3).

    A probe without gradient finds the surface; a few samples with gradient are drawn where its weight lies. `draws`
    jitters both; without it samples lie in the middle of their strata.
    """
    frames, count = pixels.shape[:2]
    offset = rendering.edge_offset(beta)
    origins, directions = rays(state, pixels)
    near, far, _ = ray_box(origins, directions, boxes[:, None, 0], boxes[:, None, 1])

    def draw(samples: int) -> Tensor | None:
        return None if draws is None else draws.uniform(count, samples).reshape(-1, samples)

    def warp(depths: Tensor) -> tuple[Tensor, Tensor]:
        samples = depths.shape[1]
        points = origins[:, :, None] + depths.reshape(frames, count, samples, 1) * directions[:, :, None]
        flat = points.reshape(frames, count * samples, 3)
        return flat, model.backward(state, flat)

    with torch.no_grad():
        flat_near, flat_far = near.reshape(-1), far.reshape(-1)
        probe = rendering.uniform_depths(flat_near, flat_far, settings.probe_samples, draw(settings.probe_samples))
        _, canonical = warp(probe)
        sdf = model.field.sdf(prepared, canonical.reshape(-1, 3)).reshape(probe.shape)
        bins = (flat_far - flat_near)[:, None] / settings.probe_samples
        weights = rendering.ray_weights(rendering.laplace_density(sdf + offset, beta), bins.expand_as(sdf))
        closest = torch.zeros_like(weights).scatter_(1, sdf.argmin(1, keepdim=True), 1.0)
        weights = rendering.dilate(weights) + 0.02 * rendering.dilate(closest) + 1e-5
        middle = (probe[:, 1:] + probe[:, :-1]) / 2
        edges = torch.cat([flat_near[:, None], middle, flat_far[:, None]], 1)
        depths = rendering.importance_depths(edges, weights, settings.fine_samples, draw(settings.fine_samples))
        # No sample speaks for more of the ray than a probe's bin: a far neighbour would lend it false weight.
        lengths = torch.minimum(rendering.interval_lengths(depths, flat_near, flat_far), 1.5 * bins)

    points, canonical = warp(depths)
    queried = model.field.query(prepared, canonical.reshape(-1, 3))
    density = rendering.laplace_density(queried.sdf.reshape(depths.shape) + offset, beta)
    tau = rendering.ray_weights(density, lengths)
    opacity = tau.sum(-1)
    flat_directions = directions[:, :, None].expand(-1, -1, depths.shape[1], -1).reshape(-1, 3)
    light = state.environment.repeat_interleave(count * depths.shape[1], 0)
    colour = model.field.shade(queried.appearance, flat_directions, light).reshape(*depths.shape, 3)
    share = tau / opacity.clamp_min(1e-4)[:, None]
    shape = (frames, count, depths.shape[1])
    return Rendered(
        points=points.reshape(*shape, 3),
        canonical=canonical.reshape(*shape, 3),
        weights=tau.reshape(shape),
        opacity=opacity.reshape(frames, count),
        colour=(colour * share[..., None]).sum(1).reshape(frames, count, 3),
        surface=(canonical.reshape(*depths.shape, 3) * share[..., None]).sum(1).reshape(frames, count, 3),
    )


def evaluate(
    model: Banmo,
    boxes: Tensor,
    batch: Batch,
    settings: PhaseSettings,
    beta: float,
    step: int,
    generator: torch.Generator,
    team: Team = ALONE,
    uncertainty: Uncertainty | None = None,
) -> dict[str, Tensor]:
    """Every active term of the objective, already weighted; their sum is minimised.

    In a team each process answers for its frames of the batch: the terms, and their gradients, add up to those of
    one process alone.
    """
    prepared = model.field.prepare()
    part = team.part(len(batch.frame_idx))
    draws = Draws(generator, len(batch.frame_idx), part, batch.pixels.device)
    has_flow = bool(batch.flow_confidence.any())
    share = (part.stop - part.start) / len(batch.frame_idx)
    batch = batch.of(part)
    frames = len(batch.frame_idx)
    both = model.frames(torch.cat([batch.frame_idx, batch.partner_idx]))
    state = FrameState(*(x if len(x) == 1 else x[:frames] for x in both))
    partner = FrameState(*(x if len(x) == 1 else x[frames:] for x in both))
    seen = render(model, prepared, state, boxes[batch.frame_idx], batch.pixels, beta, settings, draws)
    opacity = seen.opacity.detach()
    inside = (batch.mask > 0.5).float() * batch.weight
    terms: dict[str, Tensor] = {}

    def add(name: str, weight: float, value: Tensor) -> None:
        terms[name] = weight * value

    if settings.weight_silhouette:
        weight = batch.weight.expand_as(batch.mask)
        add("silhouette", settings.weight_silhouette, losses.silhouette_loss(seen.opacity, batch.mask, weight))
    if settings.weight_rgb:
        add("rgb", settings.weight_rgb, losses.colour_loss(seen.colour, batch.rgb, inside * opacity))
    if uncertainty is not None:
        error = losses.ray_error(seen.colour, batch.rgb, seen.opacity, batch.mask, inside * opacity).detach()
        add("uncertainty", 1.0, (uncertainty.of(model, batch) - error).abs().mean())
    if settings.weight_flow and has_flow:
        moved = transform(partner.camera_from_object, model.forward_points(partner, seen.surface))
        flow = project(partner.intrinsics, moved) - batch.pixels
        weight = batch.flow_confidence * inside * opacity
        add("flow", settings.weight_flow, losses.flow_loss(flow, batch.flow, weight))
    terms.update(_outline(model, state, batch, inside * (opacity < 0.3), settings, step, generator))
    if batch.features is not None:
        terms.update(_correspondence(model, state, batch, seen, inside * opacity, settings, step, draws))
    if settings.weight_cycle_3d:
        terms["cycle_3d"] = settings.weight_cycle_3d * _cycle_3d(model, state, seen, draws)
    terms.update(motion_terms(model, batch.frame_idx, settings))
    if flow_speaks_alone(settings, step) and "flow" in terms:
        terms = {name: value for name, value in terms.items() if name not in _PICTURE_TERMS}
    if team.size > 1:
        terms = {name: share * value for name, value in terms.items()}
    for name, value in _shape_terms(model, prepared, settings, step).items():
        terms[name] = value / team.size
    return terms


def _outline(
    model: Banmo,
    state: FrameState,
    batch: Batch,
    uncovered: Tensor,
    settings: PhaseSettings,
    step: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """What pulls limbs where rendering has no gradient: onto pixels that nothing covers, back from beside the mask.

    Random points of the surface are posed and projected; no ray is drawn far beside the mask. The first pixels beside
    it are free: there the outline is the rays' to settle, and a price that nothing answers from within the mask would
    make the body thinner.
    """
    cover = settings.weight_cover > 0 and step >= settings.cover_from * settings.iterations
    spill = settings.weight_spill > 0 and step >= settings.spill_from * settings.iterations and batch.beside is not None
    terms: dict[str, Tensor] = {}
    if not (cover or spill) or len(model.surface) == 0:
        return terms
    pick = torch.randint(len(model.surface), (400,), generator=generator).to(model.surface.device)
    points = model.surface[pick][None].expand(len(batch.frame_idx), -1, -1)
    placed = project(state.intrinsics, transform(state.camera_from_object, model.forward_points(state, points)))
    farthest_px = 0.15 * max(max(v.width, v.height) for v in model.videos)
    if cover:
        value = losses.coverage_loss(placed, batch.pixels, uncovered, cap_px=farthest_px)
        terms["cover"] = settings.weight_cover * value
    if spill and batch.beside is not None:
        scale = batch.beside_scale[..., None]
        beside_px = batch.beside.to(placed.dtype) / (BESIDE_UNITS * scale)
        value = losses.spill_loss(placed * scale, beside_px, batch.weight, farthest_px)
        terms["spill"] = settings.weight_spill * value
    return terms


def _cycle_3d(model: Banmo, state: FrameState, seen: Rendered, draws: Draws) -> Tensor:
    """3D cycle on two samples a ray: the heaviest and a random one."""
    frames, count, samples = seen.weights.shape
    heavy = seen.weights.argmax(-1, keepdim=True)
    other = draws.below(samples, count, 1)
    index = torch.cat([heavy, other], -1)
    wide = index[..., None].expand(-1, -1, -1, 3)
    canonical = seen.canonical.gather(2, wide).reshape(frames, -1, 3)
    returned = model.forward_points(state, canonical).reshape(frames, count, 2, 3)
    points = seen.points.gather(2, wide)
    weight = seen.weights.gather(2, index).detach()
    return losses.cycle_3d_loss(returned.flatten(0, 1), points.flatten(0, 1), weight.flatten(0, 1))


def _correspondence(
    model: Banmo,
    state: FrameState,
    batch: Batch,
    seen: Rendered,
    weight: Tensor,
    settings: PhaseSettings,
    step: int,
    draws: Draws,
) -> dict[str, Tensor]:
    """Rendered embedding, match and 2D cycle. The embedding learns from the first; the cycle moves only the warps."""
    assert batch.features is not None
    terms: dict[str, Tensor] = {}
    known = weight * (batch.features.abs().sum(-1) > 0.1)
    if settings.weight_feature:
        # Rendered at the expected surface point. Where the point itself gets gradient, features register the frames.
        still = seen.surface.detach()
        surface = still + settings.feature_pull * (seen.surface - still) if settings.feature_pull else still
        rendered = model.field.embedding(surface.reshape(-1, 3)).reshape(batch.features.shape)
        terms["feature"] = settings.weight_feature * losses.feature_loss(rendered, batch.features, known)
    wanted = settings.weight_match or settings.weight_cycle_2d
    if not wanted or step % max(1, settings.match_every) or len(model.surface) == 0:
        return terms
    frames, count = batch.mask.shape
    per_frame = max(1, settings.match_pixels // draws.frames)
    pick = draws.below(count, per_frame)
    grid = model.match_cells()
    with torch.no_grad():
        grid_features = model.field.embedding(grid)
    features = batch.features.gather(1, pick[..., None].expand(-1, -1, 16)).reshape(-1, 16)
    matched = soft_argmax(features, grid, grid_features, 40.0, None).reshape(frames, per_frame, 3)
    confident = known.gather(1, pick)
    if settings.weight_match:
        target = seen.surface.gather(1, pick[..., None].expand(-1, -1, 3))
        value = losses.match_loss(matched.reshape(-1, 3), target.reshape(-1, 3), confident.reshape(-1))
        terms["match"] = settings.weight_match * value
    if settings.weight_cycle_2d:
        moved = transform(state.camera_from_object, model.forward_points(state, matched))
        landed = project(state.intrinsics, moved)
        pixels = batch.pixels.gather(1, pick[..., None].expand(-1, -1, 2))
        size = max(max(v.width, v.height) for v in model.videos)
        value = losses.cycle_2d_loss(landed.reshape(-1, 2), pixels.reshape(-1, 2), confident.reshape(-1), size)
        terms["cycle_2d"] = settings.weight_cycle_2d * value
    return terms


def _shape_terms(model: Banmo, prepared: Tensor, settings: PhaseSettings, step: int) -> dict[str, Tensor]:
    """Regularisers of the shape and of where bones lie."""
    terms: dict[str, Tensor] = {}
    if isinstance(model.field, GridField) and settings.lr_sdf:
        grid = prepared[0, 0]
        if settings.weight_eikonal:
            value = losses.eikonal_loss(grid, model.field.spacing, band=0.15)
            terms["eikonal"] = settings.weight_eikonal * value
        if settings.weight_smooth:
            value = losses.smoothness_loss(grid, model.field.spacing, band=3 * model.field.voxel)
            terms["smooth"] = settings.weight_smooth * value
    elif settings.weight_eikonal and settings.lr_sdf and len(model.surface):
        points = (model.surface[::4] + 0.05 * torch.sin(model.surface[::4] * 311.0 + step)).requires_grad_()
        sdf = model.field.sdf(prepared, points)
        (gradient,) = torch.autograd.grad(sdf.sum(), points, create_graph=True)
        terms["eikonal"] = settings.weight_eikonal * (gradient.norm(dim=-1) - 1).square().mean()
    if settings.weight_bone_location and settings.lr_bones:
        depth = model.field.sdf(prepared.detach(), model.bones.centres)
        terms["bone_inside"] = settings.weight_bone_location * torch.relu(depth).mean()
        if step % 20 == 0 and len(model.surface):
            surface = model.surface[:: max(1, len(model.surface) // 160)]
            value = losses.sinkhorn_divergence(model.bones.centres, surface, blur=0.05)
            terms["bone_location"] = settings.weight_bone_location * value
    return terms


def motion_terms(model: Banmo, frame_idx: Tensor, settings: PhaseSettings) -> dict[str, Tensor]:
    """Regularisers of the motion: joints hold together, bones and roots do not jerk."""
    terms: dict[str, Tensor] = {}
    last = len(model.time) - 1
    middle = frame_idx.clamp(1, max(1, last - 1))
    triple = torch.stack([(middle - 1).clamp_min(0), middle, (middle + 1).clamp_max(last)], 1)
    video = model.video_idx[triple]
    whole = (video[:, 0] == video[:, 2]).float()
    flat = triple.reshape(-1)
    centres = model.bones.centres
    transforms, own, _ = model.body(model.video_idx[flat], model.time[flat], centres, model.bones.parents)
    if settings.weight_joints and len(model.bones) > 1:
        pairs, joints = neighbours(centres.detach())
        placed = transform(transforms[:, pairs.reshape(-1)], joints[None].repeat_interleave(2, 1)[..., None, :])
        ends = placed.reshape(len(flat), -1, 2, 3)
        gap = torch.sqrt((ends[:, :, 0] - ends[:, :, 1]).square().sum(-1) + 1e-6)
        slip = torch.sqrt(own[:, 1:, 3:].square().sum(-1) + 1e-6)
        terms["joints"] = settings.weight_joints * (0.3 * gap.mean() + slip.mean())
    if settings.weight_rest:
        # Depth is what a silhouette tells least: of two motions that explain it, the smaller one.
        size = own[..., :3].square().sum(-1).mean() + own[:, 0].square().sum(-1).mean()
        terms["rest"] = settings.weight_rest * size
    if settings.weight_motion:
        posed = (transforms[..., :3, :3] @ centres[..., None]).squeeze(-1) + transforms[..., :3, 3]
        p = posed.reshape(*triple.shape, -1, 3)
        jerk = torch.sqrt((p[:, 0] - 2 * p[:, 1] + p[:, 2]).square().sum(-1) + 1e-6).mean(-1)
        terms["motion"] = settings.weight_motion * (jerk * whole).mean()
    if settings.lr_root and (settings.weight_root or settings.weight_given):
        v = model.video_idx[flat]
        roots = model.root(v, model.time[flat], model.base_poses[flat], model.root_free[v])
        roots = roots.reshape(*triple.shape, 4, 4)
        rotation, shift = roots[..., :3, :3], roots[..., :3, 3]
        first = so3_log(rotation[:, 0].transpose(1, 2) @ rotation[:, 1])
        second = so3_log(rotation[:, 1].transpose(1, 2) @ rotation[:, 2])
        bend = (shift[:, 0] - 2 * shift[:, 1] + shift[:, 2]).norm(dim=-1)
        terms["root"] = settings.weight_root * (((second - first).norm(dim=-1) + bend) * whole).mean()
        given = (model.root_given & (model.root_free > 0))[video[:, 1]]
        if settings.weight_given and bool(given.any()):
            base = model.base_poses[triple[:, 1]]
            turn = so3_log(base[:, :3, :3].transpose(1, 2) @ rotation[:, 1]).square().sum(-1) / _GIVEN_TURN**2
            away = (shift[:, 1] - base[:, :3, 3]).square().sum(-1) / _GIVEN_SHIFT**2
            terms["given"] = settings.weight_given * (given * ((1 + turn).sqrt() - 1 + away)).mean()
    return terms


def neighbours(centres: Tensor, most: int = 3) -> tuple[Tensor, Tensor]:
    """Pairs of neighbouring bones (E, 2) and the point where they meet (E, 3), from centres (B, 3).

    Two bones are neighbours when no third lies in the ball between them (Gabriel graph), nearest `most` each.
    """
    count = len(centres)
    distance = torch.cdist(centres, centres)
    middle = (centres[:, None] + centres[None]) / 2
    to_middle = torch.cdist(middle.reshape(-1, 3), centres).reshape(count, count, count)
    index = torch.arange(count)
    to_middle[index, :, index] = torch.inf
    to_middle[:, index, index] = torch.inf
    free = to_middle.amin(-1) >= 0.5 * distance * 0.98
    near = torch.zeros_like(free)
    order = distance.argsort(1)[:, 1 : most + 1]
    near.scatter_(1, order, True)
    linked = free & (near | near.T)
    linked |= near & (distance <= distance.sort(1).values[:, 1:2] + 1e-6)  # nobody stands alone
    linked = torch.triu(linked | linked.T, 1)
    pairs = torch.nonzero(linked)
    return pairs, (centres[pairs[:, 0]] + centres[pairs[:, 1]]) / 2
