"""Train the networks on a bank of generated bodies.

``python -m training.train OUT_DIR --bank BANK_DIR --minutes 75 --seed 0``

One run trains the shared trunk and both categories. It is seeded, stops by the clock, writes ``state.safetensors``
every few minutes (weights averaged over the last steps) and one line of ``log.jsonl`` every 100 steps.
"""

from __future__ import annotations

import copy
import json
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import tyro
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from synthetic.backgrounds import backgrounds
from synthetic.bank import Shard
from synthetic.canonical import canonical_body, laplacian_basis, mirror_vertices
from synthetic.things import PLACES, places
from training.dressing import Batch, dress
from training.losses import Surface, mask_loss, network_input, view_blocks, view_loss
from training.network import AZIMUTH_DEG, CATEGORIES, Network
from training.wardrobe import Bank, Random

log = logging.getLogger(__name__)

BASIS = 96
LOG_EVERY, KEEP_EVERY_S = 100, 120.0


def load_bank(folder: Path, category: str) -> Bank:
    """All shards of a category (or of `thing`) in a folder."""
    shards = [Shard.load(path) for path in sorted(folder.glob(f"{category}-*.npz"))]
    if not shards:
        raise FileNotFoundError(f"no renderings of {category} in {folder}; make some with python -m synthetic.bank")
    if category == "thing":
        return Bank.of(category, shards, torch.from_numpy(places()).float(), torch.arange(PLACES))
    body = canonical_body(category)
    rest = torch.from_numpy(body.vertices).float()
    return Bank.of(category, shards, rest, torch.from_numpy(mirror_vertices(body.vertices)))


def make_surface(category: str, seed: int) -> Surface:
    """The category's canonical surface with an untrained embedding."""
    body = canonical_body(category)
    return Surface(body.vertices, laplacian_basis(body.vertices, body.faces, BASIS), seed)


def step_losses(
    network: Network,
    surfaces: Sequence[Surface],
    banks: list[Bank],
    things: Bank,
    photos: Tensor,
    count: int,
    draw: Random,
    hard: float,
) -> tuple[Tensor, dict[str, float]]:
    """Dress a batch, run the network, add the losses up; also the figures worth a line in the log."""
    batches = dress(banks, things, photos, count, draw, hard)
    prompted = [draw.chance(count, 0.55) for _ in banks]
    inputs = torch.cat([network_input(b, draw, p) for b, p in zip(batches, prompted, strict=True)])
    device = next(network.parameters()).device  # pictures are dressed on the CPU wherever the network is
    inputs, batches = inputs.to(device), [b.to(device) for b in batches]
    with torch.autocast(inputs.device.type, torch.bfloat16):
        out = network(inputs.contiguous(memory_format=torch.channels_last))
        views = [network.look(out["coarse"][k * count : (k + 1) * count], k) for k in range(len(banks))]
        embedded = [network.embed(out["fine"][k * count : (k + 1) * count], k) for k in range(len(banks))]
    total = torch.zeros((), device=device)
    figures: dict[str, float] = {}
    kinds = torch.cat([torch.where(b.present, k, len(banks)) for k, b in enumerate(batches)])
    category = nn.functional.cross_entropy(out["category"].float(), kinds)
    total = total + 0.2 * category
    for k, batch in enumerate(batches):
        name = CATEGORIES[k]
        rows = slice(k * count, (k + 1) * count)
        parts = {
            "mask": mask_loss(out["mask"][rows, k], batch.mask),
            "stranger": mask_loss(out["mask"][rows, 1 - k], torch.zeros_like(batch.mask)),
            "view": view_loss(views[k], batch.view, batch.present),
            "place": surfaces[k].loss(embedded[k], batch.label, draw),
        }
        total = total + parts["mask"] + 0.15 * parts["stranger"] + 0.6 * parts["view"] + 0.15 * parts["place"]
        figures |= {f"{name}/{part}": float(value.detach()) for part, value in parts.items()}
        figures |= {f"{name}/{part}": value for part, value in _progress(views[k], out["mask"][rows, k], batch).items()}
    figures["category"] = float(category.detach())
    return total, figures


def _progress(logits: Tensor, mask: Tensor, batch: Batch) -> dict[str, float]:
    """Median azimuth error, share over 90 degrees, mean mask IoU of one batch."""
    with torch.no_grad():
        guess = logits.new_tensor(AZIMUTH_DEG, dtype=torch.float32)[view_blocks(logits)[0].argmax(1)]
        error = ((guess - torch.rad2deg(batch.view[:, 0]) + 180) % 360 - 180).abs()[batch.present]
        found = mask > 0
        truth = nn.functional.interpolate(batch.mask, mask.shape[1:], mode="area")[:, 0] > 0.5
        union = (found | truth).sum((1, 2)).clamp_min(1)
        overlap = ((found & truth).sum((1, 2)) / union)[batch.present]
        return {
            "azimuth_median_deg": float(error.median()),
            "reversed": float((error > 90).float().mean()),
            "iou": float(overlap.mean()),
        }


def train(
    banks: list[Bank],
    things: Bank,
    photos: Tensor,
    out: Path,
    minutes: float,
    seed: int,
    batch: int = 32,
    rate: float = 1.2e-3,
    steps: int | None = None,
    start: Path | None = None,
    device: str = "cpu",
) -> tuple[Network, nn.ModuleList]:
    """Train until the clock (or `steps`) says stop; returns the averaged network and the surfaces."""
    torch.manual_seed(seed)
    out.mkdir(parents=True, exist_ok=True)
    draw = Random(seed)
    network = Network()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    each = [make_surface(name, seed + k) for k, name in enumerate(CATEGORIES)]
    surfaces = nn.ModuleList(each)
    if start is not None:
        state = read_state(start)
        network.load_state_dict(state["network"])
        surfaces.load_state_dict(state["surfaces"])
    network.to(device)
    surfaces.to(device)
    averaged = copy.deepcopy(network).eval()
    weights = [*network.parameters(), *surfaces.parameters()]
    optimiser = torch.optim.AdamW(weights, rate, weight_decay=0.02, betas=(0.9, 0.98))
    begun = kept = time.monotonic()
    running: dict[str, float] = {}
    step = 0
    with (out / "log.jsonl").open("a", encoding="utf-8") as record:
        while True:
            spent_s = time.monotonic() - begun
            share = step / steps if steps else spent_s / (60 * minutes)
            if share >= 1:
                break
            for group in optimiser.param_groups:
                group["lr"] = rate * min(1.0, (step + 1) / 200) * _fall(share)
            network.train()
            loss, figures = step_losses(network, each, banks, things, photos, batch, draw, min(1.0, 0.2 + share / 0.15))
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimiser.step()
            _average(averaged, network, min(0.998, (step + 1) / (step + 10)))
            step += 1
            for name, value in {"loss": float(loss.detach()), **figures}.items():
                running[name] = running.get(name, 0.0) + value / LOG_EVERY
            if step % LOG_EVERY == 0:
                line = {"step": step, "pictures": step * batch * len(banks), "spent_s": round(time.monotonic() - begun)}
                record.write(json.dumps(line | {k: round(v, 4) for k, v in running.items()}) + "\n")
                record.flush()
                running = {}
            if time.monotonic() - kept > KEEP_EVERY_S:
                keep(out / "state.safetensors", averaged, surfaces)
                kept = time.monotonic()
    keep(out / "state.safetensors", averaged, surfaces)
    return averaged, surfaces


def _fall(share: float) -> float:
    """Learning-rate factor: full for a third of the run, then down to a hundredth along a cosine."""
    return (
        1.0
        if share < 0.35
        else 0.01 + 0.99 * 0.5 * (1 + float(torch.cos(torch.tensor((share - 0.35) / 0.65 * 3.14159))))
    )


def _average(averaged: nn.Module, network: nn.Module, keep_share: float) -> None:
    with torch.no_grad():
        for mine, theirs in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
            if mine.dtype.is_floating_point:
                mine.lerp_(theirs.to(mine.dtype), 1 - keep_share)
            else:
                mine.copy_(theirs)


def read_state(path: Path) -> dict[str, dict[str, Tensor]]:
    """State dictionaries `network` and `surfaces`, as `keep` wrote them."""
    state: dict[str, dict[str, Tensor]] = {"network": {}, "surfaces": {}}
    for key, value in load_file(path).items():
        name, _, rest = key.partition("/")
        state[name][rest] = value
    return state


def keep(path: Path, network: nn.Module, surfaces: nn.Module) -> None:
    """Write both state dictionaries, whole or not at all."""
    part = path.with_suffix(".part")
    parts = {"network": network, "surfaces": surfaces}
    flat = {f"{name}/{key}": v.cpu() for name, module in parts.items() for key, v in module.state_dict().items()}
    save_file({key: value.contiguous() for key, value in flat.items()}, part)
    part.replace(path)


def main(
    out: Annotated[Path, tyro.conf.Positional],
    bank: Path = Path("build/bank"),
    minutes: float = 75.0,
    seed: int = 0,
    batch: int = 32,
    threads: int = 1,
    photos: int = 3000,
    start: Path | None = None,
    device: str = "cpu",
) -> None:
    """Train the networks.

    Args:
        out: Folder for the state and the log.
        bank: Folder that `python -m synthetic.bank` filled: quadrupeds, humans and things.
        minutes: How long.
        seed: Of everything random.
        batch: Pictures a step and category.
        threads: CPU threads.
        photos: How many backgrounds to make.
        start: A `state.safetensors` to go on from.
        device: Where the network is trained: cpu or cuda. Pictures are dressed on the CPU.
    """
    import numpy as np

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(threads)
    pictures = torch.from_numpy(backgrounds(np.random.default_rng(seed), photos)).permute(0, 3, 1, 2).contiguous()
    log.info("%d backgrounds", len(pictures))
    train(
        [load_bank(bank, name) for name in CATEGORIES],
        load_bank(bank, "thing"),
        pictures,
        out,
        minutes,
        seed,
        batch,
        start=start,
        device=device,
    )


if __name__ == "__main__":
    tyro.cli(main)
