"""How good the shipped networks are: on generated bodies they have not seen, and on clips with known truth.

``python -m benchmarks.networks [--data DATA/fox:quadruped DATA/dancer:human] [--look casual]``

Prints a table. Held-out bodies are drawn with a seed that training never uses, dressed as in training. For clips the
true masks are the prompt; `mask` is what the network finds with no prompt on a crop 1.35 times the true box, `prior`
what it finds in the whole picture. View errors of clips are against the true root pose itself, no rotation aligned.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from stages.decoding import read_frames
from stages.own_networks import CATEGORIES, OwnFinder, OwnNetwork
from stages.perception.descriptors import crop_box, crop_resize
from stages.perception.prior import object_priors
from stages.perception.viewpoint import (
    AZIMUTH_DEG,
    INPUT_PX,
    angle_log_probabilities,
    mask_box,
    normalised,
    view_rotations,
)
from stages.registration.placing import ray_rotation, view_angles
from synthetic.backgrounds import backgrounds
from synthetic.bank import random_body, render_views, view_rotation
from synthetic.canonical import Carrier, canonical_body, mirror_vertices
from synthetic.things import PLACES, place_labels, places
from training.dressing import Batch, dress
from training.losses import network_input
from training.wardrobe import Bank, Random

HELD_OUT_SEED = 900


@dataclass(frozen=True)
class Row:
    """One line of the table; angles in degrees."""

    name: str
    azimuth_median: float
    azimuth_mean: float
    reversed_share: float
    rotation_median: float
    vote: str
    mask: float
    prior: float
    named: float

    def text(self) -> str:
        """As the table prints it."""
        prior = "     -" if np.isnan(self.prior) else f"{self.prior:6.2f}"
        return (
            f"{self.name:28s} {self.azimuth_median:8.1f} {self.azimuth_mean:6.1f} {100 * self.reversed_share:6.1f} "
            f"{self.rotation_median:9.1f} {self.mask:6.2f} {prior} {self.named:6.2f}  {self.vote}"
        )


HEADER = (
    f"{'':28s} {'azimuth':>8s} {'mean':>6s} {'>90 %':>6s} {'rotation':>9s} {'mask':>6s} {'prior':>6s} {'named':>6s}"
)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees (N,) between rotations (N, 3, 3)."""
    cosine = (np.einsum("nij,nij->n", a, b) - 1) / 2
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def wrapped(degrees: np.ndarray) -> np.ndarray:
    """Angles in -180..180."""
    return (degrees + 180) % 360 - 180


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    """Mean IoU of (N, H, W) masks."""
    shared, union = (found & truth).sum((1, 2)), (found | truth).sum((1, 2))
    return float((shared / np.maximum(union, 1)).mean())


def held_out(bodies: int = 12, views: int = 30) -> Iterator[Row]:
    """Generated bodies that training has not seen, prompted and not."""
    rng = np.random.default_rng(HELD_OUT_SEED)
    banks = []
    for category in CATEGORIES:
        canonical = canonical_body(category)
        carrier = Carrier.of(canonical)
        drawn = [random_body(rng, category) for _ in range(bodies)]
        shards = [render_views(body, category, carrier.labels(body), views, rng) for body in drawn]
        mirror = torch.from_numpy(mirror_vertices(canonical.vertices))
        banks.append(Bank.of(category, shards, torch.from_numpy(canonical.vertices).float(), mirror))
    drawn = [random_body(rng, "thing") for _ in range(bodies)]
    shards = [render_views(body, "thing", place_labels(body), views // 2, rng) for body in drawn]
    things = Bank.of("thing", shards, torch.from_numpy(places()).float(), torch.arange(PLACES))
    photos = torch.from_numpy(backgrounds(rng, 200)).permute(0, 3, 1, 2)
    draw = Random(HELD_OUT_SEED)
    batches = [dress(banks, things, photos, bodies * views // 2, draw) for _ in range(2)]
    for k, category in enumerate(CATEGORIES):
        network = OwnNetwork(category)
        for prompted in (True, False):
            yield _judge(network, [b[k] for b in batches], draw, prompted, k)


def _judge(network: OwnNetwork, batches: list[Batch], draw: Random, prompted: bool, category: int) -> Row:
    errors, turns, masks, named = [], [], [], []
    bins = view_rotations()
    for batch in batches:
        inputs = network_input(batch, draw, torch.full((len(batch.image),), prompted)).numpy()
        answers = [network(part) for part in np.array_split(inputs, len(inputs) // 20)]
        view, dense, kind = (np.concatenate([a[n] for a in answers]) for n in ("view", "dense", "category"))
        ok = batch.present.numpy()
        degrees = np.rad2deg(batch.view.numpy())
        errors.append(np.abs(wrapped(AZIMUTH_DEG[view[:, :36].argmax(1)] - degrees[:, 0]))[ok])
        best = (view[:, :36].argmax(1) * 12 + view[:, 36:48].argmax(1)) * 12 + view[:, 48:].argmax(1)
        truth = view_of(batch.view.numpy())
        turns.append(angle_between(bins[best], truth)[ok])
        area = torch.nn.functional.interpolate(batch.mask, dense.shape[2:], mode="area")[:, 0].numpy() > 0.5
        masks.append(overlap((dense[:, 0] > 0)[ok], area[ok]))
        named.append((kind.argmax(1) == np.where(ok, category, len(CATEGORIES))).mean())
    error = np.concatenate(errors)
    name = f"held-out {network.category}, {'mask given' if prompted else 'no mask'}"
    turned = float(np.median(np.concatenate(turns)))
    return Row(name, float(np.median(error)), float(error.mean()), float((error > 90).mean()), turned, "",
               float(np.mean(masks)), float("nan"), float(np.mean(named)))  # fmt: skip


def view_of(angles: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations of azimuth, elevation and roll (N, 3), radians."""
    return np.stack([view_rotation(*(float(v) for v in row)) for row in angles])


def clips(folder: Path, category: str, look: str, every: int = 3) -> Row:
    """An object's clips: `<look>/videos/*.mp4`, `<look>/gt/<clip>.json` and `<clip>-mask.npz`."""
    network = OwnNetwork(category)
    bins = view_rotations()
    errors, turns, votes, masks, priors, named = [], [], [], [], [], []
    for video in sorted((folder / look / "videos").glob("*.mp4")):
        truth = json.loads((folder / look / "gt" / f"{video.stem}.json").read_text(encoding="utf-8"))
        with np.load(folder / look / "gt" / f"{video.stem}-mask.npz") as file:
            mask = (
                np.unpackbits(file["packed"])[: int(np.prod(file["shape"]))]
                .reshape(file["shape"])
                .astype(bool)[::every]
            )
        frames = np.stack([frame.image for frame in read_frames(video)])[::every]
        grey = mask.astype(np.uint8) * 255
        boxes = np.stack([mask_box(m) for m in grey])
        turned = ray_rotation((boxes[:, :2] + boxes[:, 2:]) / 2, np.array(truth["K"])).transpose(0, 2, 1)
        rotation = turned @ np.array(truth["object_to_camera"])[::every, :3, :3]
        azimuth = -np.rad2deg(view_angles(rotation)[0])
        found = angle_log_probabilities(frames, grey, network)
        errors.append(np.abs(wrapped(AZIMUTH_DEG[found[0].argmax(1)] - azimuth)))
        best = (found[0].argmax(1) * 12 + found[1].argmax(1)) * 12 + found[2].argmax(1)
        turns.append(angle_between(bins[best], rotation))
        shifted = [
            np.interp(AZIMUTH_DEG + a, AZIMUTH_DEG, row, period=360) for a, row in zip(azimuth, found[0], strict=True)
        ]
        votes.append(int(AZIMUTH_DEG[np.sum(shifted, 0).argmax()]))
        crops = [crop_box(box, mask.shape[2], mask.shape[1], 1.35) for box in boxes]
        alone = np.zeros((len(frames), 4, INPUT_PX, INPUT_PX), np.float32)
        alone[:, :3] = [normalised(crop_resize(f, c, INPUT_PX)) for f, c in zip(frames, crops, strict=True)]
        answer = network(alone)
        side = answer["dense"].shape[-1]
        area = np.stack([crop_resize(m.astype(np.float32), c, side) > 0.5 for m, c in zip(mask, crops, strict=True)])
        masks.append(overlap(answer["dense"][:, 0] > 0, area))
        named.append((answer["category"].argmax(1) == CATEGORIES.index(category)).mean())
        prior = object_priors(frames, OwnFinder(), {category: CATEGORIES.index(category)})[category]
        priors.append(overlap(prior > 127, mask))
    error = np.concatenate(errors)
    return Row(f"{folder.name}, {look}", float(np.median(error)), float(error.mean()), float((error > 90).mean()),
               float(np.median(np.concatenate(turns))), str(votes), float(np.mean(masks)), float(np.mean(priors)),
               float(np.mean(named)))  # fmt: skip


def main(data: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (), look: str = "casual") -> None:
    """Print how good the shipped networks are.

    Args:
        data: Folder of an object with known truth and its category, as in path/fox:quadruped; may be repeated.
        look: Which look of it.
    """
    torch.set_num_threads(1)
    sys.stdout.write(HEADER + "\n")
    for row in held_out():
        sys.stdout.write(row.text() + "\n")
    for entry in data:
        folder, _, category = entry.rpartition(":")
        sys.stdout.write(clips(Path(folder), category, look).text() + "\n")


if __name__ == "__main__":
    tyro.cli(main)
