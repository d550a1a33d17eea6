"""From folders to what the optimiser sees: frames, masks, flow, features and poses of a collection, packed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipeline import BadInput, Folder, Run
from stages import formats
from stages.fitting.observations import ObservationBuilder, Observations
from stages.model.banmo import VideoFacts


@dataclass(frozen=True)
class Collection:
    """Everything an optimisation phase reads."""

    observations: Observations
    camera_from_object: Tensor  # (T, 4, 4)
    intrinsics: Tensor  # (T, 3, 3)
    videos: list[VideoFacts]
    root_fixed: Tensor  # (V,) 1 where root poses are held: the user gave them and did not ask to refine
    confidence: list[np.ndarray]  # root-pose confidence, a video
    clips: dict[str, formats.Clip]


def collect(
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    steps: tuple[int, ...],
    run: Run,
) -> Collection:
    """Read a whole collection; `steps` are the flow's frame steps to use, both ways."""
    clips = {name: formats.read_clip(folder.path) for name, folder in frames.items()}
    said = formats.read_json(poses / "poses.json")["videos"]
    builder = ObservationBuilder(steps=tuple(s * sign for s in steps for sign in (1, -1)))
    tracks, videos, maps, crops = [], [], [], []
    total, done = sum(len(c) for c in clips.values()), 0
    for video_idx, (name, clip) in enumerate(clips.items()):
        track = formats.read_poses(poses / f"{name}.json")
        mask_images = formats.read_masks(masks[name].path, clip)
        facts = formats.read_mask_facts(masks[name].path)
        for i in range(len(clip)):
            if run.stop_requested:
                run.interrupt()
            flows = {}
            for step in steps:
                for sign, partner in ((1, i + step), (-1, i - step)):
                    path = formats.flow_path(flow[name].path, step, int(clip.source_idx[i]), backward=sign < 0)
                    if 0 <= partner < len(clip) and path.is_file():
                        flows[step * sign] = formats.read_flow(path)
            missing = "missing" in facts.flags[i]
            weight = 0.0 if missing else float(facts.confidence[i] * max(0.1, track.confidence[i]))
            builder.add(video_idx, clip.image(i), mask_images[i], flows, weight)
            done += 1
            run.tick(done, total, "reading frames")
        tracks.append(track)
        videos.append(_video_facts(name, clip, track))
        values, boxes = formats.read_features(features[name].path)
        maps.append(np.asarray(values))
        crops.append(boxes)
    observations = builder.finish(np.concatenate(maps), np.concatenate(crops))
    if not (observations.frame_weight > 0).sum() >= 2:
        raise BadInput(
            "no two frames show the object", hint="look at latest/videos/*/masks, and give masks or a hints file"
        )
    return Collection(
        observations=observations,
        camera_from_object=torch.from_numpy(np.concatenate([t.object_to_camera for t in tracks])).float(),
        intrinsics=torch.cat(
            [torch.from_numpy(t.intrinsics).float()[None].expand(len(t.confidence), 3, 3) for t in tracks]
        ),
        videos=videos,
        root_fixed=torch.tensor([float(said[name]["fixed"]) for name in clips]),
        confidence=[t.confidence for t in tracks],
        clips=clips,
    )


def _video_facts(name: str, clip: formats.Clip, track: formats.PoseTrack) -> VideoFacts:
    k = track.intrinsics
    return VideoFacts(
        name=name,
        time_s=tuple(float(t) for t in clip.time_s),
        width=clip.width,
        height=clip.height,
        focal_px=(float(k[0, 0]), float(k[1, 1])),
        principal_px=(float(k[0, 2]), float(k[1, 2])),
        root_given=set(track.provider) == {"given"},
        root_wave_rad=track.wave_rad,
    )
