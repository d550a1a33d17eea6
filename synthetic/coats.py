"""What a generated animal wears: procedural colours in its own rest space, so that there is something to track.

A coat gives every vertex a colour (sRGB, 0..1) from smooth random fields of its rest position, and a few round marks
(eyes, nose) that are painted a pixel at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from synthetic.bodies import Body


@dataclass(frozen=True)
class Mark:
    """A painted ball: pixels whose rest position is within `radius` of `centre` take `colour`."""

    centre: np.ndarray  # (3,) rest space
    radius: float
    colour: np.ndarray  # (3,) sRGB


@dataclass(frozen=True)
class Coat:
    """Colours of a body at rest."""

    vertex_colours: np.ndarray  # (V, 3) sRGB 0..1
    marks: tuple[Mark, ...]


Field = Callable[[np.ndarray], np.ndarray]


def smooth_noise(rng: np.random.Generator, frequency: float, terms: int = 28) -> Field:
    """A smooth random field of (N, 3) points with values of about -1..1 and features of size 1 / `frequency`."""
    direction = rng.normal(size=(terms, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    waves = direction * (2 * np.pi * frequency * rng.uniform(0.55, 1.0, (terms, 1)))
    offsets = rng.uniform(0, 2 * np.pi, terms)
    scale = np.sqrt(2.0 / terms) * 0.8
    return lambda points: np.cos(points @ waves.T + offsets).sum(1) * scale


PALETTES = {
    "ginger": ((0.80, 0.45, 0.17), (0.50, 0.22, 0.07), (0.95, 0.90, 0.82)),
    "grey": ((0.55, 0.54, 0.52), (0.22, 0.21, 0.21), (0.92, 0.91, 0.88)),
    "brown": ((0.50, 0.36, 0.23), (0.20, 0.13, 0.08), (0.88, 0.80, 0.68)),
    "black": ((0.16, 0.15, 0.16), (0.07, 0.07, 0.08), (0.93, 0.92, 0.90)),
    "cream": ((0.86, 0.75, 0.58), (0.52, 0.36, 0.22), (0.97, 0.94, 0.88)),
}
"""Base, dark and light colour of a coat, sRGB."""
PATTERNS = ("tabby", "patches", "spots", "points")


def coat(body: Body, rng: np.random.Generator, pattern: str | None = None, palette: str | None = None) -> Coat:
    """Draw a coat; `pattern` (one of PATTERNS) and `palette` (a key of PALETTES) are random unless given."""
    pattern = pattern or str(rng.choice(PATTERNS))
    base, dark, light = (np.array(c) for c in PALETTES[palette or str(rng.choice(list(PALETTES)))])
    x = body.vertices
    parts = _parts(body)
    wobble, blotch = smooth_noise(rng, 1.6), smooth_noise(rng, 1.3)
    fine, fur = smooth_noise(rng, 9.0), smooth_noise(rng, 18.0)

    colour = np.tile(base, (len(x), 1))
    if pattern == "tabby":
        along = x[:, 2] * 7.5 + 0.35 * x[:, 1] + 0.55 * wobble(x)
        legs = x[:, 1] * 9.0 + 0.3 * wobble(x)
        stripe = np.sin(2 * np.pi * (along * (1 - parts["limb"]) + legs * parts["limb"]) * 0.55) + 0.35 * fine(x)
        colour = _mix(colour, dark, 0.85 * _step(stripe, 0.15, 0.35))
    elif pattern == "patches":
        colour = np.tile(light, (len(x), 1))
        field = blotch(x) + 0.15 * fine(x)
        colour = _mix(colour, base, _step(field, 0.0, 0.08))
        colour = _mix(colour, dark, _step(smooth_noise(rng, 1.5)(x) + 0.1 * fine(x), 0.4, 0.08))
    elif pattern == "spots":
        colour = _mix(colour, dark, 0.9 * _step(smooth_noise(rng, 4.2)(x) + 0.15 * fine(x), 0.42, 0.12))
    else:
        colour = _mix(colour, dark, np.clip(parts["limb"] * 1.1 + parts["ear"] + 0.4 * parts["tail_tip"], 0, 1) * 0.9)

    soft = 0.12 * wobble(x) + 0.05 * fine(x)
    colour = _mix(colour, light, 0.8 * _step(parts["under"] + soft, 0.62, 0.18))
    colour = _mix(colour, light, 0.85 * _step(parts["muzzle"] + soft, 0.55, 0.2))
    if pattern in ("points", "tabby") and rng.random() < 0.75:
        colour = _mix(colour, light, 0.9 * _step(parts["tail_tip"] + soft, 0.6, 0.12))
    if rng.random() < 0.5:
        colour = _mix(colour, light, 0.9 * _step(parts["sock"] + 0.5 * soft, 0.6, 0.12))

    shade = 0.10 * blotch(x) + 0.06 * fine(x) + 0.06 * fur(x)
    colour = colour * (1.0 + shade[:, None])

    iris = np.array([(0.55, 0.50, 0.15), (0.30, 0.20, 0.10), (0.35, 0.50, 0.30)][int(rng.integers(3))])
    marks = [Mark(body.marks["nose"][0], body.marks["nose"][1], np.array([0.13, 0.09, 0.09]))]
    for side in ("left", "right"):
        centre, radius = body.marks[f"eye_{side}"]
        marks.append(Mark(centre, radius * 1.12, np.array([0.06, 0.05, 0.05])))
        outward = np.array([0.35 if side == "left" else -0.35, 0.1, 1.0]) * radius * 0.45
        marks.append(Mark(centre + outward, radius * 0.72, iris))
        marks.append(Mark(centre + 1.7 * outward, radius * 0.4, np.array([0.02, 0.02, 0.02])))
    return Coat(np.clip(colour, 0.02, 0.98), tuple(marks))


def _parts(body: Body) -> dict[str, np.ndarray]:
    """Soft membership (V,) in 0..1 of parts of the body."""
    names = [b.name for b in body.bones]

    def of(*starts: str) -> np.ndarray:
        return body.weights[:, [i for i, n in enumerate(names) if n.startswith(starts)]].sum(1)

    x = body.vertices
    height = x[:, 1] - body.ground
    head = body.bones[body.index("head")]
    leg = float(body.bones[body.index("thigh_left")].joint[1] - body.ground)
    forward = head.tip - head.joint
    ahead = (x - head.joint) @ forward / float(forward @ forward)
    normals = _vertical(body)
    torso = of("pelvis", "loin", "chest", "neck")
    return {
        "limb": of("forearm", "hand", "shin", "foot") + 0.4 * of("arm", "thigh"),
        "ear": of("ear"),
        "under": torso * np.clip(-normals, 0, 1) + 0.75 * of("neck") * np.clip(-normals + 0.3, 0, 1),
        "muzzle": of("head") * np.clip(ahead * 1.35 - 0.45 - 1.2 * normals * (ahead < 0.9), 0, 1),
        "tail_tip": of("tail4") + 0.4 * of("tail3"),
        "sock": of("hand", "foot") * np.clip(1.6 - 5.0 * height / leg, 0, 1),
    }


def _vertical(body: Body) -> np.ndarray:
    """(V,) vertical component of the rest normals."""
    from stages.geometry.raster import vertex_normals

    return vertex_normals(body.vertices, body.faces)[:, 1]


def _mix(colour: np.ndarray, other: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return colour + (other - colour) * amount[:, None]


def _step(value: np.ndarray, threshold: float, width: float) -> np.ndarray:
    """Smooth step from 0 to 1 around `threshold`."""
    t = np.clip((value - threshold) / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)
