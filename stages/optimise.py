"""optimise: the paper's three phases, each a stage: fit everything, correct the articulation, refine the details.

``fit`` starts from root poses and masks, ``correct`` and ``refine`` from the phase before. Each folder holds
``model.safetensors``, ``model.json``, ``poses/<video>.json``, ``metrics.jsonl`` and ``previews/*.png``. A phase that
is stopped continues from its last checkpoint, bit for bit on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from pipeline import BadInput, Folder, InputFile, Resources, Run, Scene, stage
from stages import formats
from stages.checkpoint import Checkpoints
from stages.collect import Collection, collect
from stages.fitting import initialise
from stages.fitting.schedule import PhaseSettings
from stages.model.banmo import Architecture, Banmo
from stages.phases import run_phase
from stages.retargeting.growing import grown

_HULL_VOXEL = 0.032
_NO_MODEL = InputFile("")
_WARM_BETA = 0.015  # a shape that is known is not blurred again

_CHOICES = {
    "representation": ("grid", "mlp"),
    "start": ("hull", "sphere"),
    "blending": ("linear", "dual_quaternion"),
    "deformation": ("skinning", "se3", "translation"),
    "rate": ("linear", "one_cycle"),
}


@dataclass(frozen=True)
class FitSettings(PhaseSettings):
    """Phase 1: shape, colour, bones, motion, and root poses unless they were given."""

    representation: str = "grid"
    """grid (dense grids, quick on a CPU) or mlp (the paper's networks)."""
    voxel: float = 0.024
    """Spacing of the finest grid (object about 2 long)."""
    mlp_depth: int = 8
    """Layers of the trunk when representation = mlp."""
    mlp_width: int = 256
    """Channels of the trunk when representation = mlp."""
    bones: int = 25
    """Number of bones."""
    bones_share: float = 0.0
    """First bones lie where at least this share of the masks has something, so that swinging limbs get some; 0 = only
    in the first hull."""
    start: str = "hull"
    """hull (soft visual hull of the masks) or sphere (the paper's)."""
    warm: InputFile = _NO_MODEL
    """Folder of an earlier model of the same subject to go on from, with clips added; see `banmo extend`."""
    margin: float = 0.3
    """Room for limbs around the first hull (object about 2 long)."""
    renew_at: float = 0.3
    """Share of the phase at which bones and box are placed anew on the current shape, keeping the motion; 2 = never."""
    recur_at: tuple[float, ...] = (0.35, 0.5, 0.65, 0.8)
    """Shares of the phase at which stretches that may show one motion, a stride and the next, say, are fitted as one to
    the pictures of both, and go on from there where that explains them nearly as well; empty = never, as are 0
    and 1."""
    rethink_at: tuple[float, ...] = (0.45, 0.7)
    """Shares of the phase at which stretches of motion that are explained badly, or that another motion might explain,
    are read anew: poses of other frames are fitted there, too, and taken where they explain the pictures better;
    empty = never, as are 0 and 1."""
    motion_period_s: float = 0.25
    """Fastest motion that the pose codes can follow."""
    motion_spacing_s: float = 0.1
    """Spacing of local functions of time in the pose codes, beside the waves; 0 = waves alone, as in the paper."""
    pose_code: int = 96
    """Channels of the pose codes."""
    blending: str = "linear"
    """How bones are mixed: linear, or dual_quaternion (rigid at every point)."""
    deformation: str = "skinning"
    """skinning, or for comparison se3 or translation: a network moves every point; such a model has no rig."""
    flow_steps: tuple[int, ...] = (1, 4)
    """Frame steps of the optical flow that are used, both ways."""
    settle_root: bool = True
    """At the end, move to the root poses what all bones share, so that the trunk rests in object space: as far as it is
    known how far they may be off (a network's, given ones that jittered), else whole; given ones that are held stay."""
    lr_root: float = 1e-3
    """Step size of the root pose correction; given poses are held whatever it is (see poses.refine)."""
    decay_from: float = 0.6
    """Share of the phase at which step sizes begin to fall, linearly, to a tenth."""
    weight_cover: float = 0.0
    """Pixels of the object that nothing covers pull the surface point nearest to them, in pixels: limbs that lag (with
    0.02, say). Off: where it was measured the rest does as much."""
    cover_from: float = 0.3
    """Share of the phase from which they do; before, limbs may not be there yet."""
    weight_spill: float = 0.02
    """Places of the surface that stick out more than three pixels beside the object's mask are pulled back onto it, in
    pixels."""


@dataclass(frozen=True)
class CorrectSettings(PhaseSettings):
    """Phase 2: articulation alone; the shape is held. The paper's is led by `weight_cycle_2d`."""

    iterations: int = 80
    """Steps of gradient descent."""
    lr_sdf: float = 0.0
    """Step size of the signed distance."""
    lr_colour: float = 0.0
    """Step size of colour and embedding grids."""
    lr_bones: float = 0.0
    """Step size of the bones' centres, axes and sizes."""
    lr_motion: float = 1e-3
    """Step size of body pose codes and head."""
    lr_delta: float = 0.0
    """Step size of the learned skinning correction."""
    beta_start: float = 0.012
    """Width of the Laplace density at the start (object about 2 long)."""
    match_every: int = 1
    """Matching and the 2D cycle run every so many steps."""
    flow_steps: tuple[int, ...] = (1, 4)
    """Frame steps of the optical flow that are used, both ways."""


@dataclass(frozen=True)
class RefineSettings(PhaseSettings):
    """Phase 3: details of shape, colour and skinning; root poses are held."""

    iterations: int = 200
    """Steps of gradient descent."""
    beta_start: float = 0.012
    """Width of the Laplace density at the start (object about 2 long)."""
    beta_end: float = 0.006
    """Width of the Laplace density at the end: sharp."""
    lr_sdf: float = 1.5e-3
    """Step size of the signed distance."""
    lr_motion: float = 1e-3
    """Step size of body pose codes and head."""
    delta_from: float = 0.0
    """Share of the phase from which skinning is corrected by a network; above 1 = never."""
    decay_from: float = 0.0
    """Share of the phase at which step sizes begin to fall, linearly, to a tenth."""
    flow_steps: tuple[int, ...] = (1, 4)
    """Frame steps of the optical flow that are used, both ways."""


@stage(per=Scene, version=1, needs=Resources(cpus="all", gpus=1, distributed=True))
def fit(
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    settings: FitSettings,
    out: Path,
    run: Run,
) -> None:
    """A first whole model of the collection: canonical shape and colour, bones, and the motion of every clip."""
    _check_choices(settings, "fit")
    torch.set_num_threads(max(1, run.threads))
    collection = collect(frames, masks, flow, features, poses, settings.flow_steps, run)
    normal = initialise.normalise(collection.observations, collection.camera_from_object, collection.intrinsics)
    run.metric("object_scale", normal.scale)
    checkpoints = Checkpoints(run.checkpoint_dir)
    saved = checkpoints.latest()
    if saved is not None:
        model = Banmo.restore(saved.model_tensors(), saved.description)
    else:
        model = _first(collection, normal, settings, run)
    if settings.warm:
        settings = replace(settings, beta_start=min(settings.beta_start, _WARM_BETA), renew_at=2.0)
    run_phase(model, collection, settings, checkpoints, out, run, "fitting", settle_root=settings.settle_root)


@stage(per=Scene, version=1, needs=Resources(cpus="all", gpus=1, distributed=True))
def correct(
    fit: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    settings: CorrectSettings,
    out: Path,
    run: Run,
) -> None:
    """The same model with its articulation corrected while the shape is held."""
    _check_choices(settings, "correct")
    _continue(fit, collect(frames, masks, flow, features, poses, settings.flow_steps, run), settings, out, run)


@stage(per=Scene, version=1, needs=Resources(cpus="all", gpus=1, distributed=True))
def refine(
    correct: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    settings: RefineSettings,
    out: Path,
    run: Run,
) -> None:
    """The final model: sharper shape, corrected skinning."""
    _check_choices(settings, "refine")
    _continue(correct, collect(frames, masks, flow, features, poses, settings.flow_steps, run), settings, out, run)


def _first(collection: Collection, normal: initialise.Normalised, settings: FitSettings, run: Run) -> Banmo:
    if settings.warm:
        model = grown(
            Banmo.restore(*formats.read_model(Path(settings.warm))),
            collection.videos,
            normal.camera_from_canonical,
            collection.intrinsics,
            collection.observations,
            initialise.octaves(collection.videos, settings.motion_period_s),
            initialise.splines(collection.videos, settings.motion_spacing_s),
            settings.seed,
        )
        model.root_free.copy_(1 - collection.root_fixed)
        return model
    architecture = Architecture(
        representation=settings.representation,
        voxel=settings.voxel,
        mlp_depth=settings.mlp_depth,
        mlp_width=settings.mlp_width,
        pose_code=settings.pose_code,
        blending=settings.blending,
        deformation=settings.deformation,
        octaves=initialise.octaves(collection.videos, settings.motion_period_s),
        splines=initialise.splines(collection.videos, settings.motion_spacing_s),
    )
    free, room = 1 - collection.root_fixed, None
    if settings.start == "sphere":
        generator = torch.Generator().manual_seed(settings.seed)
        solid = torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator), dim=-1)
        solid = solid * 0.5 * torch.rand(4000, 1, generator=generator) ** (1 / 3)
    else:
        hull = initialise.rigid_hull(
            collection.observations, normal.camera_from_canonical, collection.intrinsics, _HULL_VOXEL
        )
        solid, room = hull.nodes[hull.solid], initialise.swept(hull, settings.bones_share)
        run.log.info("hull: vote level %.2f, %d voxels", hull.level, len(solid))
        run.metric("hull_level", hull.level)
        if len(solid) < 50:
            raise BadInput(
                "masks and root poses do not agree on any solid object",
                hint="look at latest/videos/*/masks and `banmo inspect poses`, or give masks and poses",
            )
    model = initialise.build(
        architecture,
        collection.videos,
        normal.camera_from_canonical,
        solid,
        _HULL_VOXEL,
        settings.bones,
        settings.seed,
        settings.margin,
        room,
    )
    model.root_free.copy_(free)
    return model


def _check_choices(settings: PhaseSettings, section: str) -> None:
    for key, known in _CHOICES.items():
        value = getattr(settings, key, known[0])
        if value not in known:
            raise BadInput(f"[{section}] {key} = {value!r} is none of {', '.join(known)}")


def _continue(before: Folder, collection: Collection, settings: PhaseSettings, out: Path, run: Run) -> None:
    torch.set_num_threads(max(1, run.threads))
    checkpoints = Checkpoints(run.checkpoint_dir)
    saved = checkpoints.latest()
    if saved is not None:
        model = Banmo.restore(saved.model_tensors(), saved.description)
    else:
        model = Banmo.restore(*formats.read_model(before.path))
    diagnose = isinstance(settings, RefineSettings)
    run_phase(model, collection, settings, checkpoints, out, run, "optimising", diagnose=diagnose)


def _check(out: Path, frames: dict[str, Folder]) -> None:
    tensors, description = formats.read_model(out)
    broken = [name for name, value in tensors.items() if value.is_floating_point() and not torch.isfinite(value).all()]
    if broken:
        raise formats.FormatError(f"model.safetensors: {broken[0]} is not finite")
    if [v["name"] for v in description["videos"]] != list(frames):
        raise formats.FormatError("model.json: the videos are not those of the collection")
    for name in frames:
        formats.read_poses(out / "poses" / f"{name}.json")


def _sheet(out: Path, picture: Path) -> None:
    picture.write_bytes((out / "previews" / "overlay.png").read_bytes())


for _phase in (fit, correct, refine):
    _phase.check(_check)
    _phase.sheet(_sheet)
