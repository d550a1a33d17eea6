"""Names of joints by the place they have in a body, where it is known what kind of body it is.

Canonical space has y up, z front and x to the object's left; names are as good as those axes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from stages.meshing.skeleton import Skeleton

CATEGORIES = ("quadruped", "human")
_ON_THE_GROUND = 0.08  # of the height
_BOTH_SIDES = 0.02  # of the length
_SAME = {"dog": "quadruped", "cat": "quadruped", "horse": "quadruped", "animal": "quadruped", "person": "human"}


def kind_of_body(category: str) -> str | None:
    """The kind of body that a category's name stands for; None where no names by place are known for it."""
    word = category.strip().lower()
    word = _SAME.get(word, word)
    return word if word in CATEGORIES else None


def name_by_place(skeleton: Skeleton, category: str, vertices: np.ndarray, weights: np.ndarray) -> Skeleton:
    """The same joints, called ``spine_1``, ``leg_front_left_2`` ...; unchanged where the category tells nothing.

    A limb is a chain of joints from the last fork of the tree out to a tip; it is named by where the surface that its
    tip moves lies in the object's box, and its joints are counted from the body outward. What lies in no limb is the
    spine, counted from the back to the front (quadruped) or from below upward (human). A limb that moves both sides
    alike (two legs on one bone) has no side in its name.

    Args:
        vertices: (V, 3) at rest. weights: (V, B) skinning weights, in the model's bone order.
    """
    kind = kind_of_body(category)
    if kind is None or len(skeleton) < 3:
        return skeleton
    parts = _parts(skeleton, vertices, weights)
    chains = sorted(_limbs(skeleton.parent), key=lambda chain: (-len(chain), chain[0]))
    limb_of: dict[int, str] = {}
    for chain, label in zip(chains, _labels(kind, chains, parts), strict=True):
        if label is not None:
            limb_of |= dict.fromkeys(chain, label)
    trunk = [j for j in range(len(skeleton)) if j not in limb_of]
    along = 2 if kind == "quadruped" else 1
    order = sorted(trunk, key=lambda j: (parts[j].middle[along], j))
    labels = {j: f"spine_{n}" for n, j in enumerate(order, 1)}
    count: Counter[str] = Counter()
    for chain in chains:
        for joint in chain:
            if joint in limb_of:
                count[limb_of[joint]] += 1
                labels[joint] = f"{limb_of[joint]}_{count[limb_of[joint]]}"
    return replace(skeleton, names=[labels[j] for j in range(len(skeleton))])


@dataclass(frozen=True)
class _Part:
    """The surface that a joint moves most: its middle and its lowest height, in the object's box.

    y and z run over 0..1; x runs from the body's middle, over the box's largest edge.
    """

    middle: np.ndarray
    lowest: float


def _parts(skeleton: Skeleton, vertices: np.ndarray, weights: np.ndarray) -> list[_Part]:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent, axis = np.maximum(high - low, 1e-9), float(np.median(vertices[:, 0]))

    def relative(points: np.ndarray) -> np.ndarray:
        place = (points - low) / extent
        place[..., 0] = (points[..., 0] - axis) / extent.max()
        return np.asarray(place)

    strongest = weights.argmax(axis=1)
    parts = []
    for joint, bone in enumerate(skeleton.bone.tolist()):
        own = vertices[strongest == bone]
        if not len(own):
            own = skeleton.centre[joint : joint + 1]
        place = relative(own)
        parts.append(_Part(place.mean(axis=0), float(np.quantile(place[:, 1], 0.02))))
    return parts


def _limbs(parent: np.ndarray) -> list[list[int]]:
    """Chains of joints without a fork that end in a tip, from the body outward; the root is in none."""
    children = np.bincount(parent[parent >= 0], minlength=len(parent))
    chains = []
    for tip in np.flatnonzero((children == 0) & (parent >= 0)).tolist():
        chain = [tip]
        while parent[chain[-1]] > 0 and children[parent[chain[-1]]] == 1:
            chain.append(int(parent[chain[-1]]))
        chains.append(chain[::-1])
    return chains


def _labels(kind: str, chains: list[list[int]], parts: list[_Part]) -> list[str | None]:
    tips = [parts[chain[-1]] for chain in chains]
    named: list[str | None] = []
    if kind == "quadruped":
        feet = [tip.middle[2] for tip in tips if tip.lowest < _ON_THE_GROUND]
        middle = (min(feet) + max(feet)) / 2 if feet else 0.5
        for tip in tips:
            if tip.lowest < _ON_THE_GROUND:
                named.append(f"leg_{'front' if tip.middle[2] > middle else 'back'}{_side(tip)}")
            else:
                named.append("head" if tip.middle[2] > 0.75 else "tail" if tip.middle[2] < 0.25 else None)
        return named
    for chain, tip in zip(chains, tips, strict=True):
        if tip.lowest < _ON_THE_GROUND or (tip.middle[1] < 0.3 and parts[chain[0]].middle[1] < 0.6):
            named.append(f"leg{_side(tip)}")
        elif tip.middle[1] > 0.85:
            named.append("head")
        else:
            named.append(f"arm{_side(tip)}" if _side(tip) else None)
    return named


def _side(tip: _Part) -> str:
    across = float(tip.middle[0])
    return "" if abs(across) < _BOTH_SIDES else "_left" if across > 0 else "_right"
