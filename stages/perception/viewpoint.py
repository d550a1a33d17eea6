"""From where is the object seen? A network's answer as a probability for every view, frame by frame.

A view is a rotation from object to camera axes, for a camera turned to look at the middle of the object's box (object:
y up, z front, x to its left; camera: x right, y down, z forward). The camera as it stood has the rotation
``ray_rotation @ view``, with the least rotation that takes the optical axis to the ray through the box's middle.

The bins are the product of azimuth, elevation and roll: ``R = Rz(roll) Rx(elevation) diag(1, -1, -1) Ry(azimuth)``.
Azimuth 0 faces the camera, +90 degrees looks to the picture's right, a positive elevation is seen from above, a
positive roll turns the picture clockwise. Bin ``(a * 12 + e) * 12 + r`` has azimuth a, elevation e, roll r.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from stages.perception.descriptors import crop_box, crop_resize

INPUT_PX = 96
AZIMUTH_DEG = np.arange(-175.0, 180.0, 10.0)
ELEVATION_DEG = np.arange(-25.0, 90.0, 10.0)
ROLL_DEG = np.arange(-41.25, 45.0, 7.5)
MARGIN = 1.2
"""Side of the crop over the longer side of the mask's box."""
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
_BATCH = 16


class PoseNetwork(Protocol):
    """A category's network, as training/export.py writes it."""

    def __call__(self, inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Of (N, 4, 96, 96) float32: `view` (N, 60), `dense` (N, 17, 48, 48), `category` (N, 3), all logits.

        Channels 0 to 2 are the crop, normalised by ImageNet's mean and deviation; channel 3 is the object's mask. Where
        the mask is known, the crop is zero off it; where not, channel 3 is zero everywhere.
        """
        ...


def view_rotations() -> np.ndarray:
    """(36 * 12 * 12, 3, 3) rotation of every bin."""
    azimuth, elevation, roll = (np.deg2rad(v) for v in (AZIMUTH_DEG, ELEVATION_DEG, ROLL_DEG))
    zero, one = np.zeros_like, np.ones_like

    def stack(rows: list[list[np.ndarray]]) -> np.ndarray:
        return np.stack([np.stack(row, -1) for row in rows], -2)

    a, e, r = azimuth, elevation, roll
    yaw = stack([[np.cos(a), zero(a), np.sin(a)], [zero(a), one(a), zero(a)], [-np.sin(a), zero(a), np.cos(a)]])
    pitch = stack([[one(e), zero(e), zero(e)], [zero(e), np.cos(e), -np.sin(e)], [zero(e), np.sin(e), np.cos(e)]])
    twist = stack([[np.cos(r), -np.sin(r), zero(r)], [np.sin(r), np.cos(r), zero(r)], [zero(r), zero(r), one(r)]])
    front = np.diag([1.0, -1.0, -1.0])
    return np.einsum("rij,ejk,kl,alm->aerim", twist, pitch, front, yaw).reshape(-1, 3, 3)


def viewpoint_log_probabilities(frames: np.ndarray, masks: np.ndarray, session: PoseNetwork) -> np.ndarray:
    """(T, 36 * 12 * 12) float32 log-probability of every bin of `view_rotations`, each row summing to 1.

    `frames` (T, H, W, 3) uint8 RGB, `masks` (T, H, W) uint8 foreground probability. A frame whose mask is empty gets
    the same value everywhere.
    """
    azimuth, elevation, roll = angle_log_probabilities(frames, masks, session)
    joint = azimuth[:, :, None, None] + elevation[:, None, :, None] + roll[:, None, None, :]
    return joint.reshape(len(frames), -1).astype(np.float32)


def angle_log_probabilities(
    frames: np.ndarray, masks: np.ndarray, session: PoseNetwork
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The three factors of `viewpoint_log_probabilities`: (T, 36) azimuth, (T, 12) elevation, (T, 12) roll.

    The crop and its mirror image are both asked, and what they say is multiplied.
    """
    out = [np.full((len(frames), n), -np.log(n)) for n in (len(AZIMUTH_DEG), len(ELEVATION_DEG), len(ROLL_DEG))]
    splits = np.cumsum([len(AZIMUTH_DEG), len(ELEVATION_DEG)])
    for rows, inputs in _prompted(frames, masks):
        plain = np.split(session(inputs)["view"].astype(np.float64), splits, axis=1)
        turned = np.split(session(np.ascontiguousarray(inputs[..., ::-1]))["view"].astype(np.float64), splits, axis=1)
        # In a mirror azimuth and roll change sign, and the bins are symmetric about zero.
        turned[0], turned[2] = turned[0][:, ::-1], turned[2][:, ::-1]
        for target, a, b in zip(out, plain, turned, strict=True):
            target[rows] = _log_softmax(0.5 * (_log_softmax(a) + _log_softmax(b)))
    return out[0], out[1], out[2]


def category_probabilities(frames: np.ndarray, masks: np.ndarray, session: PoseNetwork) -> np.ndarray:
    """(T, 3) probability that the masked object is a quadruped, a human, neither; NaN where the mask is empty."""
    out = np.full((len(frames), 3), np.nan)
    for rows, inputs in _prompted(frames, masks):
        out[rows] = np.exp(_log_softmax(session(inputs)["category"].astype(np.float64)))
    return out


def prompted_input(image: np.ndarray, mask: np.ndarray, crop: np.ndarray) -> np.ndarray:
    """(4, 96, 96) float32 input of one frame on a square crop (x0, y0, x1, y1 px), its mask (H, W) uint8 known."""
    on = (crop_resize(mask.astype(np.float32), crop, INPUT_PX) > 127.5).astype(np.float32)
    return np.concatenate([normalised(crop_resize(image, crop, INPUT_PX)) * on, on[None]])


def normalised(image: np.ndarray) -> np.ndarray:
    """(3, H, W) float32 of an (H, W, 3) uint8 RGB picture, by ImageNet's mean and deviation."""
    values: np.ndarray = (image.astype(np.float32) / 255.0 - IMAGENET_MEAN) / IMAGENET_STD
    return np.ascontiguousarray(values.transpose(2, 0, 1))


def mask_box(mask: np.ndarray) -> np.ndarray:
    """(4,) box x0, y0, x1, y1 of a mask (H, W) uint8, specks left out; zeros where it is empty."""
    inside = mask > 127
    count = int(inside.sum())
    if count < 16:
        return np.zeros(4)
    box = np.zeros(4)
    for axis in (0, 1):
        share = np.cumsum(inside.sum(axis=axis)) / count
        box[axis], box[axis + 2] = np.searchsorted(share, 0.0025), np.searchsorted(share, 0.9975) + 1
    return box


def _prompted(frames: np.ndarray, masks: np.ndarray) -> Iterator[tuple[list[int], np.ndarray]]:
    """Frame indices and inputs of the frames whose mask is not empty, a batch at a time."""
    rows: list[int] = []
    inputs: list[np.ndarray] = []
    for i, (image, mask) in enumerate(zip(frames, masks, strict=True)):
        box = mask_box(mask)
        if box.any():
            rows.append(i)
            inputs.append(prompted_input(image, mask, crop_box(box, mask.shape[1], mask.shape[0], MARGIN)))
        if rows and (len(rows) == _BATCH or i == len(frames) - 1):
            yield rows, np.stack(inputs)
            rows, inputs = [], []


def _log_softmax(values: np.ndarray) -> np.ndarray:
    shifted = values - values.max(axis=1, keepdims=True)
    return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True)))
