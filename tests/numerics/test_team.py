"""Two processes at one optimisation, for real (gloo): the same losses and weights as one; only the first writes."""

from __future__ import annotations

import multiprocessing
import os
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pipeline import BadInput, Interrupted, Run
from stages import phases
from stages.checkpoint import Checkpoints
from stages.fitting import recurrence, rethink
from stages.fitting import trainer as training
from stages.fitting.batches import Draws, draw, step_generator
from stages.fitting.team import ALONE, Team, joined
from stages.fitting.trainer import Diverged, Trainer
from stages.model.banmo import Banmo
from tests.numerics.analytic_scene import model_of, scene, sphere, stir, tiny_settings

STEPS = 7
# Five frames a step do not halve: the processes' shares differ, and so must their weights.
SETTINGS = tiny_settings(iterations=STEPS, frames_per_step=5, renew_at=4 / STEPS, delta_from=0.3, active_share=0.25)
PATIENCE_S = 240


def first_model() -> Banmo:
    model = model_of(scene(sphere(0.5), frames=4), lambda x: x.norm(dim=-1) - 0.45)
    stir(model, 0.1)
    return model


def train(team: Team) -> tuple[list[dict[str, float]], dict[str, torch.Tensor]]:
    trainer = Trainer(first_model(), scene(sphere(0.5), frames=4).observations, SETTINGS, team)
    values = [trainer.step() for _ in range(STEPS)]
    return values, trainer.state()


def think(team: Team) -> tuple[list[float], dict[str, torch.Tensor]]:
    """One motion for both clips, and second thoughts about every frame, whatever the poses are."""
    recurrence.recurring = lambda *_: torch.tensor([*range(4, 8), *range(4)])  # type: ignore[assignment]
    recurrence._TOLERATED, recurrence._EVERY = 9.0, 1
    rethink.doubtful = lambda error, model: torch.ones(len(error), dtype=torch.bool)  # type: ignore[assignment]
    rethink._APART, rethink._LEAST_GAIN, training._PRACTISED = 1e-4, -9.0, 1
    settings = replace(SETTINGS, rethink_share=0.6)
    trainer = Trainer(first_model(), scene(sphere(0.5), frames=4).observations, settings, team)
    trainer._share_motion()
    assert trainer.recurred is not None and trainer.recurred.taken == 8
    trainer._rethink()
    assert trainer.rethought is not None
    return [*trainer.recurred, *trainer.rethought], trainer.state()


def phase(rank: int, size: int, folder: Path, stop_at: int | None) -> str:
    """What ``fit`` does once its inputs are read, as process `rank`; the second one is asked to stop."""
    seen = scene(sphere(0.5), frames=4)
    run = Run(checkpoint_dir=folder / "points", rank=rank, world_size=size)
    if rank == size - 1 and stop_at is not None:
        run.tick = lambda done, *_, **__: run.request_stop() if done >= stop_at else None  # type: ignore[method-assign]
    checkpoints = Checkpoints(run.checkpoint_dir)
    saved = checkpoints.latest()
    model = first_model() if saved is None else Banmo.restore(saved.model_tensors(), saved.description)
    written: list[int] = []
    phases._write_folder = lambda *_: written.append(rank)  # type: ignore[assignment]
    collection: Any = type("Collection", (), {"observations": seen.observations})
    try:
        phases.run_phase(model, collection, SETTINGS, checkpoints, folder, run, "fitting")
    except Interrupted:
        return "stopped"
    return f"wrote {len(written)}"


def meet(port: int) -> None:
    """Where the next team meets; a port a meeting, as a process that runs one action only ever joins one."""
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


def member(rank: int, size: int, ports: list[int], folder: str) -> None:
    """One process of the team: trains, then runs a phase that is stopped and continued; keeps what it saw."""
    meet(ports[0])
    torch.set_num_threads(1)
    phases._write_preview = lambda *_: None  # type: ignore[assignment]
    with joined(rank, size, "cpu", PATIENCE_S) as team:
        values, state = train(team)
        thoughts, state_after = think(team)
        mixed = [float(rank), 1.0]
        tensors = [torch.tensor(mixed), torch.full((2, 2), 2.0 * rank)]
        team.sum(tensors)
        agreed = team.agree(torch.arange(rank + 1.0) + 5)
        flags = [team.any(rank == 1, torch.device("cpu")), team.any(False, torch.device("cpu"))]
    outcomes = []
    for port, stop_at in ((ports[1], 3), (ports[2], None)):
        meet(port)
        outcomes.append(phase(rank, size, Path(folder), stop_at))
    torch.save(
        {
            "values": values,
            "state": state,
            "thoughts": thoughts,
            "state_after": state_after,
            "sums": tensors,
            "agreed": agreed,
            "flags": flags,
            "outcomes": outcomes,
        },
        f"{folder}/rank{rank}.pt",
    )


@pytest.fixture(scope="module")
def members(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What two processes saw."""
    folder = tmp_path_factory.mktemp("team")
    ports = free_ports(3)
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=member, args=(r, 2, ports, str(folder))) for r in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(PATIENCE_S)
    try:
        assert [p.exitcode for p in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()
    return [torch.load(folder / f"rank{r}.pt", weights_only=True) for r in range(2)]


def test_two_processes_lose_what_one_loses(members: list[dict[str, Any]]) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    values, state = train(ALONE)
    torch.set_num_threads(threads)
    for step in range(STEPS):
        assert members[0]["values"][step] == members[1]["values"][step]
        assert members[0]["values"][step].keys() == values[step].keys()
        # Sums in another order, and Adam divides by the size of tiny gradients: digits are lost step by step.
        for name, value in values[step].items():
            assert members[0]["values"][step][name] == pytest.approx(value, rel=2e-3, abs=1e-6), (step, name)
    first = {name: members[0]["values"][0][name] for name in values[0]}
    assert first == pytest.approx(values[0], rel=1e-5, abs=1e-8)
    for name in state:
        assert torch.equal(members[0]["state"][name], members[1]["state"][name]), name
    for name in ("model.field.sdf_grids.0", "model.body.head.out.weight", "model.bones.centres", "boxes"):
        assert torch.allclose(members[0]["state"][name], state[name], atol=2e-3), name


def test_two_processes_think_alike(members: list[dict[str, Any]]) -> None:
    first, second = members
    assert first["thoughts"] == second["thoughts"]
    looked_at, taken, _ = first["thoughts"][3:]
    assert looked_at >= 4 and taken >= 3
    for name, value in first["state_after"].items():
        assert torch.equal(value, second["state_after"][name]), name


def test_messages_of_a_team(members: list[dict[str, Any]]) -> None:
    for seen in members:
        assert seen["sums"][0].tolist() == [1.0, 2.0] and seen["sums"][1].tolist() == [[2.0, 2.0]] * 2
        assert seen["agreed"].tolist() == [5.0]
        assert seen["flags"] == [True, False]


def test_one_asked_to_stop_stops_all_and_only_the_first_writes(members: list[dict[str, Any]]) -> None:
    assert members[0]["outcomes"] == ["stopped", "wrote 1"]
    assert members[1]["outcomes"] == ["stopped", "wrote 0"]


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_parts_cover_a_batch_once(size: int) -> None:
    parts = [Team(r, size).part(5) for r in range(size)]
    assert np.concatenate([np.arange(5)[p] for p in parts]).tolist() == list(range(5))
    assert max(p.stop - p.start for p in parts) - min(p.stop - p.start for p in parts) <= 1


def test_a_frame_gets_the_same_draws_in_any_part() -> None:
    seen = scene(sphere(0.5), frames=4)
    batch = draw(seen.observations, 5, 6, step_generator(0, 0))
    device = torch.device("cpu")
    whole = Draws(step_generator(1, 2), 5, slice(0, 5), device)
    halves = [Draws(step_generator(1, 2), 5, Team(r, 2).part(5), device) for r in range(2)]
    assert torch.equal(torch.cat([h.uniform(3, 2) for h in halves]), whole.uniform(3, 2))
    assert torch.equal(torch.cat([h.below(9, 4) for h in halves]), whole.below(9, 4))
    parts = [batch.of(Team(r, 2).part(5)) for r in range(2)]
    assert torch.equal(torch.cat([p.pixels for p in parts]), batch.pixels)


def test_more_processes_than_frames_are_refused(tmp_path: Path) -> None:
    run = Run(checkpoint_dir=tmp_path, rank=0, world_size=9)
    collection: Any = None
    with pytest.raises(BadInput, match="9 processes for 5 frames"):
        phases.run_phase(first_model(), collection, SETTINGS, Checkpoints(tmp_path), tmp_path, run, "fitting")


def test_a_team_diverges_together() -> None:
    broken = scene(sphere(0.5), frames=4)
    for step in broken.observations.flow:
        broken.observations.flow[step][:] = torch.nan
    trainer = Trainer(first_model(), broken.observations, SETTINGS, ALONE)
    with pytest.raises(Diverged, match="'flow'"):
        trainer.step()
