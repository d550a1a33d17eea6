"""Postures at random: joint angles of quadrupeds and people as casual videos show them, one moment at a time.

Where :mod:`synthetic.motion` plays a scene over time with feet on the ground, this draws single moments for training:
standing, walking, running, looking about, sitting, lying, jumping; waving, dancing, reaching. A posture maps bone
names to rotation vectors (radians, axes of object space at rest) about the bone's joint; root motion is not in it,
so object space keeps y up and z along the heading.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from synthetic.flesh import Body

Posture = dict[str, np.ndarray]
SIDES = (("left", 1.0), ("right", -1.0))


def bone_transforms(body: Body, posture: Posture) -> np.ndarray:
    """(B, 4, 4) rest-to-posed transforms: every bone turned about its joint, parents first."""
    vectors = np.stack([posture.get(b.name, np.zeros(3)) for b in body.bones])
    turned = Rotation.from_rotvec(vectors).as_matrix()
    local = np.tile(np.eye(4), (len(body.bones), 1, 1))
    joints = np.stack([b.joint for b in body.bones])
    local[:, :3, :3] = turned
    local[:, :3, 3] = joints - np.einsum("bij,bj->bi", turned, joints)
    pose = local.copy()
    for i, bone in enumerate(body.bones):
        if bone.parent >= 0:
            pose[i] = pose[bone.parent] @ local[i]
    return pose


def quadruped_posture(rng: np.random.Generator) -> Posture:
    """A moment in the life of a quadruped; bones as :func:`synthetic.bodies.plan` names them."""
    mode = rng.choice(
        ["stand", "walk", "run", "sit", "lie", "leap", "odd"], p=[0.22, 0.36, 0.13, 0.09, 0.05, 0.07, 0.08]
    )
    p: Posture = {}
    noise = {"stand": 0.09, "odd": 0.3}.get(str(mode), 0.07)
    phase, size = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.55)
    if mode == "run":
        size = rng.uniform(0.4, 0.85)
    trot = rng.random() < 0.5
    for side, sign in SIDES:
        offset = 0.0 if sign > 0 else np.pi
        for fore in (True, False):
            at = phase + offset + (np.pi if fore and trot else 0.5 * np.pi * fore)
            if mode == "run":
                at = phase + 0.5 * (sign > 0) + (2.4 if fore else 0.0)
            moves = size if mode in ("walk", "run") else 0.0
            swing, lift = -moves * np.sin(at), moves * max(0.0, np.cos(at))
            if fore:
                p[f"arm_{side}"] = _x(swing + 0.3 * lift)
                p[f"forearm_{side}"] = _x(-0.9 * lift - 0.15 * moves)
                p[f"hand_{side}"] = _x(0.9 * lift)
            else:
                p[f"thigh_{side}"] = _x(swing - 0.4 * lift)
                p[f"shin_{side}"] = _x(0.9 * lift)
                p[f"foot_{side}"] = _x(-0.6 * lift)
    pitch = rng.normal(0, 0.05)
    if mode == "sit":
        pitch = -rng.uniform(0.5, 0.95)
        for side, sign in SIDES:
            p[f"thigh_{side}"] = np.array([rng.uniform(-0.7, -0.3), 0, sign * rng.uniform(0, 0.4)])
            p[f"shin_{side}"] = _x(rng.uniform(0.9, 1.3))
            p[f"foot_{side}"] = _x(-rng.uniform(0.8, 1.3) - pitch * 0.3)
            p[f"arm_{side}"] = _x(-pitch * 0.95)
    elif mode == "lie":
        for side, sign in SIDES:
            p[f"thigh_{side}"] = np.array([rng.uniform(-1.1, -0.7), 0, sign * rng.uniform(0, 0.4)])
            p[f"shin_{side}"], p[f"foot_{side}"] = _x(rng.uniform(1.5, 2.0)), _x(-rng.uniform(0.8, 1.3))
            fold = rng.uniform(0.4, 1.3)
            p[f"arm_{side}"], p[f"forearm_{side}"] = _x(fold), _x(-fold - rng.uniform(0.3, 1.4))
    elif mode == "leap":
        pitch = rng.normal(0, 0.3)
        stretch = rng.choice([-1, 1]) * rng.uniform(0.4, 0.95)
        for side, _ in SIDES:
            p[f"arm_{side}"], p[f"forearm_{side}"] = _x(-stretch), _x(-0.4 * max(0.0, -stretch))
            p[f"thigh_{side}"], p[f"shin_{side}"] = _x(stretch), _x(0.5 * max(0.0, -stretch))
    for side, sign in SIDES:
        for name in (f"arm_{side}", f"forearm_{side}", f"thigh_{side}", f"shin_{side}", f"hand_{side}", f"foot_{side}"):
            p[name] = p.get(name, np.zeros(3)) + _x(rng.normal(0, noise)) + np.array([0, 0, rng.normal(0, 0.05)])
        p[f"ear_{side}"] = np.array([rng.normal(-0.08, 0.22), sign * rng.normal(0, 0.35), sign * rng.normal(0, 0.2)])
    bend, arch = rng.normal(0, 0.1), rng.normal(0, 0.08)
    p["pelvis"] = np.array([pitch, rng.normal(0, 0.06), rng.normal(0, 0.05)])
    p["loin"] = np.array([arch, bend, 0]) + rng.normal(0, 0.04, 3)
    p["chest"] = np.array([-arch, bend, 0]) + rng.normal(0, 0.04, 3)
    down = rng.choice([rng.normal(0.05, 0.2), rng.uniform(0.3, 1.25), rng.uniform(-0.6, 0)], p=[0.6, 0.25, 0.15])
    look = rng.normal(0, 0.28) if rng.random() < 0.7 else rng.uniform(-1.1, 1.1)
    p["neck"] = np.array([0.5 * down - 0.75 * min(pitch, 0.0), 0.35 * look, 0])
    p["neck2"] = np.array([0.3 * down, 0.3 * look, 0])
    p["head"] = np.array([0.2 * down + rng.normal(0, 0.15), 0.35 * look, rng.normal(0, 0.15)])
    lift, curl, wag = rng.normal(0.0, 0.3), rng.normal(0, 0.16), rng.normal(0, 0.2)
    if rng.random() < 0.35:
        lift, curl = rng.uniform(0.5, 1.5), rng.normal(0, 0.25)
    for i in range(5):
        p[f"tail{i}"] = np.array([(lift if i == 0 else curl), wag * (0.5 + 0.3 * i), 0]) + rng.normal(0, 0.06, 3)
    return p


def person_posture(rng: np.random.Generator) -> Posture:
    """A moment of a person; bones as :func:`synthetic.people.plan` names them."""
    mode = rng.choice(["stand", "walk", "run", "dance", "sit", "crouch"], p=[0.3, 0.24, 0.1, 0.26, 0.05, 0.05])
    p: Posture = {}
    phase, size = (
        rng.uniform(0, 2 * np.pi),
        {"walk": rng.uniform(0.2, 0.5), "run": rng.uniform(0.5, 0.9)}.get(str(mode), 0.0),
    )
    deep = {"sit": rng.uniform(1.2, 1.6), "crouch": rng.uniform(0.5, 1.6), "dance": rng.uniform(0, 0.5)}.get(
        str(mode), 0.0
    )
    for side, sign in SIDES:
        wave = np.sin(phase + (0 if sign > 0 else np.pi))
        lift = size * max(0.0, np.cos(phase + (0 if sign > 0 else np.pi)))
        spread = abs(rng.normal(0, 0.07 if mode != "dance" else 0.22))
        own = deep * rng.uniform(0.5, 1.2) if mode == "dance" else deep
        p[f"thigh_{side}"] = np.array([-size * wave - 0.4 * lift - own, sign * rng.normal(0.08, 0.15), sign * spread])
        p[f"shin_{side}"] = _x(1.2 * lift + own * 1.1 + abs(rng.normal(0, 0.07)))
        p[f"foot_{side}"] = np.array([rng.normal(0, 0.1) - (0.2 * own if mode != "sit" else 0), sign * 0.15, 0])
        if mode == "dance" and rng.random() < 0.25:
            p[f"thigh_{side}"] = p[f"thigh_{side}"] + _x(-rng.uniform(0.2, 1.1))
            p[f"shin_{side}"] = _x(rng.uniform(0.2, 1.5))
        _arm(rng, p, side, sign, str(mode), size * wave)
    lean = {"walk": 0.04, "run": 0.16, "crouch": 0.35}.get(str(mode), 0.0) + rng.normal(0, 0.06)
    twist = rng.normal(0, 0.1 if mode != "dance" else 0.25) + 0.2 * size * np.sin(phase)
    side_lean = rng.normal(0, 0.04 if mode != "dance" else 0.14)
    if rng.random() < 0.06:
        lean += rng.uniform(0.3, 1.0)
    p["pelvis"] = np.array([0.3 * lean, -0.4 * twist, -side_lean])
    p["spine"] = np.array([0.5 * lean, 0.7 * twist, side_lean])
    p["chest"] = np.array([0.4 * lean, 0.7 * twist, side_lean])
    look = rng.normal(0, 0.3)
    p["neck"] = np.array([rng.normal(0.05, 0.1) - 0.4 * lean, 0.4 * look, rng.normal(0, 0.06)])
    p["head"] = np.array([rng.normal(0.05, 0.15) - 0.3 * lean, 0.6 * look, rng.normal(0, 0.1)])
    return p


def _arm(rng: np.random.Generator, p: Posture, side: str, sign: float, mode: str, swing: float) -> None:
    """One arm's rotations: hanging and swinging, or one of a few things that arms do. At rest it is 38 degrees out."""
    hang, wild = 0.55, mode == "dance" or rng.random() < 0.22
    if not wild:
        out = abs(rng.normal(0.0, 0.12))
        flex = rng.uniform(0.9, 1.8) if mode == "run" else abs(rng.normal(0.15, 0.2)) + 0.4 * abs(swing)
        upper, lower = _turn([swing, 0, 0], [0, 0, -sign * (hang - out)]), _forward(flex, sign)
    else:
        kind = rng.choice(["up", "side", "front", "hip", "random"], p=[0.2, 0.2, 0.25, 0.15, 0.2])
        if kind == "up":
            upper = _turn([rng.normal(0, 0.3), 0, 0], [0, 0, sign * rng.uniform(1.2, 2.3)])
            lower = np.array([0, 0, sign * rng.uniform(-0.3, 1.4)])
        elif kind == "side":
            upper = _turn([0, -sign * rng.uniform(-0.4, 0.6), 0], [0, 0, sign * rng.uniform(0.2, 1.1)])
            lower = np.array([0, -sign * rng.uniform(0, 1.5), rng.normal(0, 0.4)])
        elif kind == "front":
            upper = _turn([-rng.uniform(0.3, 1.7), 0, 0], [0, 0, -sign * hang])
            lower = _forward(rng.uniform(0.0, 1.8), sign) + np.array([0, -sign * rng.uniform(0, 0.7), 0])
        elif kind == "hip":
            upper = _turn([rng.uniform(0.0, 0.4), 0, 0], [0, 0, sign * rng.uniform(-0.1, 0.35)])
            lower = np.array([-0.4, 0, -sign * rng.uniform(1.2, 1.8)])
        else:
            upper, lower = rng.normal(0, 0.9, 3), _forward(abs(rng.normal(0, 0.9)), sign)
    p[f"clavicle_{side}"] = rng.normal(0, 0.05, 3)
    p[f"arm_{side}"] = upper + rng.normal(0, 0.05, 3)
    p[f"forearm_{side}"] = lower
    p[f"hand_{side}"] = rng.normal(0, 0.2, 3)


def _forward(flex: float, sign: float) -> np.ndarray:
    """Flexing an elbow towards the front: about the axis across an arm that hangs 38 degrees out."""
    out = np.deg2rad(38.0)
    return -flex * np.array([np.cos(out), sign * np.sin(out), 0.0])


def _turn(*vectors: list[float]) -> np.ndarray:
    """Rotation vector of rotations in this order, the last one first applied."""
    total = Rotation.identity()
    for vector in vectors:
        total = total * Rotation.from_rotvec(vector)
    return total.as_rotvec()


def _x(angle: float) -> np.ndarray:
    """Rotation about the axis to the left: positive bows forward, swings a hanging leg back."""
    return np.array([angle, 0.0, 0.0])
