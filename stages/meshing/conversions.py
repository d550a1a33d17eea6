"""Colours and transforms as scene formats want them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def linear_from_srgb(colour: np.ndarray) -> np.ndarray:
    """Linear light in 0..1 of sRGB in 0..1."""
    c = np.clip(colour, 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def translation_rotation(transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translations (N, 3) and unit quaternions (N, 4), x y z w, of rigid transforms (N, 4, 4), both float32.

    Successive quaternions lie in the same half space, so that interpolation between them takes the short way.
    """
    quaternion = np.atleast_2d(Rotation.from_matrix(transforms[:, :3, :3]).as_quat())
    quaternion[0] *= 1.0 if quaternion[0, 3] >= 0 else -1.0
    agree = np.sign((quaternion[1:] * quaternion[:-1]).sum(axis=1))
    agree[agree == 0] = 1.0
    quaternion[1:] *= np.cumprod(agree)[:, None]
    return transforms[:, :3, 3].astype(np.float32), quaternion.astype(np.float32)
