"""A fitted model taken to another set of clips of the same subject: warm start when clips are added or taken away.

Shape, colour, bones and motion head are kept. A clip that the model knows keeps its codes and its root poses; a new
one starts in the articulation of the known frame that fits best. Root poses of the new collection may stand in
another frame and at another scale (they are estimated anew for all clips together): the clips known to both tell how.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from stages.fitting.observations import Observations
from stages.geometry.rotations import invert_rigid
from stages.model.banmo import Banmo, VideoFacts
from stages.model.motion import FourierCode
from stages.retargeting.articulation import first_articulation
from stages.retargeting.driven import follow, known_codes

_A_VIDEO_EACH = ("base_poses", "gauge", "root_free", "log_focal")


def grown(
    model: Banmo,
    videos: list[VideoFacts],
    poses: Tensor,
    intrinsics: Tensor,
    observations: Observations,
    octaves: int,
    splines: int,
    seed: int,
) -> Banmo:
    """The model with these `videos`.

    Args:
        poses, intrinsics: (T, 4, 4) camera_from_object and (T, 3, 3) pixels of all kept frames of the new collection.
        octaves, splines: functions of time of the body pose codes (see :mod:`stages.model.motion`).
    """
    architecture = replace(model.architecture, octaves=octaves, splines=splines)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        new = Banmo(architecture, videos, poses, model.bounds, model.bones, generator)
    codes = ("body.code.", "root.code.", "environment.")
    fresh = new.state_dict()
    new.surface = torch.zeros_like(model.surface)
    new.load_state_dict(
        {n: fresh[n] if n in _A_VIDEO_EACH or n.startswith(codes) else v.clone() for n, v in model.state_dict().items()}
    )
    new.use_delta = model.use_delta
    known = [(k, model.video_names.index(v.name)) for k, v in enumerate(videos) if _same(v, model)]
    with torch.no_grad():
        new.base_poses.copy_(_carried_over(model, new, known, poses))
        light = model.environment(model.video_idx, model.time).mean(0)
        for k in range(len(videos)):
            here = slice(new.starts[k], new.starts[k + 1])
            old = dict(known).get(k)
            if old is None:
                frames = torch.arange(here.start, here.stop)
                start, _ = first_articulation(
                    model, new.base_poses[here], intrinsics[here][0], part(observations, frames)
                )
                follow(new.body.code, k, new.time[here], known_codes(model)[start])
                follow(new.root.code, k, new.time[here], torch.zeros(len(frames), new.root.code.coefficients.shape[-1]))
                follow(new.environment, k, new.time[here], light.expand(len(frames), -1))
                continue
            there = slice(model.starts[old], model.starts[old + 1])
            new.base_poses[here], new.gauge[here] = model.base_poses[there], model.gauge[there]
            new.log_focal[k] = model.log_focal[old]
            index, time = model.video_idx[there], model.time[there]
            for ours, theirs in (
                (new.body.code, model.body.code),
                (new.root.code, model.root.code),
                (new.environment, model.environment),
            ):
                if torch.equal(time, new.time[here]) and _alike(ours, theirs):
                    ours.coefficients[k] = theirs.coefficients[old]
                else:  # another longest clip, so another measure of time
                    follow(ours, k, new.time[here], theirs(index, time), ridge=1e-6)
    return new


def part(observations: Observations, frames: Tensor) -> Observations:
    """Silhouettes and weights of some frames (N,); enough for comparing silhouettes, not for drawing batches."""
    return replace(
        observations,
        video_idx=observations.video_idx[frames],
        frame_weight=observations.frame_weight[frames],
        silhouettes=observations.silhouettes[frames],
        silhouette_scale=observations.silhouette_scale[frames],
        image_size=observations.image_size[frames],
    )


def change_of_frame(new: Tensor, old: Tensor) -> tuple[Tensor, Tensor, float]:
    """Rotation (3, 3), shift (3,) and scale with ``x_new = scale rotation x_old + shift``, from the same frames' poses.

    Args:
        new, old: (T, 4, 4) camera_from_object in either frame. The camera's units scale along.
    """
    relative = (new[:, :3, :3].transpose(1, 2) @ old[:, :3, :3]).double().sum(0)
    u, _, vt = torch.linalg.svd(relative)
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.linalg.det(u @ vt)))]).double()) @ vt
    # new.R shift - scale old.t = -new.t, for every frame
    left = torch.cat([new[:, :3, :3].double(), -old[:, :3, 3:].double()], 2).reshape(-1, 4)
    solved = torch.linalg.lstsq(left, -new[:, :3, 3].double().reshape(-1, 1)).solution[:, 0]
    return rotation.float(), solved[:3].float(), max(float(solved[3]), 1e-3)


def _carried_over(model: Banmo, new: Banmo, known: list[tuple[int, int]], poses: Tensor) -> Tensor:
    """All new root poses (T, 4, 4) in the model's own frame and scale."""
    if not known:
        return poses
    ours = torch.cat([torch.arange(new.starts[k], new.starts[k + 1]) for k, _ in known])
    theirs = torch.cat([torch.arange(model.starts[k], model.starts[k + 1]) for _, k in known])
    video, time = model.video_idx[theirs], model.time[theirs]
    old = model.root(video, time, model.base_poses[theirs], model.root_free[video]) @ invert_rigid(model.gauge[theirs])
    rotation, shift, scale = change_of_frame(poses[ours], old)
    result = poses.clone()
    result[:, :3, :3] = poses[:, :3, :3] @ rotation
    result[:, :3, 3] = ((poses[:, :3, :3] @ shift[:, None]).squeeze(-1) + poses[:, :3, 3]) / scale
    return result


def _same(video: VideoFacts, model: Banmo) -> bool:
    """Whether the model knows this clip with these very frames."""
    return any(v.name == video.name and v.time_s == video.time_s for v in model.videos)


def _alike(ours: FourierCode, theirs: FourierCode) -> bool:
    return ours.octaves == theirs.octaves and ours.splines == theirs.splines
