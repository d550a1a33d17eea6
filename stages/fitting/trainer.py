"""The loop of one phase: a step, its schedule, what it remembers. State in, state out; no files.

Resuming is exact: all randomness comes from (seed, step), and everything a step reads beside the observations is in
:meth:`Trainer.state`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from stages.fitting.active import Uncertainty, most_uncertain
from stages.fitting.batches import Batch, draw, step_generator
from stages.fitting.connect import mend
from stages.fitting.diagnose import FrameFigures, frame_figures, misfits, replace_from_neighbours
from stages.fitting.evidence import share_on_masks
from stages.fitting.objective import evaluate
from stages.fitting.observations import Observations
from stages.fitting.recurrence import Recurred, share_motion
from stages.fitting.renew import renew_bones, renew_bounds
from stages.fitting.rethink import Rethought, second_thoughts
from stages.fitting.schedule import PhaseSettings, beta_at, rate_at
from stages.fitting.surface import frame_boxes, surface_points
from stages.fitting.team import ALONE, Team
from stages.model.banmo import Banmo

_PRACTISED = 40
"""How often a frame is drawn at least while another reading of it is fitted."""
_PRACTISED_TOGETHER = 19
"""... and while two stretches are fitted as one motion: each frame has another's pictures, too."""

Told = TypeVar("Told", Rethought, Recurred)


class Diverged(RuntimeError):
    """The objective is not finite any more; `term` names the loss that broke first."""

    def __init__(self, step: int, term: str) -> None:
        super().__init__(f"the loss '{term}' is not finite at step {step}")
        self.step, self.term = step, term


class Trainer:
    """One phase of the optimisation of `model` on `observations`."""

    def __init__(self, model: Banmo, observations: Observations, settings: PhaseSettings, team: Team = ALONE) -> None:
        self.model, self.observations, self.settings, self.team = model, observations, settings, team
        self.step_idx = 0
        self.rate_scale = 1.0
        self.trust = torch.ones(len(observations))
        self.renewal_error: float | None = None  # units; see renew_bones
        self.rethought: Rethought | None = None
        self.reread = torch.zeros(2, dtype=torch.int64)  # frames looked at and read anew so far
        self.recurred: Recurred | None = None
        self.shared = torch.zeros(2, dtype=torch.int64)  # frames that may show one motion with others, and that do
        self.pause: Callable[[str], None] = lambda doing: None  # called during long work between two steps; may raise
        self.uncertainty: Uncertainty | None = None
        if settings.active_share > 0:
            octaves = model.architecture.octaves
            self.uncertainty = Uncertainty(len(model.videos), octaves, step_generator(settings.seed, 0, rank=7))
            self.uncertainty.to(self.device)
        model.use_delta = model.use_delta or settings.delta_from <= 0
        self._agree()
        self.refresh()
        self.optimiser = self._optimiser()

    @property
    def device(self) -> torch.device:
        """Where the model lives; observations stay in main memory."""
        return self.model.base_poses.device

    # ------------------------------------------------------------------------------------------ parameters

    def groups(self) -> dict[str, tuple[list[torch.nn.Parameter], float]]:
        """Parameter groups by name, with their step sizes."""
        m, s = self.model, self.settings
        sdf: list[torch.nn.Parameter] = []
        colour: list[torch.nn.Parameter] = []
        for name, parameter in m.field.named_parameters():
            appearance = ("colour", "embedding", "environment", "appearance")
            (colour if name.startswith(appearance) else sdf).append(parameter)
        return {
            "sdf": (sdf, s.lr_sdf),
            "colour": (colour, s.lr_colour),
            "environment": (list(m.environment.parameters()), s.lr_motion if s.lr_colour else 0.0),
            "motion": ([*m.body.parameters(), *(m.dense.parameters() if m.dense else ())], s.lr_motion),
            "bones": (list(m.bones.parameters()), s.lr_bones),
            "root": (list(m.root.parameters()), s.lr_root),
            "focal": ([m.log_focal], s.lr_focal),
            "delta": (list(m.delta.parameters()), s.lr_delta),
            "uncertainty": (list(self.uncertainty.parameters()) if self.uncertainty else [], 2e-3),
        }

    def _optimiser(self) -> torch.optim.Adam:
        groups = []
        for name, (parameters, rate) in self.groups().items():
            for parameter in parameters:
                parameter.requires_grad_(rate > 0)
            if rate > 0 and parameters:
                groups.append({"params": parameters, "lr": rate, "base": rate, "name": name})
        return torch.optim.Adam(groups, lr=1e-3, betas=(0.9, 0.99), eps=1e-10)

    # ------------------------------------------------------------------------------------------ steps

    @property
    def progress(self) -> float:
        """Share of the phase done, 0..1."""
        return self.step_idx / max(1, self.settings.iterations)

    @property
    def done(self) -> bool:
        """Whether every step has been made."""
        return self.step_idx >= self.settings.iterations

    def refresh(self) -> None:
        """Extract the surface anew and each frame's box around it: near and far planes, matching bounds."""
        if self.settings.mend and self.settings.lr_sdf > 0 and self.progress >= self.settings.mend_from:
            mend(self.model, self._seen)
        points = self.team.agree(surface_points(self.model).to(self.device))
        if len(points) >= 100:
            self.model.surface = points
        self.boxes = self.team.agree(frame_boxes(self.model))

    def _seen(self, points: Tensor) -> Tensor:
        return share_on_masks(self.model, self.observations, points.to(self.device))

    def step(self) -> dict[str, float]:
        """One step of descent; returns the weighted value of each term.

        Raises :class:`Diverged` before anything is updated.
        """
        s, model = self.settings, self.model
        if self.step_idx and self.step_idx % s.update_bounds_every == 0:
            self.refresh()
        if self.step_idx and self.step_idx == round(s.renew_at * s.iterations):
            self._renew()
        if self.step_idx and s.lr_motion > 0:
            if self.step_idx in {round(at * s.iterations) for at in s.recur_at}:
                self._share_motion()
            if self.step_idx in {round(at * s.iterations) for at in s.rethink_at}:
                self._rethink()
        if self.step_idx and self.step_idx == round(s.reject_at * s.iterations):
            self._reject()
        if self.progress >= s.delta_from:
            model.use_delta = True
        generator = step_generator(s.seed, self.step_idx)
        batch = self._draw(generator)
        beta = max(beta_at(s, self.progress), model.beta_floor)
        terms = evaluate(model, self.boxes, batch, s, beta, self.step_idx, generator, self.team, self.uncertainty)
        total = torch.stack(list(terms.values())).sum()
        whole = torch.stack([value.detach() for value in terms.values()])
        self.team.sum([whole])
        values = dict(zip(terms, whole.tolist(), strict=True))
        if not torch.isfinite(whole).all():
            raise Diverged(self.step_idx, next(n for n, v in values.items() if not math.isfinite(v)))
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        self._share_gradients()
        rate = rate_at(s, self.step_idx) * self.rate_scale
        frozen = self.progress < s.sdf_frozen_until
        for group in self.optimiser.param_groups:
            group["lr"] = 0.0 if frozen and group["name"] == "sdf" else group["base"] * rate
            torch.nn.utils.clip_grad_norm_(group["params"], 10.0)
        self.optimiser.step()
        self.step_idx += 1
        if self.done and s.lr_sdf > 0:
            self.refresh()  # what the last steps carved off is tied again: the next phase and the export see one body
        values["total"] = sum(values.values())
        return values

    def _agree(self) -> None:
        """Take the leader's weights: what processes compute alone may differ in the last digit between machines."""
        for tensor in (*self.model.parameters(), *self.model.buffers()):
            tensor.data = self.team.agree(tensor.data)

    def _share_gradients(self) -> None:
        """Sum gradients over the team. Every process has the same terms, so the same parameters have one."""
        groups = self.optimiser.param_groups
        self.team.sum([p.grad for group in groups for p in group["params"] if p.grad is not None])

    def figures(self) -> FrameFigures:
        """How well each frame is explained as things stand."""
        beta = max(beta_at(self.settings, self.progress), self.model.beta_floor)
        return frame_figures(self.model, self.observations, self.boxes, self.settings, beta)

    def _reject(self) -> None:
        """Frames that fit far worse than their clip count for a tenth from now on."""
        bad = misfits(self.figures().overlap, self.observations.video_idx)
        self.trust = self.team.agree(torch.where(bad, self.trust * 0.1, self.trust).to(self.device)).cpu()
        if replace_from_neighbours(self.model, self.trust < 1):
            self._agree()
            self.refresh()

    def _trusted(self) -> Observations:
        return replace(self.observations, frame_weight=self.observations.frame_weight * self.trust)

    def _draw(self, generator: torch.Generator) -> Batch:
        """The step's batch. Later in the phase some pixels of each frame are the most uncertain of many candidates."""
        s = self.settings
        active = round(s.active_share * s.pixels_per_frame) if self.progress >= s.active_from else 0
        if self.uncertainty is None or not active:
            return draw(self._trusted(), s.frames_per_step, s.pixels_per_frame, generator, s.edge_share).to(self.device)
        plain = s.pixels_per_frame - active
        batch = draw(self._trusted(), s.frames_per_step, plain + 4 * active, generator, s.edge_share).to(self.device)
        with torch.no_grad():
            expected = self.uncertainty.of(self.model, batch)
        keep = torch.arange(plain, device=self.device).expand(s.frames_per_step, -1)
        return batch.pixels_of(torch.cat([keep, plain + most_uncertain(expected[:, plain:], active)], 1))

    def _renew(self) -> None:
        """Bones and box anew on the shape as it is now; the optimiser starts afresh, as the parameters are new."""
        self.refresh()
        if len(self.model.surface) < 100:
            return
        renew_bounds(self.model, margin=0.2)
        self.renewal_error = renew_bones(self.model, self.settings.seed + self.step_idx)
        self._agree()
        self.refresh()
        self.optimiser = self._optimiser()

    def _rethink(self) -> None:
        """Other readings of what may have been misread."""
        told = self._look_back(second_thoughts, _PRACTISED, "having second thoughts")
        self.rethought = told or Rethought(0, 0, 0.0)
        self.reread += torch.tensor(self.rethought[:2])

    def _share_motion(self) -> None:
        """One motion for stretches that show the same."""
        told = self._look_back(share_motion, _PRACTISED_TOGETHER, "looking for motion that recurs")
        self.recurred = told or Recurred(0, 0, 0.0)
        self.shared += torch.tensor(self.recurred[:2])

    def _look_back(self, look: Callable[..., Told], practised: int, doing: str) -> Told | None:
        """Change motion by what copies of the model tell, of which motion alone is fitted; None where a copy diverges.

        The motion's moments start afresh where it was changed. `practised` is how often each frame is drawn at least.
        """
        settings = self._motion_alone()

        def practise(
            model: Banmo, seen: Observations, between: Callable[[Banmo, int], None] = lambda some, step: None
        ) -> None:
            trainer = Trainer(model, seen, settings, self.team)
            trainer.rate_scale = self.rate_scale
            while not trainer.done:
                self.pause(doing)
                trainer.step()
                between(model, trainer.step_idx)

        def figures_of(model: Banmo, seen: Observations) -> FrameFigures:
            self.pause(doing)
            return frame_figures(model, seen, frame_boxes(model), self.settings, settings.beta_start, pixels=400)

        most = settings.iterations * settings.frames_per_step // practised
        try:
            told = look(self.model, self._trusted(), figures_of, practise, most, settings.seed, self._agree_on)
        except Diverged:  # a copy did, in every process alike: the model itself is as it was
            return None
        if told.taken:
            self._agree()
            self.refresh()
            for parameter in self.groups()["motion"][0]:
                self.optimiser.state.pop(parameter, None)
        return told

    def _motion_alone(self) -> PhaseSettings:
        """Settings by which copies of the model are fitted: their motion and nothing else."""
        s = self.settings
        beta = max(beta_at(s, self.progress), self.model.beta_floor)
        quiet: dict[str, Any] = {f"lr_{name}": 0.0 for name in ("sdf", "colour", "bones", "root", "focal", "delta")}
        # Where a pose ends depends on how many steps it makes more than on how many rays each step has.
        few = max(self.team.size, -(-s.frames_per_step // 2))
        rays: dict[str, Any] = {"frames_per_step": few, "pixels_per_frame": -(-2 * s.pixels_per_frame // 3)}
        steps = max(1, round(3 * s.rethink_share * s.iterations / 2))
        return replace(
            s, **quiet, **rays, iterations=steps, beta_start=beta, beta_end=beta,
            cover_from=0.0, spill_from=0.0, decay_from=0.5, warmup_steps=10, active_share=0.0, flow_only_every=0,
            renew_at=2.0, reject_at=2.0, rethink_at=(), recur_at=(), delta_from=2.0, seed=s.seed + self.step_idx,
        )  # fmt: skip

    def _agree_on(self, told: Tensor) -> Tensor:
        """What the first process has, on the CPU, in all of them."""
        return self.team.agree(told.to(self.device)).cpu()

    # ------------------------------------------------------------------------------------------ state

    def state(self) -> dict[str, Tensor]:
        """All tensors a resume needs: model, optimiser moments, boxes, counters."""
        out = {f"model.{k}": v.clone() for k, v in self.model.state_dict().items()}
        out["boxes"] = self.boxes.clone()
        if self.uncertainty is not None:
            out |= {f"uncertainty.{k}": v.clone() for k, v in self.uncertainty.state_dict().items()}
        out["trust"] = self.trust.clone()
        out["reread"] = self.reread.clone()
        out["shared"] = self.shared.clone()
        out["counters"] = torch.tensor([self.step_idx, int(self.model.use_delta), self.settings.iterations])
        out["rate_scale"] = torch.tensor([self.rate_scale], dtype=torch.float64)
        for g, group in enumerate(self.optimiser.param_groups):
            for p, parameter in enumerate(group["params"]):
                moments = self.optimiser.state.get(parameter, {})
                for key, value in moments.items():
                    out[f"adam.{g}.{p}.{key}"] = torch.as_tensor(value).clone()
        return out

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from what :meth:`state` gave, bit for bit."""
        tensors = {k.removeprefix("model."): v for k, v in state.items() if k.startswith("model.")}
        self.model.surface = torch.zeros_like(tensors["surface"], device=self.device)
        self.model.load_state_dict(tensors)
        self.trust = state["trust"].cpu().clone()
        self.reread = state["reread"].cpu().clone()
        self.shared = state["shared"].cpu().clone()
        self.boxes = state["boxes"].to(self.device, copy=True)
        self.step_idx = int(state["counters"][0])
        self.model.use_delta = bool(state["counters"][1])
        self.rate_scale = float(state["rate_scale"][0])
        if self.uncertainty is not None:
            prefix = "uncertainty."
            self.uncertainty.load_state_dict({k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)})
        self.optimiser = self._optimiser()
        for g, group in enumerate(self.optimiser.param_groups):
            for p, parameter in enumerate(group["params"]):
                prefix = f"adam.{g}.{p}."
                for key, value in state.items():
                    if key.startswith(prefix):  # moments lie beside their parameter, Adam's step count on the CPU
                        place = parameter.device if value.shape == parameter.shape else torch.device("cpu")
                        self.optimiser.state[parameter][key.removeprefix(prefix)] = value.to(place, copy=True)
