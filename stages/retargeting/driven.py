"""A known model, driven by a new clip: what is shared is frozen, only the clip's own codes move (paper, section 4.4).

The driven model holds one video, the new one. Shape, colour, embedding, skinning, bones and the head that turns codes
into bone motions are copied from the known model and never move; the clip's body, root and environment codes are
found. The head of the root correction belongs to one video as well once there is only one, so it moves with its code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.fitting.observations import Observations
from stages.fitting.schedule import PhaseSettings
from stages.fitting.trainer import Trainer
from stages.model.banmo import Banmo, VideoFacts
from stages.model.motion import FourierCode

_OF_ONE_VIDEO = (
    "base_poses",
    "gauge",
    "root_free",
    "log_focal",
    "body.code.coefficients",
    "root.code.coefficients",
    "environment.coefficients",
)


def known_codes(model: Banmo) -> Tensor:
    """Body pose codes (T, C) of all kept frames of a model."""
    with torch.no_grad():
        return model.body.code(model.video_idx, model.time)


def driven_model(
    model: Banmo, video: VideoFacts, base_poses: Tensor, octaves: int, seed: int, splines: int = 0
) -> Banmo:
    """The same model with one other video, at `base_poses` (T, 4, 4), camera_from_object.

    Args:
        model: the known one; it is not touched.
        video: name, kept frame times and camera of the driving clip.
        octaves, splines: functions of time of its body pose code (see :mod:`stages.model.motion`).
        seed: of the codes' small random start around the mean over the known frames.
    """
    architecture = replace(model.architecture, octaves=octaves, splines=splines)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        driven = Banmo(architecture, [video], base_poses, model.bounds, model.bones, generator)
    shared = model.state_dict()
    fresh = driven.state_dict()
    driven.surface = torch.zeros_like(model.surface)
    taken = {
        name: fresh[name] if name in _OF_ONE_VIDEO or name.startswith("root.") else value.clone()
        for name, value in shared.items()
    }
    driven.load_state_dict(taken)
    driven.use_delta = model.use_delta
    with torch.no_grad():
        start_codes(driven, known_codes(model).mean(0)[None].expand(len(video.time_s), -1))
        light = model.environment(model.video_idx, model.time).mean(0)
        driven.environment.coefficients.zero_()
        driven.environment.coefficients[0, 0] = light
    return driven


def start_codes(driven: Banmo, codes: Tensor, ridge: float = 0.02) -> None:
    """Set the body code of the one video so that it follows `codes` (T, C) at its kept frames."""
    follow(driven.body.code, 0, driven.time, codes, ridge)


@torch.no_grad()
def follow(code: FourierCode, video: int, time: Tensor, wanted: Tensor, ridge: float = 0.02) -> None:
    """Set a video's code so that it follows `wanted` (T, C) at normalised times (T,).

    Ridge regression onto the code's functions of time; high octaves are held back more, so that the start is smooth.
    """
    basis = code.basis(time).double()
    octave = torch.arange(code.octaves, dtype=torch.float64)
    first = torch.tensor([1e-6, 1e-2], dtype=torch.float64)
    price = torch.cat([first, 4.0**octave, 4.0**octave, torch.full((code.splines,), 4.0**code.octaves).double()])
    gram = basis.T @ basis + ridge * torch.diag(price)
    code.coefficients[video] = torch.linalg.solve(gram, basis.T @ wanted.double()).float()


@dataclass(frozen=True)
class ClipSettings(PhaseSettings):
    """A phase in which nothing shared moves."""

    lr_environment: float = 1e-2
    """Step size of the clip's light code; zero holds it."""


class ClipTrainer(Trainer):
    """The optimiser's loop with everything frozen but the codes of the driven clip."""

    def __init__(self, model: Banmo, observations: Observations, settings: ClipSettings) -> None:
        self._light = settings.lr_environment
        super().__init__(model, observations, settings)

    def groups(self) -> dict[str, tuple[list[torch.nn.Parameter], float]]:
        """Codes of body, root (with its head) and environment."""
        m, s = self.model, self.settings
        for parameter in m.parameters():
            parameter.requires_grad_(False)
        return {
            "motion": ([m.body.code.coefficients], s.lr_motion),
            "root": (list(m.root.parameters()), s.lr_root),
            "environment": (list(m.environment.parameters()), self._light),
        }
