"""Settings of one optimisation phase, and how rates, weights and sharpness move along it."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class PhaseSettings:
    """What one phase does; every field is a setting of its stage. Weights of zero switch a term off."""

    iterations: int = 600
    """Steps of gradient descent. The whole schedule is laid out over them: a short run is a finished run."""
    minutes: float = 0.0
    """Time for the phase: as many steps as this machine makes in it, schedule and all; 0 = as many as `iterations`."""
    seed: int = 0
    """Seed of every random draw."""

    frames_per_step: int = 24
    """Frames in a batch."""
    pixels_per_frame: int = 112
    """Rays a frame in a batch."""
    edge_share: float = 0.0
    """Share of them drawn within a few pixels of the mask's edge."""
    active_share: float = 0.0
    """Share of them drawn where a small network expects large errors: the worst of four times as many candidates."""
    active_from: float = 0.3
    """Share of the phase from which it is asked; it learns from the start."""
    probe_samples: int = 40
    """Samples a ray that look for the surface, without gradient."""
    fine_samples: int = 16
    """Samples a ray near the surface, with gradient."""

    beta_start: float = 0.04
    """Width of the Laplace density at the start (object about 2 long): soft."""
    beta_end: float = 0.008
    """Width of the Laplace density at the end: sharp."""
    beta_until: float = 0.6
    """Share of the phase at which the density has reached its final sharpness."""

    lr_sdf: float = 3e-3
    """Step size of the signed distance."""
    lr_colour: float = 2e-2
    """Step size of colour and embedding grids."""
    lr_motion: float = 2e-3
    """Step size of body pose codes and head."""
    lr_bones: float = 5e-4
    """Step size of the bones' centres, axes and sizes."""
    lr_root: float = 0.0
    """Step size of the root pose correction; zero holds the given poses."""
    lr_focal: float = 0.0
    """Step size of each video's log focal length; zero holds it."""
    lr_delta: float = 1e-3
    """Step size of the learned skinning correction."""
    warmup_steps: int = 50
    """Steps over which the step sizes rise from zero."""
    decay_from: float = 0.3
    """Share of the phase at which step sizes begin to fall, linearly, to a tenth."""
    rate: str = "linear"
    """How step sizes move: linear (see decay_from), or one_cycle (up for 30 % of the phase, then down; the paper's)."""
    sdf_frozen_until: float = 0.0
    """Share of the phase during which the shape is held while the motion catches up."""

    weight_rgb: float = 1.0
    """Colour (L_rgb)."""
    weight_silhouette: float = 1.0
    """Silhouette (L_sil)."""
    weight_flow: float = 0.02
    """Optical flow in pixels (L_OF)."""
    flow_only_every: int = 0
    """Early on, every so many steps flow alone speaks for the pictures, so that motion leads; 0 = never."""
    flow_only_until: float = 0.3
    """Share of the phase that counts as early."""
    weight_cover: float = 0.0
    """Pixels of the object that nothing covers pull the surface point nearest to them, in pixels: limbs that lag."""
    cover_from: float = 0.2
    """Share of the phase from which they do; before, limbs may not be there yet."""
    weight_spill: float = 0.0
    """Places of the surface that stick out more than three pixels beside the object's mask are pulled back onto it, in
    pixels."""
    spill_from: float = 0.2
    """Share of the phase from which they are."""
    weight_feature: float = 0.05
    """Rendered embedding against the pixel's features: what the canonical embedding learns from."""
    feature_pull: float = 0.0
    """Share of that term's pull that shape, motion and root poses get, too (registration by embeddings); at 0 the
    embedding alone learns."""
    weight_match: float = 0.0
    """Matched point against warped surface point (L_match)."""
    weight_cycle_2d: float = 0.0
    """Matched point projected back onto its pixel (L_2D-cyc), in image sizes."""
    weight_cycle_3d: float = 1.0
    """Backward then forward warp returns (L_3D-cyc)."""
    weight_eikonal: float = 0.1
    """Unit gradient of the signed distance near the surface."""
    weight_smooth: float = 0.2
    """Second differences of the signed distance near the surface."""
    weight_bone_location: float = 0.1
    """Bones lie where the surface is (Sinkhorn divergence)."""
    weight_joints: float = 0.1
    """Neighbouring bones agree about the place where they meet."""
    weight_rest: float = 0.03
    """Size of the bones' own turns: of two motions that explain the pictures, the smaller one."""
    weight_motion: float = 0.02
    """Acceleration of bones between frames."""
    weight_root: float = 0.5
    """Acceleration of root poses between frames."""
    weight_given: float = 0.01
    """How firmly the places of given root poses that may move stay near what was given; their turns hardly do."""
    match_pixels: int = 192
    """Pixels a step that take part in matching and the 2D cycle."""
    match_every: int = 2
    """Matching and the 2D cycle run every so many steps."""

    delta_from: float = 2.0
    """Share of the phase from which skinning is corrected by a network; above 1 = never."""
    renew_at: float = 2.0
    """Share of the phase at which bones and box are placed anew on the current shape, keeping the motion; 2 = never."""
    mend: bool = True
    """Whenever bounds are updated, and at the end, tie parts of the shape that came loose to the body, and remove what
    the masks do not vouch for: specks, and sheets that float where no ray is drawn."""
    mend_from: float = 0.3
    """Share of the phase from which that is done; before, limbs may still grow together."""
    recur_at: tuple[float, ...] = ()
    """Shares of the phase at which stretches that may show one motion, a stride and the next, say, are fitted as one to
    the pictures of both, and go on from there where that explains them nearly as well; empty = never, as are 0
    and 1."""
    rethink_at: tuple[float, ...] = ()
    """Shares of the phase at which stretches of motion that are explained badly, or that another motion might explain,
    are read anew: poses of other frames are fitted there, too, and taken where they explain the pictures better;
    empty = never, as are 0 and 1."""
    rethink_share: float = 0.08
    """Work that goes into one such second thought, or shared motion, as a share of the phase's steps."""
    reject_at: float = 2.0
    """Share of the phase at which frames that fit far worse than their clip are trusted less and, where root poses are
    free, placed between their neighbours; above 1 = never."""
    update_bounds_every: int = 200
    """Steps between updates of the surface, each frame's near and far planes, and the matching grid's bounds."""


def beta_at(settings: PhaseSettings, progress: float) -> float:
    """Width of the density at `progress` in 0..1: log-linear from start to end."""
    share = min(1.0, progress / max(settings.beta_until, 1e-6))
    return math.exp((1 - share) * math.log(settings.beta_start) + share * math.log(settings.beta_end))


def rate_at(settings: PhaseSettings, step: int) -> float:
    """Factor on every step size at `step`.

    linear: rises over the warm-up, constant, then linear down to a tenth. one_cycle: along cosines from 1/25 up at 30 %
    of the phase and down to 1/1000 at its end (Smith and Topin 2018).
    """
    progress = step / max(1, settings.iterations)
    if settings.rate == "one_cycle":
        if progress < 0.3:
            return 0.04 + 0.96 * (1 - math.cos(math.pi * progress / 0.3)) / 2
        return 0.001 + 0.999 * (1 + math.cos(math.pi * min(1.0, (progress - 0.3) / 0.7))) / 2
    warm = min(1.0, (step + 1) / max(1, min(settings.warmup_steps, settings.iterations // 5 + 1)))
    fall = max(0.0, (progress - settings.decay_from) / max(1e-6, 1 - settings.decay_from))
    return warm * (1 - 0.9 * min(1.0, fall))


def flow_speaks_alone(settings: PhaseSettings, step: int) -> bool:
    """Whether `step` is one of the early ones at which flow alone speaks for the pictures."""
    every = settings.flow_only_every
    return every > 0 and step % every == every - 1 and step < settings.flow_only_until * settings.iterations
