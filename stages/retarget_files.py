"""Files between the stages of retargeting."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.formats import FormatError
from stages.retargeting.fitting import Posture
from stages.retargeting.handing import Handed

POSTURE, HANDED = "posture.npz", "handed.npz"


@dataclass(frozen=True)
class Given:
    """Where a model's surface is to go: `surface` (P, 3) at rest, and what hands it on."""

    surface: torch.Tensor
    handed: Handed


def write_posture(root: Path, posture: Posture) -> None:
    """``posture.npz``: shape (B, 3, 3), orientations (N, B, 3, 3) camera from bone, shift (N, 3), misfit (N,)."""
    np.savez(
        root / POSTURE,
        shape=posture.shape.numpy(),
        orientations=posture.orientations.numpy(),
        shift=posture.shift.numpy(),
        misfit=posture.misfit.numpy(),
    )


def read_posture(root: Path, frames: int) -> Posture:
    """What :func:`write_posture` wrote, for so many frames."""
    found = _read(root / POSTURE, ("shape", "orientations", "shift", "misfit"))
    if len(found["orientations"]) != frames:
        raise FormatError(f"{POSTURE} has {len(found['orientations'])} frames, the clip {frames}")
    return Posture(found["shape"], found["orientations"], found["shift"], found["misfit"])


def write_handed(root: Path, surface: torch.Tensor, handed: Handed) -> None:
    """``handed.npz``: surface (P, 3) at rest, points (N, P, 3) object space, root (N, 4, 4) camera from object."""
    points = handed.points.numpy().astype(np.float16)
    np.savez(root / HANDED, surface=surface.numpy(), points=points, root=handed.root.numpy())


def read_handed(root: Path) -> Given:
    """What :func:`write_handed` wrote."""
    found = _read(root / HANDED, ("surface", "points", "root"))
    return Given(found["surface"], Handed(found["root"], found["points"]))


def _read(path: Path, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: torch.from_numpy(file[name]).float() for name in names}
    except (OSError, ValueError, KeyError) as error:
        raise FormatError(f"{path.name}: {error}") from error
