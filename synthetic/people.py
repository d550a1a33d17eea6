"""People we generate: a body in casual clothes on a skeleton, standing with its arms a little away from its sides.

Nothing flows in but proportions; a :class:`synthetic.flesh.Body` flows out. Lengths of :class:`PersonShape` are in
metres of a person about 1.7 m tall; the finished body is 2 units along its longest edge, y up, z to the front, x to
the person's left.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from synthetic.flesh import Body, Bone, Cone, assemble


@dataclass(frozen=True)
class PersonShape:
    """Proportions and clothes of a person; lengths in metres."""

    leg: float = 0.88
    """Height of the hips above the ground."""
    torso: float = 0.52
    """From hips to the base of the neck."""
    neck: float = 0.09
    """Length of the neck."""
    head: float = 0.105
    """Radius of the skull."""
    shoulder: float = 0.18
    """Half the distance between the shoulder joints."""
    hip: float = 0.095
    """Half the distance between the hip joints."""
    arm: float = 0.53
    """From shoulder to wrist."""
    chest: float = 0.135
    """Half width of the rib cage."""
    waist: float = 0.12
    """Half width of the waist."""
    pelvis: float = 0.14
    """Half width of the pelvis."""
    thigh: float = 0.082
    """Radius of the thigh."""
    calf: float = 0.055
    """Radius of the calf."""
    upper_arm: float = 0.046
    """Radius of the upper arm."""
    forearm: float = 0.038
    """Radius of the forearm."""
    foot: float = 0.19
    """Length of a foot."""
    loose: float = 0.012
    """How far trousers and sleeves stand off the body."""
    skirt: float = 0.0
    """Length of a skirt; 0 is none."""
    hair: float = 0.02
    """Thickness of the hair."""
    hair_length: float = 0.05
    """How far the hair hangs below the skull."""
    bun: float = 0.0
    """Radius of a bun or tail of hair behind the head; 0 is none."""
    brim: float = 0.0
    """Length of a cap's brim; 0 is no cap."""
    belly: float = 0.0
    """How far the belly stands out."""


def vary_person(rng: np.random.Generator, amount: float = 0.09) -> PersonShape:
    """Somebody else: build, clothes and hair drawn anew; children and toy-like figures among them."""
    usual = PersonShape()
    drawn = {f.name: getattr(usual, f.name) * float(np.exp(rng.normal(0, amount))) for f in fields(usual)}
    shape = PersonShape(**drawn)
    stout = float(np.exp(rng.normal(0.02, 0.14)))
    wide = ("chest", "waist", "pelvis", "thigh", "calf", "upper_arm", "forearm")
    shape = replace(shape, **{n: getattr(shape, n) * stout for n in wide})
    if rng.random() < 0.3:  # a child, or a figure drawn with a big head
        big = rng.uniform(1.15, 1.75)
        shape = replace(shape, head=shape.head * big, leg=shape.leg * rng.uniform(0.75, 1.0), neck=shape.neck * 0.8)
    return replace(
        shape,
        loose=float(rng.uniform(0.0, 0.035)),
        skirt=float(rng.uniform(0.2, 0.75)) if rng.random() < 0.15 else 0.0,
        hair=float(rng.uniform(0.004, 0.045)),
        hair_length=float(rng.uniform(-0.06, 0.08) if rng.random() < 0.6 else rng.uniform(0.08, 0.36)),
        bun=float(rng.uniform(0.035, 0.07)) if rng.random() < 0.2 else 0.0,
        brim=float(rng.uniform(0.05, 0.09)) if rng.random() < 0.12 else 0.0,
        belly=float(max(0.0, rng.normal(0.0, 0.05))),
    )


def person(shape: PersonShape | None = None, cells: int = 150) -> Body:
    """Build a person; `cells` marching-cubes cells along the height."""
    bones, cones, marks = plan(shape or PersonShape())
    return assemble(bones, cones, marks, cells)


def plan(s: PersonShape) -> tuple[list[Bone], list[Cone], dict[str, tuple[np.ndarray, float]]]:
    """Joints, flesh and painted marks of a person at rest, soles at y = 0."""
    bones: list[Bone] = []
    cones: list[Cone] = []

    def at(*xyz: float) -> np.ndarray:
        return np.array(xyz, float)

    def bone(name: str, parent: str | None, joint: np.ndarray, tip: np.ndarray) -> None:
        names = [b.name for b in bones]
        bones.append(Bone(name, -1 if parent is None else names.index(parent), joint, tip))

    def flesh(name: str, a: np.ndarray, b: np.ndarray, ra: float, rb: float, blend: float = 0.03, **kw: object) -> None:
        cones.append(Cone(name, a, b, ra, rb, blend, **kw))  # type: ignore[arg-type]

    deep = at(0, 0, 1)
    hips = at(0, s.leg + 0.02, 0)
    waist, chest, neck = hips + at(0, 0.3 * s.torso, 0), hips + at(0, 0.6 * s.torso, 0), hips + at(0, s.torso, -0.015)
    bone("pelvis", None, hips, waist)
    bone("spine", "pelvis", waist, chest)
    bone("chest", "spine", chest, neck)
    flat = 0.66  # a torso is flatter than it is wide
    flesh("pelvis", hips + at(0, -0.02, -0.01), waist, s.pelvis + 0.5 * s.loose, s.waist, 0.06, axis=deep, squeeze=0.74)
    flesh("spine", waist, chest, s.waist, s.chest * 0.97, 0.06, axis=deep, squeeze=flat)
    flesh("chest", chest, neck + at(0, -0.12, 0), s.chest, s.chest * 0.9, 0.06, axis=deep, squeeze=flat)
    if s.belly > 0.01:
        flesh("spine", waist + at(0, -0.03, s.belly), waist + at(0, 0.05, s.belly), s.waist * 0.8, s.waist * 0.7, 0.08)
    for sign in (1.0, -1.0):
        flesh("chest", neck + at(0, -0.045, 0), neck + at(sign * s.shoulder * 0.8, -0.06, 0), 0.05, 0.05, 0.05)

    skull = neck + at(0, s.neck, 0.012)
    middle = skull + at(0, s.head * 0.95, 0.01)
    bone("neck", "chest", neck, skull)
    bone("head", "neck", skull, middle + at(0, s.head, 0))
    flesh("neck", neck + at(0, -0.02, 0), skull + at(0, 0.02, 0), 0.052, 0.05, 0.03)
    flesh("head", middle + at(0, 0.15 * s.head, -0.06 * s.head), middle + at(0, -0.35 * s.head, 0.18 * s.head),
          s.head, s.head * 0.72, 0.03, axis=at(1, 0, 0), squeeze=0.84)  # fmt: skip
    nose = middle + at(0, -0.18 * s.head, 1.02 * s.head)
    flesh("head", nose + at(0, 0.2 * s.head, -0.16 * s.head), nose, 0.1 * s.head, 0.16 * s.head, 0.02)
    for sign in (1.0, -1.0):
        ear = middle + at(sign * 0.86 * s.head, -0.08 * s.head, -0.05 * s.head)
        flesh("head", ear, ear + at(0, 0.15 * s.head, 0), 0.17 * s.head, 0.17 * s.head, 0.012)
    crown = middle + at(0, 0.22 * s.head, -0.2 * s.head)
    flesh("head", crown, crown + at(0, -0.1 * s.head, -0.05 * s.head), s.head * 0.9 + s.hair, s.head * 0.85 + s.hair,
          0.012, axis=at(1, 0, 0), squeeze=0.9)  # fmt: skip
    if s.hair_length > 0.02:
        back = middle + at(0, -0.1 * s.head, -0.42 * s.head)
        flesh("head", back, back + at(0, -0.5 * s.head - s.hair_length, -0.12 * s.head), s.head * 0.72 + s.hair * 0.6,
              s.head * 0.5, 0.02, axis=deep, squeeze=0.7)  # fmt: skip
    if s.bun > 0:
        flesh("head", middle + at(0, 0.4 * s.head, -1.15 * s.head), middle + at(0, -0.3 * s.head, -1.35 * s.head),
              s.bun, s.bun * 0.7, 0.02)  # fmt: skip
    if s.brim > 0:
        brim = middle + at(0, 0.42 * s.head, 0.75 * s.head)
        flesh("head", brim, brim + at(0, -0.02, s.brim + 0.25 * s.head), 0.6 * s.head, 0.5 * s.head, 0.012,
              axis=at(0, 1, 0), squeeze=0.16)  # fmt: skip

    spread = np.deg2rad(38.0)  # how far the arms hang away from straight down
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        down = at(sign * np.sin(spread), -np.cos(spread), 0)
        shoulder = neck + at(sign * s.shoulder, -0.065, -0.005)
        elbow, wrist = shoulder + 0.54 * s.arm * down, shoulder + s.arm * down
        finger = wrist + 0.16 * down
        bone(f"clavicle_{side}", "chest", neck + at(sign * 0.03, -0.05, 0), shoulder)
        bone(f"arm_{side}", f"clavicle_{side}", shoulder, elbow)
        bone(f"forearm_{side}", f"arm_{side}", elbow, wrist)
        bone(f"hand_{side}", f"forearm_{side}", wrist, finger)
        sleeve = 0.7 * s.loose
        flesh(f"arm_{side}", shoulder, elbow, s.upper_arm * 1.15 + sleeve, s.upper_arm * 0.9 + sleeve, 0.03)
        flesh(f"forearm_{side}", elbow, wrist, s.forearm + sleeve, s.forearm * 0.78 + 0.6 * sleeve, 0.02)
        flesh(f"hand_{side}", wrist, finger + at(0, 0, 0.01), 0.034, 0.026, 0.015, axis=at(sign * 0.8, 0.6, 0),
              squeeze=0.6)  # fmt: skip
        flesh(f"hand_{side}", wrist + 0.03 * down, wrist + 0.07 * down + at(0, 0, 0.055), 0.017, 0.013, 0.01)
        hip = hips + at(sign * s.hip, -0.04, 0)
        knee, ankle = at(sign * s.hip * 1.02, s.leg * 0.53, 0.015), at(sign * s.hip * 1.05, 0.075, -0.02)
        toe = at(sign * s.hip * 1.2, 0.035, -0.02 + s.foot)
        bone(f"thigh_{side}", "pelvis", hip, knee)
        bone(f"shin_{side}", f"thigh_{side}", knee, ankle)
        bone(f"foot_{side}", f"shin_{side}", ankle, toe)
        flesh(f"thigh_{side}", hip, knee, s.thigh * 1.1 + s.loose, s.thigh * 0.72 + s.loose, 0.025)
        flesh(f"shin_{side}", knee, ankle, s.calf + s.loose, s.calf * 0.68 + 0.9 * s.loose, 0.02)
        heel = ankle + at(0, -0.035, -0.02)
        flesh(f"foot_{side}", heel, toe, 0.042, 0.036, 0.015, axis=at(0, 1, 0), squeeze=0.8)
    if s.skirt > 0:
        hem = hips + at(0, -s.skirt, 0)
        flesh("pelvis", hips + at(0, 0.05, 0), hem, s.pelvis * 1.02, s.pelvis * 1.0 + 0.22 * s.skirt, 0.03, axis=deep,
              squeeze=0.8)  # fmt: skip

    marks: dict[str, tuple[np.ndarray, float]] = {}
    for sign, side in ((1.0, "left"), (-1.0, "right")):
        marks[f"eye_{side}"] = (middle + at(sign * 0.36 * s.head, 0.08 * s.head, 0.88 * s.head), 0.2 * s.head)
        marks[f"brow_{side}"] = (middle + at(sign * 0.36 * s.head, 0.34 * s.head, 0.92 * s.head), 0.16 * s.head)
    marks["mouth"] = (middle + at(0, -0.52 * s.head, 0.88 * s.head), 0.22 * s.head)
    marks["skull"] = (middle, s.head)
    return bones, cones, marks
