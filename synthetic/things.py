"""Things that are neither animal nor person: what a network must learn to leave alone. Lumps, furniture, poles.

Each is a few round cones and slabs at random, one bone, 2 units along its longest edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from synthetic.flesh import Body, Bone, Cone, assemble

PLACES = 1200


@dataclass(frozen=True)
class Slab(Cone):
    """A box of half sides `half` about `a`, turned by `turn`; what it has of a cone is only its reach."""

    half: tuple[float, float, float] = (0.1, 0.1, 0.1)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of (N, 3) points, negative inside."""
        q = np.abs(Rotation.from_rotvec(self.turn).inv().apply(points - self.a)) - np.array(self.half)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)


def thing(rng: np.random.Generator, cells: int = 56) -> Body:
    """A thing at random."""
    kind = rng.choice(["lump", "furniture", "mixed"], p=[0.35, 0.4, 0.25])
    cones: list[Cone] = []
    count = int(rng.integers(1, 7))
    at = np.zeros(3)
    for _ in range(count):
        if kind == "lump" or (kind == "mixed" and rng.random() < 0.5):
            tip = at + rng.normal(0, 0.3, 3)
            axis = rng.normal(size=3) if rng.random() < 0.4 else None
            ra, rb, blend = (float(v) for v in rng.uniform([0.06, 0.06, 0.01], [0.3, 0.3, 0.1]))
            cones.append(Cone("thing", at, tip, ra, rb, blend, axis, float(rng.uniform(0.4, 1))))
            at = at + rng.normal(0, 0.25, 3)
        else:
            half = rng.uniform(0.05, 0.4, 3)
            if rng.random() < 0.3:
                half[int(rng.integers(3))] = 0.05
            if rng.random() < 0.3:
                half[int(rng.integers(3))] = 0.7
            turn = rng.normal(0, 0.5, 3) if rng.random() < 0.3 else np.array([0, rng.uniform(0, 3), 0])
            reach = float(np.linalg.norm(half))
            cones.append(
                Slab("thing", at, at + 1e-4, reach, reach, float(rng.uniform(0.004, 0.03)), half=tuple(half),
                     turn=tuple(turn))
            )  # fmt: skip
            at = at + rng.uniform(-1, 1, 3) * half
    return assemble([Bone("thing", -1, np.zeros(3), np.array([0, 1.0, 0]))], cones, {}, cells)


def places() -> np.ndarray:
    """(PLACES, 3) fixed points that stand in for a canonical surface: a colour needs somewhere to sit."""
    return np.random.default_rng(77).uniform(-1, 1, (PLACES, 3))


def place_labels(body: Body) -> np.ndarray:
    """(V,) nearest of `places` for every vertex."""
    return np.asarray(cKDTree(places()).query(body.vertices)[1])


def thing_parts(body: Body, rng: np.random.Generator) -> np.ndarray:
    """(V,) uint8 part: cut by a few random planes."""
    part = np.zeros(len(body.vertices), int)
    for k in range(3):
        part += 2**k * (body.vertices @ rng.normal(size=3) > rng.normal(0, 0.3))
    return part.astype(np.uint8)
