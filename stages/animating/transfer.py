"""Carrying a motion from one skeleton to another: turns against the rest pose, in the common upright frame.

A joint of ours that has a partner takes over its partner's turn away from rest, seen from the world; so the two
skeletons need not share axes, lengths or counts of joints. A joint without a partner stays rigid with its parent.
Partners are found by name, whatever the spelling, or named by the user.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from stages.animating.bvh import Bvh
from stages.animating.glb import Animation, Glb, GlbError
from stages.animating.playing import ROOT_MOTION


@dataclass(frozen=True)
class Motion:
    """A skeleton in motion, parents before children.

    rest: (B, 4, 4) and posed: (T, B, 4, 4), world_from_joint, y up. time_s: (T,) seconds from zero, increasing.
    root: (T, 4, 4), the motion of the whole where the file keeps it apart, in a joint or node ``root_motion``.
    """

    names: list[str]
    parent: list[int]
    rest: np.ndarray
    posed: np.ndarray
    time_s: np.ndarray
    root: np.ndarray | None = None

    @property
    def height(self) -> float:
        """Size of the skeleton at rest: the diagonal of its box."""
        points = self.rest[:, :3, 3]
        return float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))


class NoPartners(ValueError):
    """The two skeletons have no joint in common; the message is one sentence."""


def motion_of_bvh(bvh: Bvh) -> Motion:
    """A BVH file's motion. A topmost joint ``root_motion`` carries the whole and is taken off."""
    rest, posed = bvh.rest(), bvh.posed()
    if bvh.names[0] != ROOT_MOTION or len(bvh.names) == 1:
        return Motion(bvh.names, bvh.parent, rest, posed, bvh.time_s)
    root = posed[:, 0] @ np.linalg.inv(rest[0])
    parent = [max(-1, p - 1) for p in bvh.parent[1:]]
    own = np.linalg.inv(posed[:, 0])[:, None] @ posed[:, 1:]
    return Motion(bvh.names[1:], parent, np.linalg.inv(rest[0]) @ rest[1:], own, bvh.time_s, root)


def motion_of_glb(glb: Glb, animation: Animation) -> Motion:
    """The motion of a GLB's skinned joints, in the frame of the node above the topmost joint.

    So root motion that a file keeps in a node above its joints is left out; ours is kept as `root`. In our own files
    the pose at rest is the one that the skin is bound in, whatever pose the file shows.
    """
    joints = glb.joints()
    order = [n for n in glb.order if n in set(joints)]
    place = {node: i for i, node in enumerate(order)}
    parent = [_joint_above(glb, node, place) for node in order]
    times = animation.time_s
    moving = _chain(glb, glb.locals_at(animation, times), order, place)
    ours = glb.document.get("asset", {}).get("generator") == "banmo-pipeline"
    still = skeleton_of(glb)[2] if ours else _chain(glb, glb.locals_at(None, np.zeros(1)), order, place)[0]
    node = glb.names.index(ROOT_MOTION) if ROOT_MOTION in glb.names else -1
    moved = any(track.node == node for track in animation.tracks)
    root = glb.locals_at(animation, times)[:, node] if moved else None
    return Motion([glb.names[n] for n in order], parent, still, moving, times - times[0], root)


def _joint_above(glb: Glb, node: int, place: dict[int, int]) -> int:
    above = int(glb.parent[node])
    while above >= 0 and above not in place:
        above = int(glb.parent[above])
    return place.get(above, -1)


def _chain(glb: Glb, local: np.ndarray, order: list[int], place: dict[int, int]) -> np.ndarray:
    result = np.zeros((len(local), len(order), 4, 4))
    for i, node in enumerate(order):
        matrix, above = local[:, node], int(glb.parent[node])
        while above >= 0 and above not in place:
            if _joint_above(glb, node, place) < 0:
                break  # above the topmost joint: root motion
            matrix, above = local[:, above] @ matrix, int(glb.parent[above])
        result[:, i] = result[:, place[above]] @ matrix if above in place else matrix
    return result


def plain_name(name: str) -> str:
    """A joint's name without prefix, case, separators and leading zeros: ``mixamorig:Left_Leg.01`` -> ``leftleg1``."""
    last = re.split(r"[:|]", name)[-1].lower()
    return re.sub(r"0+(?=\d)", "", re.sub(r"[^a-z0-9]", "", last))


def partners(ours: list[str], theirs: list[str], named: dict[str, str] | None = None) -> dict[int, int]:
    """Our joint -> their joint, by `named` (our name -> their name) and else by equal plain names.

    Raises NoPartners when there is none, or a name in `named` is not there.
    """
    found: dict[int, int] = {}
    by_plain = {plain_name(n): i for i, n in reversed(list(enumerate(theirs)))}
    for i, name in enumerate(ours):
        if (named is None or name not in named) and plain_name(name) in by_plain:
            found[i] = by_plain[plain_name(name)]
    for name, other in (named or {}).items():
        if name not in ours:
            raise NoPartners(f"the model has no joint {name!r}; it has {', '.join(ours[:40])}")
        if other not in theirs:
            raise NoPartners(f"the motion has no joint {other!r}; it has {', '.join(theirs[:40])}")
        found[ours.index(name)] = theirs.index(other)
    if not found:
        some = f"{', '.join(theirs[:8])} against {', '.join(ours[:8])}"
        raise NoPartners(f"no joint of the motion is named like one of the model: {some}")
    return found


def transfer(source: Motion, rest: np.ndarray, parent: list[int], pairs: dict[int, int]) -> np.ndarray:
    """Our skeleton moved as `source` is: object_from_joint (T, B, 4, 4).

    Args:
        rest: (B, 4, 4) object_from_joint of our skeleton, parents before children.
        parent: (B,), -1 for a root.
        pairs: our joint -> joint of `source`.
    """
    ours = rest[:, :3, 3]
    size = float(np.linalg.norm(ours.max(axis=0) - ours.min(axis=0)))
    scale = size / source.height if source.height > 1e-9 else 1.0
    turned = source.posed[..., :3, :3] @ np.swapaxes(source.rest[:, :3, :3], 1, 2)  # world turn away from rest
    result = np.zeros((len(source.time_s), len(rest), 4, 4))
    result[..., 3, 3] = 1.0
    delta = np.zeros((len(source.time_s), len(rest), 3, 3))
    for j, above in enumerate(parent):
        partner = pairs.get(j)
        inherited = delta[:, above] if above >= 0 else np.broadcast_to(np.eye(3), delta[:, j].shape)
        delta[:, j] = inherited if partner is None else turned[:, partner]
        result[:, j, :3, :3] = delta[:, j] @ rest[j, :3, :3]
        if above >= 0:
            offset = inherited @ (rest[j, :3, 3] - rest[above, :3, 3])
            result[:, j, :3, 3] = result[:, above, :3, 3] + offset
        else:
            result[:, j, :3, 3] = rest[j, :3, 3]
        if partner is not None:
            result[:, j, :3, 3] += scale * _own_shift(source, partner)
    return result


def _own_shift(source: Motion, joint: int) -> np.ndarray:
    """How far (T, 3) a joint stands from where its parent's turn alone would put it, world frame."""
    above = source.parent[joint]
    place = source.posed[:, joint, :3, 3]
    if above < 0:
        return place - source.rest[joint, :3, 3]
    turn = source.posed[:, above, :3, :3] @ source.rest[above, :3, :3].T
    held = source.posed[:, above, :3, 3] + turn @ (source.rest[joint, :3, 3] - source.rest[above, :3, 3])
    return place - held


def local_of(posed: np.ndarray, parent: list[int]) -> np.ndarray:
    """parent_from_joint (T, B, 4, 4) of object_from_joint (T, B, 4, 4)."""
    result = posed.copy()
    for j, above in enumerate(parent):
        if above >= 0:
            result[:, j] = np.linalg.inv(posed[:, above]) @ posed[:, j]
    return result


def skeleton_of(glb: Glb) -> tuple[list[int], list[int], np.ndarray]:
    """Joint nodes (parents first), parent (B,) and rest (B, 4, 4) object_from_joint of a GLB's skin."""
    joints = glb.joints()
    order = [n for n in glb.order if n in set(joints)]
    place = {node: i for i, node in enumerate(order)}
    parent = [_joint_above(glb, node, place) for node in order]
    inverse = dict(zip(joints, glb.inverse_bind(), strict=True))
    try:
        rest = np.stack([np.linalg.inv(inverse[n]) for n in order])
    except np.linalg.LinAlgError as error:
        raise GlbError("has a bind matrix that cannot be inverted") from error
    return order, parent, rest
