"""Several processes at one optimisation: who takes which frames of a batch, and how their gradients meet.

Every process holds the whole model and draws the whole batch from the same seed; each renders its own frames, and
gradients are summed. So losses and weights do not depend on how many processes there are, up to the order in which
floats are added. Alone, nothing is communicated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Team:
    """`size` processes, of which this is number `rank`."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process is the one that writes."""
        return self.rank == 0

    def part(self, count: int) -> slice:
        """Which of `count` frames are this process's: neighbours, as even as can be."""
        return slice(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def sum(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the processes; one message for all of them."""
        if self.size == 1 or not tensors:
            return
        flat = torch.cat([t.reshape(-1) for t in tensors])
        dist.all_reduce(flat)
        for tensor, part in zip(tensors, flat.split([t.numel() for t in tensors]), strict=True):
            tensor.copy_(part.reshape(tensor.shape))

    def any(self, flag: bool, device: torch.device) -> bool:
        """Whether `flag` is true in any of the processes."""
        if self.size == 1:
            return flag
        count = torch.tensor([float(flag)], device=device)
        dist.all_reduce(count)
        return bool(count > 0)

    def agree(self, tensor: Tensor) -> Tensor:
        """The leader's tensor (N, ...) for all; sizes along the first axis may differ."""
        if self.size == 1:
            return tensor
        length = torch.tensor([len(tensor)], device=tensor.device)
        dist.broadcast(length, 0)
        same = tensor.contiguous() if self.leads else tensor.new_zeros((int(length), *tensor.shape[1:]))
        dist.broadcast(same, 0)
        return same

    def wait(self) -> None:
        """Until every process is here."""
        if self.size > 1:
            dist.barrier()


ALONE = Team()


@contextmanager
def joined(rank: int, size: int, device: str, patience_s: float = 1800) -> Iterator[Team]:
    """A team of `size`, met at ``MASTER_ADDR``:``MASTER_PORT``: over nccl on GPUs, gloo on CPUs.

    A process that has waited for the others for `patience_s` fails. One process alone meets nobody.
    """
    if size == 1:
        yield ALONE
        return
    backend = "nccl" if device.startswith("cuda") else "gloo"
    dist.init_process_group(backend, rank=rank, world_size=size, timeout=timedelta(seconds=patience_s))
    try:
        yield Team(rank, size)
    finally:
        dist.destroy_process_group()
