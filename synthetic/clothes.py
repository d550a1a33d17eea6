"""What a generated person wears in a clip: colours of skin, hair and clothes a vertex, eyes and mouth painted."""

from __future__ import annotations

import numpy as np

from synthetic.bank import HUMAN_PARTS, vertex_parts
from synthetic.coats import Coat, Mark, smooth_noise
from synthetic.flesh import Body

SKINS = ((0.93, 0.75, 0.63), (0.80, 0.58, 0.43), (0.55, 0.37, 0.26), (0.33, 0.22, 0.16))
CLOTHS = ((0.16, 0.22, 0.42), (0.72, 0.20, 0.18), (0.20, 0.42, 0.30), (0.86, 0.84, 0.78), (0.25, 0.25, 0.27),
          (0.84, 0.64, 0.22), (0.45, 0.30, 0.50))  # fmt: skip
HAIRS = ((0.12, 0.09, 0.07), (0.35, 0.22, 0.12), (0.72, 0.55, 0.30), (0.50, 0.20, 0.10))


def clothes(body: Body, rng: np.random.Generator) -> Coat:
    """Dress a person of :func:`synthetic.people.person`."""
    skin, hair = (np.array(choice[int(rng.integers(len(choice)))]) for choice in (SKINS, HAIRS))
    top, bottom, shoe = (np.array(CLOTHS[k]) for k in rng.choice(len(CLOTHS), 3, replace=False))
    sleeves, trousers = rng.random() < 0.6, rng.random() < 0.75
    by_part = {name: top for name in HUMAN_PARTS} | {
        "face": skin, "neck": skin, "hand": skin, "hair": hair, "pelvis": bottom, "thigh": bottom, "shoe": shoe,
        "shin": bottom if trousers else skin, "forearm": top if sleeves else skin,
    }  # fmt: skip
    part = vertex_parts(body, "human", rng)
    colour = np.stack([by_part[name] for name in HUMAN_PARTS])[part]
    stripes = smooth_noise(rng, 3.0)(body.vertices), smooth_noise(rng, 12.0)(body.vertices)
    cloth = np.isin(part, [HUMAN_PARTS.index(n) for n in ("top", "top_front", "top_back", "sleeve", "pelvis", "thigh")])
    pattern = np.sin(2 * np.pi * body.vertices[:, 1] * rng.uniform(5, 9)) if rng.random() < 0.5 else stripes[0]
    shade = np.where(cloth, 0.22 * np.clip(3 * pattern, -1, 1), 0.0) + 0.06 * stripes[1]
    marks = []
    for name, (centre, radius) in body.marks.items():
        dark = {"eye": (0.06, 0.05, 0.05), "brow": tuple(0.6 * hair), "mouth": (0.55, 0.22, 0.22)}.get(
            name.split("_")[0]
        )
        if dark is not None:
            size = {"eye": 0.8, "brow": 0.45, "mouth": 0.6}[name.split("_")[0]]
            marks.append(Mark(centre, radius * size, np.array(dark)))
    return Coat(np.clip(colour * (1 + shade[:, None]), 0.02, 0.98), tuple(marks))
