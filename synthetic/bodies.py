"""Animals we generate: a smooth watertight surface on a skeleton, with soft skinning weights.

Nothing flows in but proportions; a :class:`Body` flows out. Space: object space, y up, z to the front, x to the
animal's left, the longest edge of the rest shape's box is 2 units, the box is centred on the origin.

How a surface grows on a skeleton: :mod:`synthetic.flesh`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from synthetic.flesh import Body, Bone, Cone, assemble


@dataclass(frozen=True)
class QuadrupedShape:
    """Proportions of a quadruped; lengths in units of the distance from hip to shoulder."""

    leg: float = 0.66
    """Height of the hip above the ground."""
    stance: float = 0.125
    """Half the distance between left and right feet."""
    chest: float = 0.2
    """Radius of the rib cage."""
    belly: float = 0.165
    """Radius of the loin."""
    haunch: float = 0.15
    """Radius of the thigh's muscle."""
    limb: float = 0.052
    """Radius of a leg at the wrist and hock."""
    paw: float = 0.06
    """Radius of a paw."""
    neck: float = 0.32
    """Length of the neck."""
    neck_girth: float = 0.115
    """Radius of the neck."""
    neck_pitch_deg: float = 38.0
    """How steeply the neck rises."""
    skull: float = 0.135
    """Radius of the skull."""
    muzzle: float = 0.17
    """Length of the muzzle in front of the skull."""
    muzzle_girth: float = 0.07
    """Radius of the muzzle."""
    ear: float = 0.17
    """Length of an ear."""
    ear_droop: float = 0.0
    """0: ears stand; 1: they hang."""
    tail: float = 0.75
    """Length of the tail."""
    tail_girth: float = 0.055
    """Radius of the tail."""
    tail_pitch_deg: float = -20.0
    """Direction of the tail at its root: 0 straight back, 90 up."""


CAT = QuadrupedShape(
    leg=0.6, chest=0.21, belly=0.185, haunch=0.17, neck=0.25, neck_girth=0.125, skull=0.15, muzzle=0.075,
    muzzle_girth=0.062, ear=0.145,
)  # fmt: skip
DOG = QuadrupedShape(
    leg=0.78, chest=0.215, belly=0.15, neck=0.36, neck_pitch_deg=48, skull=0.13, muzzle=0.2, muzzle_girth=0.075,
    ear=0.16, ear_droop=0.85, tail=0.55, tail_girth=0.045, tail_pitch_deg=25,
)  # fmt: skip
FOX = QuadrupedShape(
    leg=0.68, chest=0.185, belly=0.155, haunch=0.14, limb=0.042, paw=0.05, neck=0.28, muzzle=0.18, muzzle_girth=0.055,
    skull=0.122, ear=0.21, tail=0.85, tail_girth=0.11, tail_pitch_deg=-25,
)  # fmt: skip
HORSE = QuadrupedShape(
    leg=0.98, stance=0.12, chest=0.23, belly=0.2, haunch=0.19, limb=0.045, paw=0.055, neck=0.56, neck_girth=0.12,
    neck_pitch_deg=46, skull=0.115, muzzle=0.32, muzzle_girth=0.085, ear=0.1, tail=0.6, tail_girth=0.06,
    tail_pitch_deg=-60,
)  # fmt: skip
KINDS = {"cat": CAT, "dog": DOG, "fox": FOX, "horse": HORSE}
"""Named proportions."""


STOUT = 0.4
"""Share of stout bodies among quadrupeds at random."""


def vary_quadruped(rng: np.random.Generator) -> QuadrupedShape:
    """Any quadruped: from the proportions of a cat, a dog or a horse, far enough to meet what none of them is like."""
    start = (CAT, DOG, HORSE, DOG)[int(rng.integers(4))]
    shape = vary(start, rng, 0.17)
    shape = replace(
        shape,
        ear=float(rng.uniform(0.1, 0.33)),
        ear_droop=float(rng.choice([0.0, rng.uniform(0, 1)], p=[0.68, 0.32])),
        muzzle=float(rng.uniform(0.05, 0.32)),
        skull=float(rng.uniform(0.11, 0.2)),
        tail=float(rng.uniform(0.12, 1.15)),
        tail_girth=float(rng.uniform(0.03, 0.07) if rng.random() < 0.6 else rng.uniform(0.07, 0.16)),
        tail_pitch_deg=float(rng.uniform(-65, 75)),
        neck_pitch_deg=float(rng.uniform(15, 65)),
    )
    if rng.random() < STOUT:  # thick fur and a round belly on short legs, as cats at home have them
        round_ = float(rng.uniform(1.15, 1.7))
        shape = replace(
            shape,
            chest=shape.chest * round_,
            belly=shape.belly * round_ * float(rng.uniform(0.95, 1.2)),
            haunch=shape.haunch * float(rng.uniform(1.0, 1.45)),
            neck_girth=shape.neck_girth * float(rng.uniform(1.0, 1.6)),
            limb=shape.limb * float(rng.uniform(1.0, 1.7)),
            leg=shape.leg * float(rng.uniform(0.85, 1.2)),
            neck=shape.neck * float(rng.uniform(0.6, 1.0)),
            skull=shape.skull * float(rng.uniform(1.0, 1.4)),
            stance=shape.stance * float(rng.uniform(1.0, 1.5)),
        )
    return replace(shape, muzzle_girth=shape.skull * float(rng.uniform(0.38, 0.72)))


def vary(shape: QuadrupedShape, rng: np.random.Generator, amount: float = 0.08) -> QuadrupedShape:
    """Another individual of the same kind: every proportion changed by about `amount` of itself."""
    factors = {f.name: getattr(shape, f.name) * float(np.exp(rng.normal(0, amount))) for f in fields(shape)}
    factors["ear_droop"] = float(np.clip(factors["ear_droop"], 0, 1))
    return replace(shape, **factors)


def quadruped(shape: QuadrupedShape = CAT, cells: int = 150) -> Body:
    """Build a quadruped; `cells` marching-cubes cells along its length."""
    bones, cones, marks = plan(shape)
    return assemble(bones, cones, marks, cells)


def plan(s: QuadrupedShape) -> tuple[list[Bone], list[Cone], dict[str, tuple[np.ndarray, float]]]:
    """Joints and flesh of a quadruped standing at rest, soles at y = 0."""
    bones: list[Bone] = []
    cones: list[Cone] = []

    def bone(name: str, parent: str | None, joint: np.ndarray, tip: np.ndarray) -> None:
        names = [b.name for b in bones]
        bones.append(Bone(name, -1 if parent is None else names.index(parent), np.array(joint), np.array(tip)))

    def flesh(name: str, a: np.ndarray, b: np.ndarray, ra: float, rb: float, blend: float = 0.05, **kw: object) -> None:
        cones.append(Cone(name, np.asarray(a, float), np.asarray(b, float), ra, rb, blend, **kw))  # type: ignore[arg-type]

    def at(*xyz: float) -> np.ndarray:
        return np.array(xyz, float)

    side_axis = at(1, 0, 0)
    top = s.leg + 0.10  # the back's line of joints
    pelvis, loin, chest, withers = (
        at(0, top, -0.5),
        at(0, top + 0.015, -0.18),
        at(0, top, 0.14),
        at(0, top + 0.03, 0.46),
    )
    bone("pelvis", None, pelvis, loin)
    bone("loin", "pelvis", loin, chest)
    bone("chest", "loin", chest, withers)
    flesh(
        "pelvis",
        pelvis + at(0, -0.035, 0.0),
        loin + at(0, -0.06, 0),
        s.haunch * 1.05,
        s.belly,
        0.1,
        axis=side_axis,
        squeeze=0.9,
    )
    flesh(
        "loin",
        loin + at(0, -0.07, 0),
        chest + at(0, -0.08, 0),
        s.belly,
        s.chest * 0.97,
        0.1,
        axis=side_axis,
        squeeze=0.88,
    )
    flesh(
        "chest",
        chest + at(0, -0.085, 0),
        withers + at(0, -0.1, -0.05),
        s.chest,
        s.chest * 0.86,
        0.1,
        axis=side_axis,
        squeeze=0.84,
    )

    up = np.deg2rad(s.neck_pitch_deg)
    head = withers + s.neck * at(0, np.sin(up), np.cos(up))
    middle = (withers + head) / 2 + at(0, 0.0, 0.01)
    brow = head + at(0, 0.02, s.skull * 0.7)
    nose = brow + at(0, -0.32 * s.skull - 0.1 * s.muzzle, s.skull * 0.45 + s.muzzle)
    bone("neck", "chest", withers, middle)
    bone("neck2", "neck", middle, head)
    bone("head", "neck2", head, nose)
    flesh("neck", withers + at(0, -0.05, -0.02), middle, s.neck_girth * 1.3, s.neck_girth, 0.09)
    flesh("neck2", middle, head, s.neck_girth, s.neck_girth * 0.9, 0.06)
    flesh("head", head + at(0, 0.01, 0.01), brow, s.skull * 0.92, s.skull * 0.9, 0.05)
    flesh("head", brow + at(0, -0.35 * s.skull, 0), nose, s.muzzle_girth * 1.45, s.muzzle_girth * 0.8, 0.06)
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        cheek = brow + at(sign * 0.45 * s.skull, -0.42 * s.skull, -0.1 * s.skull)
        flesh("head", cheek, cheek + at(0, 0, 0.3 * s.skull), 0.5 * s.skull, 0.42 * s.skull, 0.05)
        root = head + at(sign * 0.6 * s.skull, 0.62 * s.skull, 0.3 * s.skull)
        stand, hang = at(sign * 0.42, 0.9, -0.05), at(sign * 0.75, -0.65, 0.05)
        tip = root + s.ear * ((1 - s.ear_droop) * stand + s.ear_droop * hang)
        bone(f"ear_{side}", "head", root, tip)
        front = at(sign * 0.45, 0.1, 0.9) if s.ear_droop < 0.5 else at(sign * 0.9, 0.3, 0.1)
        flesh(f"ear_{side}", root + at(0, -0.02, 0), tip, 0.078, 0.016, 0.018, axis=front, squeeze=0.36)

    slope, links = np.deg2rad(s.tail_pitch_deg), 5
    joint, parent = pelvis + at(0, 0.04, -s.haunch * 0.85), "pelvis"
    for i in range(links):
        bend = slope + np.deg2rad(9.0) * i
        tip = joint + s.tail / links * at(0, np.sin(bend), -np.cos(bend))
        bone(f"tail{i}", parent, joint, tip)
        thick = [0.75, 0.95, 1.0, 0.95, 0.85, 0.45]
        flesh(f"tail{i}", joint, tip, s.tail_girth * thick[i], s.tail_girth * thick[i + 1], 0.03 if i else 0.05)
        joint, parent = tip, f"tail{i}"

    for sign, side in ((1.0, "left"), (-1.0, "right")):
        x, h = sign * s.stance, s.leg
        shoulder, elbow = at(x * 0.9, h * 0.93, 0.42), at(x, h * 0.54, 0.30)
        wrist, sole, toe = at(x, h * 0.2, 0.37), at(x, s.paw * 0.8, 0.37), at(x, s.paw * 0.72, 0.37 + 1.25 * s.paw)
        bone(f"arm_{side}", "chest", shoulder, elbow)
        bone(f"forearm_{side}", f"arm_{side}", elbow, wrist)
        bone(f"hand_{side}", f"forearm_{side}", wrist, sole)
        flesh(f"arm_{side}", shoulder, elbow, s.haunch * 0.72, s.limb * 1.55, 0.07)
        flesh(f"forearm_{side}", elbow, wrist, s.limb * 1.4, s.limb * 1.0, 0.04)
        flesh(f"hand_{side}", wrist, sole, s.limb * 1.0, s.limb * 1.05, 0.03)
        flesh(f"hand_{side}", sole, toe, s.paw, s.paw * 0.88, 0.03)
        hip, knee = at(x * 0.85, h * 0.97, -0.47), at(x * 1.05, h * 0.58, -0.34)
        hock, heel = at(x, h * 0.29, -0.57), at(x, s.paw * 0.8, -0.52)
        bone(f"thigh_{side}", "pelvis", hip, knee)
        bone(f"shin_{side}", f"thigh_{side}", knee, hock)
        bone(f"foot_{side}", f"shin_{side}", hock, heel)
        flesh(f"thigh_{side}", hip, knee, s.haunch * 0.95, s.limb * 1.75, 0.07)
        flesh(f"shin_{side}", knee, hock, s.limb * 1.6, s.limb * 0.95, 0.04)
        flesh(f"foot_{side}", hock, heel, s.limb * 0.95, s.limb * 1.0, 0.03)
        flesh(f"foot_{side}", heel, heel + at(0, -0.005, 1.3 * s.paw), s.paw, s.paw * 0.88, 0.03)

    marks = {"nose": (nose + at(0, 0.35 * s.muzzle_girth, 0.62 * s.muzzle_girth), 0.5 * s.muzzle_girth)}
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        marks[f"eye_{side}"] = (brow + at(sign * 0.56 * s.skull, 0.16 * s.skull, 0.72 * s.skull), 0.2 * s.skull)
    return bones, cones, marks
