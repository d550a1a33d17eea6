"""One hypothesis of the search: a coloured volume, every frame's posterior over the views, and their alternation."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import grid_sample, interpolate

from stages.registration.placing import smooth
from stages.registration.tracking import azimuth_steps, elevation_step, forward_backward, posterior_angles
from stages.registration.volume import EXTENT, ViewBank, pixel_axis, pixel_grid
from stages.registration.windows import Windows, difference, like_views


@dataclass
class Sequence:
    """A clip as a hypothesis sees it."""

    windows: Windows
    drift: np.ndarray  # (T - 1,) turn between the chosen frames that the flow suggests, radians
    step_sigma: np.ndarray  # (T - 1,) how far the turn may differ from it
    fixed: np.ndarray | None = None  # (T, A, E) posterior of clips whose poses are given
    bearing: np.ndarray | None = None  # (T, A) log-probability of the bank's azimuths, from a network
    like: torch.Tensor | None = None  # cached Windows.like()


@dataclass(frozen=True)
class Weights:
    """Weights of the search; see :class:`Hypothesis`."""

    colour: float = 0.5
    size: float = 0.5
    smooth: float = 0.02
    empty: float = 0.001
    bearing: float = 0.3  # a network errs alike in neighbouring frames, so each counts for less than one
    elevation_mean: float = np.radians(18.0)
    elevation_sigma: float = np.radians(12.0)


class Hypothesis:
    """Volume and posteriors. `improve` fits the volume to the posteriors' mean pictures, `look` does the converse.

    This is expectation maximisation as in reconstruction from unknown projections: every view of the volume is
    compared with every frame, time ties the frames of a clip together, and the volume is what the frames, shared out
    over the views, show on average. The size of the object in the picture, with a depth that changes smoothly, is
    part of the comparison.
    """

    def __init__(self, sequences: list[Sequence], bank: ViewBank, voxels: int, weights: Weights, seed: int) -> None:
        self.sequences, self.bank, self.voxels, self.weights = sequences, bank, voxels, weights
        self.random = torch.Generator().manual_seed(seed)
        axis = pixel_axis(voxels) * EXTENT
        radius = (axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None] ** 2).sqrt()
        channels = sequences[0].windows.colour.shape[-1]
        self.logit = (2 - 6 * radius).clamp(-4, 2).requires_grad_()
        self.colour = torch.zeros(channels, voxels, voxels, voxels).requires_grad_()
        self.units = [s.windows.first_units.clone() for s in sequences]
        self.offset = torch.zeros(len(bank), 2)  # of the views' centroids from the object's origin, window -1..1
        self.posterior = [np.full((s.windows.count, *bank.shape), 1 / len(bank)) for s in sequences]
        self.cost = [np.inf] * len(sequences)
        self.evidence = np.inf
        self.restart()

    def restart(self) -> None:
        """Forget the optimiser's momentum."""
        groups = [{"params": [self.logit], "lr": 0.4}, {"params": [self.colour], "lr": 0.1}]
        self.optimiser = torch.optim.Adam(groups, betas=(0.8, 0.95))

    def start_from(self, other: Hypothesis) -> None:
        """Take over another hypothesis's volume, resampled to this one's voxels, and its scale of every frame."""
        both = torch.cat([other.logit.detach()[None], other.colour.detach()])[None]
        both = interpolate(both, size=(self.voxels,) * 3, mode="trilinear", align_corners=False)[0]
        self.logit, self.colour = both[0].clone().requires_grad_(), both[1:].clone().requires_grad_()
        self.units = [u.clone() for u in other.units]
        self.evidence = other.evidence
        self.restart()

    def copy(self) -> Hypothesis:
        """An independent copy that shares only what never changes."""
        other = copy.copy(self)
        other.logit = self.logit.detach().clone().requires_grad_()
        other.colour = self.colour.detach().clone().requires_grad_()
        other.units, other.posterior, other.cost = list(self.units), list(self.posterior), list(self.cost)
        other.random = torch.Generator()
        other.random.set_state(self.random.get_state())
        other.restart()
        return other

    def occupancy(self) -> torch.Tensor:
        """(N, N, N) in 0..1, faint haze removed."""
        occupancy = torch.sigmoid(self.logit.detach())
        return torch.where(occupancy < 0.05, torch.zeros_like(occupancy), occupancy)

    def mean_pictures(self, clips: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean true window of the frames in each view (P, 1 + C, S, S) about the origin, and their number (P,)."""
        size, views = self.bank.size, len(self.bank)
        channels = 1 + self.colour.shape[0]
        total, weight = torch.zeros(views, channels * size * size), torch.zeros(views)
        for k in clips:
            windows = self.sequences[k].windows
            windows.units = self.units[k]
            share = torch.as_tensor(self.posterior[k].reshape(windows.count, -1), dtype=torch.float32)
            share = share * windows.weight[:, None]
            total += share.T @ windows.true().reshape(windows.count, -1)
            weight += share.sum(0)
        mean = (total / weight.clamp(min=1e-6)[:, None]).reshape(views, channels, size, size)
        at = pixel_grid(size)[None] - self.offset[:, None, None]
        return grid_sample(mean, at, align_corners=False), weight

    def improve(self, steps: int, clips: list[int] | None = None, batch: int = 18) -> None:
        """Gradient steps of the volume towards the mean pictures."""
        mean, weight = self.mean_pictures(list(range(len(self.sequences))) if clips is None else clips)
        used = torch.nonzero(weight > 0.02 * weight.max())[:, 0]
        say = weight[used] / (weight[used] + weight[used].mean())  # a long look from one side does not outvote others
        colour_weight = 0.25 * self.weights.colour
        for _ in range(steps):
            some = torch.randperm(len(used), generator=self.random)[:batch]
            view = used[some]
            occupancy = torch.sigmoid(self.logit)
            picture = self.bank.render(occupancy, self.colour, self.bank.rotation[view])
            error = ((picture.opacity - mean[view, 0]) ** 2).sum((1, 2))
            error = error + colour_weight * ((picture.colour - mean[view, 1:]) ** 2).sum((1, 2, 3))
            scale = (24 / self.bank.size) ** 2
            loss = scale * (say[some] * error).sum() / say[some].sum()
            rough = sum((torch.diff(occupancy, dim=axis) ** 2).sum() for axis in range(3))
            loss = loss + self.weights.smooth * rough + self.weights.empty * occupancy.sum()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            with torch.no_grad():
                self.logit.clamp_(-6, 6)

    @torch.no_grad()
    def look(self, sharpness: float, clips: list[int] | None = None) -> None:
        """Posterior of every frame over the views, the scale of every frame, and the evidence.

        `sharpness` is the inverse temperature: log likelihood = -sharpness times :func:`windows.difference`.
        """
        occupancy = self.occupancy()
        picture = self.bank.render(occupancy, self.colour)
        views, view_size, centre = like_views(picture)
        found, first, evidence, frames = [], [], 0.0, 0
        clips = list(range(len(self.sequences))) if clips is None else clips
        for k in clips:
            s = self.sequences[k]
            cost, units = self._compare(k, views, view_size)
            if s.fixed is None:
                self.posterior[k], loss = self._track(k, cost, sharpness)
                evidence += loss
                frames += len(cost)
            else:
                self.posterior[k] = s.fixed
            share = torch.as_tensor(self.posterior[k].reshape(len(cost), -1), dtype=torch.float32)
            self.cost[k] = float((share * cost).sum(1).mean())
            found.append((share * units).sum(1))
            first.append(torch.log(s.windows.first_units))
        self.evidence = evidence / max(frames, 1)
        # the overall scale is free: hold its mean where the first guess had it
        gauge = float(torch.cat(first).mean() - torch.cat(found).mean())
        for k, units in zip(clips, found, strict=True):
            half = torch.log(self.sequences[k].windows.half)  # distance is smooth in time, the crop's side is not
            distance = smooth((units - half).numpy().astype(np.float64), 3.0)
            track = torch.as_tensor(distance, dtype=torch.float32) + half + gauge
            self.units[k] = torch.exp(0.5 * track + 0.5 * torch.log(self.units[k]))
        axis = pixel_axis(self.voxels) * EXTENT
        total = occupancy.sum().clamp(min=1e-3)
        middle = torch.stack([(occupancy.sum(other) * axis).sum() for other in ((0, 1), (0, 2), (1, 2))]) / total
        # keep the volume's own centroid at the origin
        self.offset = centre - torch.einsum("pij,j->pi", self.bank.rotation, middle)[:, :2] / EXTENT

    def _compare(self, k: int, views: torch.Tensor, view_size: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Cost of every view for every frame of a clip (T, P), and the log scale it would mean (T, P)."""
        s = self.sequences[k]
        if s.like is None:
            s.like = s.windows.like()
        cost = difference(s.like, views, self.weights.colour)
        units = torch.log(view_size[None] / s.windows.area.sqrt()[:, None].clamp(min=1e-3))
        cost = cost + self.weights.size * (units - torch.log(self.units[k])[:, None]).abs().clamp(max=0.5)
        return cost * s.windows.weight[:, None], units

    def _track(self, k: int, cost: torch.Tensor, sharpness: float) -> tuple[np.ndarray, float]:
        """Posterior (T, A, E) of a clip's frames and its evidence as a cost, summed over frames."""
        s, elevation = self.sequences[k], self.bank.elevation
        start = np.exp(-0.5 * ((elevation - self.weights.elevation_mean) / self.weights.elevation_sigma) ** 2)
        start = np.tile(start / start.sum() / len(self.bank.azimuth), (len(self.bank.azimuth), 1))
        likelihood = (-sharpness * cost).numpy().astype(np.float64).reshape(-1, *self.bank.shape)
        if s.bearing is not None:
            likelihood += self.weights.bearing * s.bearing[:, :, None]
        steps = azimuth_steps(self.bank.azimuth, s.drift, s.step_sigma)
        posterior, log_evidence = forward_backward(likelihood, start, steps, elevation_step(elevation, np.radians(5.0)))
        return posterior, -log_evidence / sharpness

    @torch.no_grad()
    def margin(self, k: int, sharpness: float, apart: float = np.radians(60.0)) -> float:
        """How much worse a frame of clip `k` is explained when it must be seen from elsewhere.

        The clip is tracked again with all views within `apart` of the found azimuths forbidden; the answer is the
        rise of its evidence, as a cost a frame. Near zero: the found poses are no better than quite different ones.
        """
        picture = self.bank.render(self.occupancy(), self.colour)
        views, view_size, _ = like_views(picture)
        cost, _ = self._compare(k, views, view_size)
        _, here = self._track(k, cost, sharpness)
        azimuth, _, _ = posterior_angles(self.posterior[k], self.bank.azimuth, self.bank.elevation)
        turn = np.abs(np.angle(np.exp(1j * (azimuth[:, None] - self.bank.azimuth[None]))))
        forbidden = torch.as_tensor(np.repeat(turn < apart, len(self.bank.elevation), axis=1))
        _, elsewhere = self._track(k, torch.where(forbidden, cost + 10.0, cost), sharpness)
        return (elsewhere - here) / len(cost)
