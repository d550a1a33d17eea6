"""Reading BVH motion files (Biovision hierarchy): a skeleton by offsets, then one row of channels a frame.

Lengths are in the file's own unit, angles in degrees; a rotation is the product of its channels in their order.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

_CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
_MOST_JOINTS = 2000
_MOST_VALUES = 50_000_000


class BvhError(ValueError):
    """A BVH file that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class Bvh:
    """A parsed file: joints with parents before children, motion as local transforms.

    offset: (B, 3) from the parent at rest. rotation: (T, B, 3, 3) parent_from_joint. shift: (T, B, 3), the
    position channels where a joint has them, its offset elsewhere. time_s: (T,) from zero.
    """

    names: list[str]
    parent: list[int]
    offset: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray
    time_s: np.ndarray

    def posed(self) -> np.ndarray:
        """world_from_joint (T, B, 4, 4)."""
        result = np.zeros((*self.rotation.shape[:2], 4, 4))
        result[..., :3, :3], result[..., :3, 3], result[..., 3, 3] = self.rotation, self.shift, 1.0
        for j, p in enumerate(self.parent):
            if p >= 0:
                result[:, j] = result[:, p] @ result[:, j]
        return result

    def rest(self) -> np.ndarray:
        """world_from_joint (B, 4, 4) with all channels zero: only offsets."""
        result = np.repeat(np.eye(4)[None], len(self.names), axis=0)
        result[:, :3, 3] = self.offset
        for j, p in enumerate(self.parent):
            if p >= 0:
                result[j, :3, 3] += result[p, :3, 3]
        return result


def read_bvh(text: str) -> Bvh:
    """Parse a whole file. Raises BvhError naming the line where it can."""
    head, found, tail = text.partition("MOTION")
    if not found or "HIERARCHY" not in head:
        raise BvhError("is not a BVH file: HIERARCHY and MOTION are missing")
    names, parent, offsets, channels = _hierarchy(head)
    width = sum(len(c) for c in channels)
    match = re.match(r"\s*Frames:\s*(\d{1,9})\s*Frame Time:\s*([0-9.eE+-]{1,30})\s", tail + "\n")
    if match is None:
        raise BvhError("has no Frames and Frame Time after MOTION")
    count = int(match[1])
    try:
        interval = float(match[2])
    except ValueError:
        interval = -1.0
    if not 0 < interval < 3600 or not 0 < count * max(1, width) <= _MOST_VALUES:
        raise BvhError(f"says {count} frames of {match[2]} s, which cannot be")
    words = tail[match.end() :].split()
    if len(words) < count * width:
        raise BvhError(f"has {len(words)} numbers for {count} frames of {width} channels")
    try:
        values = np.array(words[: count * width], np.float64).reshape(count, width)
    except ValueError as error:
        raise BvhError(f"has a frame that is not made of numbers ({error})") from error
    if not np.isfinite(values).all():
        raise BvhError("has a frame that is not finite")
    rotation = np.repeat(np.repeat(np.eye(3)[None, None], len(names), axis=1), count, axis=0)
    shift = np.repeat(np.array(offsets)[None], count, axis=0)
    column = 0
    for j, own in enumerate(channels):
        for channel in own:
            axis = "XYZ".index(channel[0])
            if channel.endswith("position"):
                shift[:, j, axis] = values[:, column]
            else:
                turn = Rotation.from_euler("XYZ"[axis], values[:, column : column + 1], degrees=True).as_matrix()
                rotation[:, j] = rotation[:, j] @ turn
            column += 1
    return Bvh(names, parent, np.array(offsets), rotation, shift, np.arange(count) * interval)


def _hierarchy(text: str) -> tuple[list[str], list[int], list[list[float]], list[list[str]]]:
    names: list[str] = []
    parent: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []  # -2 stands for an end site
    waiting: tuple[str, int] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0] == "HIERARCHY":
            continue
        if words[0] in ("ROOT", "JOINT"):
            name = " ".join(words[1:]) or f"joint_{len(names)}"
            waiting = (name, open_joints[-1] if open_joints else -1)
        elif words[0] == "End":
            waiting = ("", -2)
        elif words[0] == "{":
            if waiting is None or (waiting[1] == -2 and waiting[0]):
                raise BvhError(f"line {number}: a bracket opens that belongs to no joint")
            if waiting == ("", -2):
                open_joints.append(-2)
            else:
                open_joints.append(len(names))
                names.append(waiting[0])
                parent.append(waiting[1])
                offsets.append([0.0, 0.0, 0.0])
                channels.append([])
            waiting = None
            if len(names) > _MOST_JOINTS:
                raise BvhError(f"has more than {_MOST_JOINTS} joints")
        elif words[0] == "}":
            if not open_joints:
                raise BvhError(f"line {number}: a bracket closes that never opened")
            open_joints.pop()
        elif words[0] in ("OFFSET", "CHANNELS"):
            if not open_joints:
                raise BvhError(f"line {number}: {words[0]} outside of a joint")
            joint = open_joints[-1]
            if joint == -2:
                continue
            if words[0] == "OFFSET":
                offsets[joint] = _offset(words[1:], number)
            else:
                channels[joint] = _channels(words[1:], number)
        else:
            raise BvhError(f"line {number}: {words[0][:40]!r} is not understood")
    if open_joints or not names:
        raise BvhError("has no joints" if not names else "ends inside of a joint")
    return names, parent, offsets, channels


def _offset(words: list[str], number: int) -> list[float]:
    try:
        values = [float(w) for w in words]
    except ValueError:
        values = []
    if len(values) != 3 or not np.isfinite(values).all():
        raise BvhError(f"line {number}: an OFFSET is three numbers")
    return values


def _channels(words: list[str], number: int) -> list[str]:
    if not words or words[0] != str(len(words) - 1) or any(w not in _CHANNELS for w in words[1:]):
        raise BvhError(f"line {number}: CHANNELS are a count and so many of {', '.join(_CHANNELS)}")
    return words[1:]
