"""How many steps fit into the time given, by trying a few: a short run is then a finished run."""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import replace

from stages.fitting.trainer import Trainer

_LEAST, _MOST = 20, 1_000_000
_OVERHEAD = 0.08  # checkpoints, pictures, surfaces extracted anew


def affordable_steps(trainer: Trainer, minutes: float, tries: int = 6) -> int:
    """Steps that the machine makes in `minutes`, measured on a copy of the model that is thrown away.

    In a team every process takes part, as a step needs all of them; their answers differ a little.
    """
    model = deepcopy(trainer.model)
    settings = trainer.settings
    trial = Trainer(model, trainer.observations, replace(settings, rethink_at=(), recur_at=()), trainer.team)
    trial.step()  # the first one also warms caches
    start = time.perf_counter()
    for _ in range(tries):
        trial.step()
    each = (time.perf_counter() - start) / tries
    asides = [at for times in (settings.rethink_at, settings.recur_at) for at in set(times) if 0 < at < 1]
    each *= 1 + settings.rethink_share * len(asides)
    return max(_LEAST, min(_MOST, round(minutes * 60 * (1 - _OVERHEAD) / each)))
