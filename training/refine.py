"""Train the network that refines rough masks: the categories' trunk, gone on with at twice the size.

``python -m training.refine OUT_DIR --bank BANK_DIR --start STATE.safetensors --steps 1200 --seed 0``

``BANK_DIR`` holds pictures of 192 px (``python -m synthetic.bank ... --side-px 192``). The network sees a picture and a
rough mask (:mod:`training.corruption`) and gives the true one at the picture's own size; it serves every category. A
run that finds its own ``refine.safetensors`` in ``OUT_DIR`` goes on with it.
"""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

from synthetic.backgrounds import backgrounds
from training.corruption import corrupted
from training.dressing import dress
from training.network import CATEGORIES, IMAGENET_MEAN, IMAGENET_STD, Network
from training.revive import calibrate, revive
from training.train import load_bank, read_state
from training.wardrobe import Bank, Random

log = logging.getLogger(__name__)
KEEP_SHARE = 0.995
CALIBRATION_BATCHES = 12
LOG_EVERY, KEEP_EVERY = 10, 50


class Refiner(nn.Module):
    """Picture and rough mask N x 4 x H x W (multiples of 16) -> logits N x H x W of the object the rough mask means."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = Network()
        self.head = nn.Conv2d(self.trunk.mask.in_channels, 4, 3, 1, 1)

    @classmethod
    def from_categories(cls, state: dict[str, Tensor]) -> Refiner:
        """Begun with the trunk of a trained `Network` and the mean of its categories' mask heads."""
        made = cls()
        made.trunk.load_state_dict(state)
        with torch.no_grad():
            made.head.weight.mul_(0.1)
            made.head.weight[:, :, 1, 1] += made.trunk.mask.weight.mean(0)[None, :, 0, 0]
            made.head.bias.fill_(float(made.trunk.mask.bias.mean()))  # type: ignore[union-attr]
        return made

    def forward(self, x: Tensor) -> Tensor:
        fine: Tensor = self.trunk.features(x)
        return functional.pixel_shuffle(self.head(fine), 2)[:, 0]


def refiner_input(image: Tensor, rough: Tensor) -> Tensor:
    """(B, 4, S, S): the normalised picture of (B, 3, S, S) sRGB, and the rough mask (B, 1, S, S)."""
    mean = torch.tensor(IMAGENET_MEAN)[None, :, None, None]
    std = torch.tensor(IMAGENET_STD)[None, :, None, None]
    return torch.cat([(image - mean) / std, rough], 1)


def refining_loss(logits: Tensor, mask: Tensor, lost: Tensor | None = None) -> Tensor:
    """Cross-entropy, four times as heavy near the outline, and overlap, of (B, S, S) logits against (B, S, S).

    `lost` (B, S, S): how heavy each pixel is besides, 1 and more (`lost_weight`).
    """
    logits = logits.float()
    around = functional.avg_pool2d(mask[:, None], 9, 1, 4, count_include_pad=False)[:, 0]
    weight = 1 + 3.0 * ((around > 0.01) & (around < 0.99))
    if lost is not None:
        weight = torch.maximum(weight, lost)
    crossed = functional.binary_cross_entropy_with_logits(logits, mask, weight=weight)
    probability = logits.sigmoid()
    shared = (probability * mask).sum((1, 2)) * 2 + 30
    return crossed + 0.5 * (1 - shared / (probability.sum((1, 2)) + mask.sum((1, 2)) + 30)).mean()


def lost_weight(mask: Tensor, rough: Tensor, heavy: float) -> Tensor:
    """(B, S, S): `heavy` where the object of (B, S, S) has a piece that its rough mask comes nowhere near, else 1.

    Feet and hands are few pixels: without it the network does well by leaving them out.
    """
    near = functional.max_pool2d(rough[:, None], 7, 1, 3)[:, 0] > 0.5
    return torch.where((mask > 0.5) & ~near, heavy, 1.0)


def examples(
    banks: list[Bank], things: Bank, photos: Tensor, count: int, draw: Random, hide: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Fresh pictures (B, 3, S, S), their true masks and rough ones (B, 1, S, S); those with an object in them.

    In a share `hide` of them an end of the object looks like its background.
    """
    batches = dress(banks, things, photos, count, draw, 0.7, hide)
    shown = torch.cat([b.present for b in batches])
    image, mask, hidden = (torch.cat([getattr(b, n) for b in batches])[shown] for n in ("image", "mask", "hidden"))
    return image, mask, corrupted(mask, image, draw, hidden if hide > 0 else None)


def overlap(found: Tensor, truth: Tensor) -> float:
    """Mean intersection over union of (B, S, S) boolean maps."""
    return float(((found & truth).sum((1, 2)) / (found | truth).sum((1, 2)).clamp_min(1)).mean())


def train(
    banks: list[Bank], things: Bank, photos: Tensor, out: Path, start: Path, steps: int, seed: int,
    batch: int = 8, rate: float = 8e-4, total: int = 1200, hide: float = 0.0, lost: float = 1.0,
) -> Refiner:  # fmt: skip
    """`steps` more steps, of `total` that the learning rate is planned for; returns the averaged network."""
    out.mkdir(parents=True, exist_ok=True)
    kept = out / "refine.safetensors"
    network = Refiner() if kept.exists() else _begun(start, banks, things, photos, batch, seed)
    averaged = Refiner()
    averaged.load_state_dict(network.state_dict())
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=0.02, betas=(0.9, 0.98))
    first = 0
    if kept.exists():
        first = _resume(kept, network, averaged, optimiser)
    draw = Random(seed + first)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.train()
    running: list[tuple[float, float, float]] = []
    begun = time.monotonic()
    with (out / "refine.jsonl").open("a", encoding="utf-8") as record:
        for step in range(first, first + steps):
            share = min(step / total, 1.0)
            falling = 0.5 + 0.5 * float(np.cos(np.pi * max(share - 0.3, 0) / 0.7))
            for group in optimiser.param_groups:
                group["lr"] = rate * min(1.0, (step + 1) / 60) * max(falling, 0.02)
            image, mask, rough = examples(banks, things, photos, batch, draw, hide)
            inputs = refiner_input(image, rough).contiguous(memory_format=torch.channels_last)
            with torch.autocast("cpu", torch.bfloat16):
                logits = network(inputs)
            loss = refining_loss(logits, mask[:, 0], lost_weight(mask[:, 0], rough[:, 0], lost))
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            _average(averaged, network, min(KEEP_SHARE, (step + 1) / (step + 10)))
            truth = mask[:, 0] > 0.5
            running.append((float(loss.detach()), overlap(rough[:, 0] > 0.5, truth), overlap(logits > 0, truth)))
            if (step + 1) % LOG_EVERY == 0:
                mean = [round(float(v), 4) for v in np.mean(running, 0)]
                line = {"step": step + 1, "pictures": (step + 1) * batch * len(banks)}
                line |= {"spent_s": round(time.monotonic() - begun)}  # type: ignore[dict-item]
                line |= dict(zip(("loss", "rough_iou", "iou"), mean, strict=True))  # type: ignore[arg-type]
                record.write(json.dumps(line) + "\n")
                record.flush()
                running = []
            if (step + 1) % KEEP_EVERY == 0:
                _keep(kept, network, averaged, optimiser, step + 1)
    _keep(kept, network, averaged, optimiser, first + steps)
    return averaged


def _begun(start: Path, banks: list[Bank], things: Bank, photos: Tensor, batch: int, seed: int) -> Refiner:
    """From the categories' trained networks, or from a refiner as it was exported."""
    if start.suffix != ".onnx":
        return Refiner.from_categories(read_state(start)["network"])
    made = Refiner()
    revive(made.trunk, made.head, start)
    draw = Random(seed)
    pictures = [examples(banks, things, photos, batch, draw) for _ in range(CALIBRATION_BATCHES)]
    calibrate(made, [refiner_input(image, rough) for image, _, rough in pictures])
    return made


def _average(averaged: nn.Module, network: nn.Module, keep_share: float) -> None:
    with torch.no_grad():
        for mine, theirs in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
            if mine.dtype.is_floating_point:
                mine.lerp_(theirs.to(mine.dtype), 1 - keep_share)
            else:
                mine.copy_(theirs)


def _keep(path: Path, network: nn.Module, averaged: nn.Module, optimiser: torch.optim.Optimizer, step: int) -> None:
    """Everything needed to go on, whole or not at all."""
    flat = {"step": torch.tensor(step)}
    for name, module in (("network", network), ("averaged", averaged)):
        flat |= {f"{name}/{key}": value.contiguous() for key, value in module.state_dict().items()}
    for k, state in optimiser.state_dict()["state"].items():
        flat |= {f"optimiser/{k}/{key}": value.contiguous() for key, value in state.items()}
    part = path.with_suffix(".part")
    save_file(flat, part)
    part.replace(path)


def _resume(path: Path, network: nn.Module, averaged: nn.Module, optimiser: torch.optim.Optimizer) -> int:
    flat = load_file(path)
    for name, module in (("network", network), ("averaged", averaged)):
        module.load_state_dict({k.removeprefix(f"{name}/"): v for k, v in flat.items() if k.startswith(f"{name}/")})
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in flat.items():
        if key.startswith("optimiser/"):
            _, number, entry = key.split("/")
            state.setdefault(int(number), {})[entry] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    return int(flat["step"])


def averaged_refiner(path: Path) -> Refiner:
    """The averaged network of a `refine.safetensors`, for use."""
    made = Refiner()
    flat = load_file(path)
    made.load_state_dict({k.removeprefix("averaged/"): v for k, v in flat.items() if k.startswith("averaged/")})
    return made.eval()


def main(
    out: Annotated[Path, tyro.conf.Positional],
    bank: Path = Path("build/bank192"),
    start: Path = Path("build/networks/state.safetensors"),
    steps: int = 1200,
    total: int = 1200,
    seed: int = 0,
    batch: int = 8,
    hide: float = 0.0,
    lost: float = 1.0,
    photos: int = 1000,
    threads: int = 1,
) -> None:
    """Train the refiner.

    Args:
        out: Folder for the state and the log.
        bank: Folder of pictures of 192 px: quadrupeds, humans and things.
        start: The categories' trained networks, or a refiner as it was exported (.onnx) to go on from.
        steps: How many steps now.
        total: How many steps in all; the learning rate has fallen by then.
        seed: Of everything random.
        batch: Pictures a step and category.
        hide: Share of pictures in which an end of the object looks like its background.
        lost: How heavy pieces are that the rough mask lacks; with 1, and `hide` 0, the shipped refiner was made.
        photos: How many backgrounds to make.
        threads: CPU threads.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(threads)
    cached = out / "backgrounds.npy"
    if not cached.exists():
        out.mkdir(parents=True, exist_ok=True)
        np.save(cached, backgrounds(np.random.default_rng(seed), photos, 192), allow_pickle=False)
    pictures = torch.from_numpy(np.load(cached, allow_pickle=False)).permute(0, 3, 1, 2).contiguous()
    banks = [load_bank(bank, name) for name in CATEGORIES]
    train(banks, load_bank(bank, "thing"), pictures, out, start, steps, seed, batch, total=total, hide=hide, lost=lost)


if __name__ == "__main__":
    tyro.cli(main)
