"""A network of tokens (DINOv2) made ready for a collection: 16 axes fitted to its clips, kept beside the network.

Features must mean the same in every clip, so the axes belong to the whole collection; they lie in the network's
folder, whose content enters the key of the features stage.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import cv2
import numpy as np

from pipeline import BadInput, Results
from pipeline.console import progress
from stages import registry
from stages.contracts import locate
from stages.formats import FEATURE_CHANNELS, read_clip, read_grey, read_mask_facts
from stages.networks import BASIS, TokenNetwork
from stages.perception.descriptors import crop_box, crop_resize
from stages.perception.principal import principal_axes

MOST_FRAMES = 100
"""Frames of the collection that the axes are fitted to, evenly spread (Lab4D takes as many)."""
_CROP_PX = 448


def fit_axes(folder: Path, name: str, results: Results, device: str = "cpu") -> tuple[Path, str]:
    """Fit axes to the clips of a workspace whose masks are done; returns the new folder and a line about it.

    Raises BadInput when a clip has no masks yet, or when the objects give too few tokens.
    """
    network = TokenNetwork(folder, device=device)
    videos = results.videos
    if not videos:
        raise BadInput("no run has seen any clips here", where=results.workspace, hint="banmo run --until masks")
    each = max(1, MOST_FRAMES // len(videos))
    samples = []
    for video in progress(videos, label="clips"):
        frames, masks = results.folder("frames", video), results.folder("masks", video)
        clip, facts = read_clip(frames.path), read_mask_facts(masks.path)
        shown = [i for i, flags in enumerate(facts.flags) if "missing" not in flags]
        for i in sorted({shown[k] for k in np.linspace(0, len(shown) - 1, each).astype(int)} if shown else ()):
            crop = crop_box(facts.box[i], clip.width, clip.height)
            tokens = network(crop_resize(clip.image(i), crop, _CROP_PX))
            grey = crop_resize(read_grey(masks / clip.names[i]).astype(np.float32), crop) / 255.0
            on = cv2.resize(grey, tokens.shape[1::-1], interpolation=cv2.INTER_AREA) > 0.5
            samples.append(tokens[on])
    stacked = np.concatenate(samples) if samples else np.zeros((0, 0), np.float32)
    try:
        mean, axes = principal_axes(stacked, FEATURE_CHANNELS)
    except ValueError as error:
        raise BadInput(
            f"the clips give too little to fit to ({error})", hint="look at latest/videos/*/masks"
        ) from error
    spread = float(((stacked - mean) @ axes).var(axis=0).sum() / stacked.var(axis=0).sum())

    def bring(target: Path) -> None:
        source = locate(folder)[0]
        try:
            os.link(source, target)
        except OSError:  # another disk, or a file system without links
            shutil.copyfile(source, target)
        np.savez(target.with_name(BASIS), mean=mean, axes=axes)

    contract, facts_of = registry.contract_table(folder), {**registry.about(folder), "name": name}
    facts_of["fitted_to"] = ", ".join(videos)
    made = registry.keep(name, bring, contract, facts_of)
    return made, f"{len(stacked)} tokens of {len(videos)} clips; the 16 axes hold {spread:.0%} of their variance"
