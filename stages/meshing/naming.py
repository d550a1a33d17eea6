"""Names of joints by the place they have in a body, where it is known what kind of body it is.

Canonical space has y up, z front and x to the object's left; names are as good as those axes.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from stages.meshing.skeleton import Skeleton

CATEGORIES = ("quadruped", "human")
_SAME = {"dog": "quadruped", "cat": "quadruped", "horse": "quadruped", "animal": "quadruped", "person": "human"}


def kind_of_body(category: str) -> str | None:
    """The kind of body that a category's name stands for; None where no names by place are known for it."""
    word = category.strip().lower()
    word = _SAME.get(word, word)
    return word if word in CATEGORIES else None


def name_by_place(skeleton: Skeleton, category: str) -> Skeleton:
    """The same joints, called ``spine_1``, ``leg_front_left_2`` ...; unchanged where the category tells nothing.

    A limb is a chain of joints from the last fork of the tree out to a tip; it is named by where its tip lies in the
    box of all bones, and its joints are counted from the body outward. What lies in no limb is the spine, counted from
    the back to the front (quadruped) or from below upward (human).
    """
    kind = kind_of_body(category)
    if kind is None or len(skeleton) < 3:
        return skeleton
    place = _relative(skeleton.centre)
    limb_of: dict[int, str] = {}
    chains = sorted(_limbs(skeleton.parent), key=lambda chain: (-len(chain), chain[0]))
    tips = np.array([place[chain[-1]] for chain in chains])
    for chain, label in zip(chains, _labels(kind, chains, tips, place), strict=True):
        if label is not None:
            limb_of |= dict.fromkeys(chain, label)
    trunk = [j for j in range(len(skeleton)) if j not in limb_of]
    along = 2 if kind == "quadruped" else 1
    order = sorted(trunk, key=lambda j: (place[j, along], j))
    labels = {j: f"spine_{n}" for n, j in enumerate(order, 1)}
    count: Counter[str] = Counter()
    for chain in chains:
        for joint in chain:
            if joint in limb_of:
                count[limb_of[joint]] += 1
                labels[joint] = f"{limb_of[joint]}_{count[limb_of[joint]]}"
    return replace(skeleton, names=[labels[j] for j in range(len(skeleton))])


def _relative(centre: np.ndarray) -> np.ndarray:
    """Places (B, 3): y and z over the box of the bones, 0 to 1; x from the middle over the largest edge."""
    low, high = centre.min(axis=0), centre.max(axis=0)
    place = (centre - low) / np.maximum(high - low, 1e-9)
    middle = np.median(centre[:, 0])
    place[:, 0] = (centre[:, 0] - middle) / max(float((high - low).max()), 1e-9)
    return np.asarray(place)


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


def _labels(kind: str, chains: list[list[int]], tips: np.ndarray, place: np.ndarray) -> list[str | None]:
    if not chains:
        return []
    named: list[str | None] = []
    low = tips[:, 1] < 0.35
    if kind == "quadruped":
        free = np.flatnonzero(~low)
        head = int(free[tips[free, 2].argmax()]) if len(free) else -1
        feet = tips[low, 2]
        middle = float((feet.min() + feet.max()) / 2) if len(feet) else 0.5
        for k, tip in enumerate(tips):
            if low[k]:
                named.append(f"leg_{'front' if tip[2] > middle else 'back'}_{_side(tip)}")
            elif k == head or tip[2] > 0.75:
                named.append("head")
            elif tip[2] < 0.25:
                named.append("tail")
            else:
                named.append(None)
        return named
    top = int(tips[:, 1].argmax())
    for k, tip in enumerate(tips):
        if k == top or (tip[1] > 0.85 and abs(tip[0]) < 0.08):
            named.append("head")
        elif low[k] and place[chains[k][0], 1] < 0.6:
            named.append(f"leg_{_side(tip)}")
        elif abs(tip[0]) > 0.06:
            named.append(f"arm_{_side(tip)}")
        else:
            named.append(None)
    return named


def _side(tip: np.ndarray) -> str:
    return "left" if tip[0] > 0 else "right"
