"""How a generated animal moves: gaits as joint angles over time, feet by inverse kinematics.

A :class:`Performance` says what the animal does when (walk, stand and look about, turn); :func:`perform` turns it and
a body into bone transforms in object space (root motion off) and the root's path through the room. Angles in radians,
times in seconds, positions in object units; object space is y up, z to the front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from synthetic.bodies import Body

FOOT_PHASE = {"thigh_left": 0.0, "arm_left": 0.25, "thigh_right": 0.5, "arm_right": 0.75}
"""Lateral-sequence walk: the order in which a walking cat sets down its feet."""
DUTY = 0.64
"""Part of a stride that a foot spends on the ground."""


@dataclass(frozen=True)
class Performance:
    """What the animal does over time; each is a smooth function sampled by linear interpolation."""

    times_s: np.ndarray  # (N,) knots
    walk: np.ndarray  # (N,) 0 standing .. 1 walking
    turn: np.ndarray  # (N,) heading in radians about y
    look_yaw: np.ndarray  # (N,) head to its left, radians
    look_pitch: np.ndarray  # (N,) head down, radians
    stride_s: float = 0.95
    stride: float = 0.36  # length of a stride in units of leg length times two
    energy: float = 1.0  # scales tail, bob and roll


@dataclass(frozen=True)
class Motion:
    """T sampled moments: bone transforms in object space and where the object is in the room."""

    bones: np.ndarray  # (T, B, 4, 4) posed from rest, object space
    room_from_object: np.ndarray  # (T, 4, 4) rigid; the soles stand on y = 0 of the room


def improvise(rng: np.random.Generator, duration_s: float) -> Performance:
    """A believable little scene: some walking, some standing and looking about, always gently turning."""
    knots = np.arange(0.0, duration_s + 1.5, 0.5)
    count = len(knots)
    period, start = rng.uniform(3.5, 5.0), rng.uniform(0, 1)
    walk = _ease(np.cos(2 * np.pi * (knots / period + start)) * 1.6 + 0.55)
    turn = np.cumsum(rng.normal(0, 0.12, count) + rng.choice([-1, 1]) * 0.16) * 0.5
    yaw = _wander(rng, count, 0.75) * (1.0 - 0.6 * walk)
    pitch = 0.12 + _wander(rng, count, 0.28) * (1.0 - 0.5 * walk)
    return Performance(
        knots, walk, turn, yaw, pitch, stride_s=float(rng.uniform(0.85, 1.1)), energy=float(rng.uniform(0.8, 1.2))
    )


def perform(body: Body, performance: Performance, times_s: np.ndarray) -> Motion:
    """Sample the motion at `times_s` (T,), any times from 0 on."""
    fine = np.arange(0.0, float(np.max(times_s)) + 0.02, 0.01)
    walk = smooth_in_time(np.interp(fine, performance.times_s, performance.walk), 25)
    heading = smooth_in_time(np.interp(fine, performance.times_s, performance.turn), 35)
    phase = np.cumsum(walk) * 0.01 / performance.stride_s
    leg = float(body.bones[body.index("thigh_left")].joint[1] - body.ground)
    stride = performance.stride * 2 * leg
    speed = np.gradient(phase, 0.01) * stride / DUTY * np.clip(walk, 0, 1)
    east = np.cumsum(speed * np.sin(heading)) * 0.01
    north = np.cumsum(speed * np.cos(heading)) * 0.01
    yaw = smooth_in_time(np.interp(fine, performance.times_s, performance.look_yaw), 31)
    pitch = smooth_in_time(np.interp(fine, performance.times_s, performance.look_pitch), 31)

    bones, places = [], []
    for t in np.asarray(times_s, float):
        now = [float(np.interp(t, fine, v)) for v in (walk, phase, yaw, pitch, heading, east, north)]
        bones.append(_pose(body, now[0], now[1], now[2], now[3], float(t), stride, performance.energy))
        places.append(place_in_room(now[4], now[5], now[6], -body.ground))
    return Motion(np.stack(bones), np.stack(places))


def _pose(
    body: Body, walk: float, phase: float, yaw: float, pitch: float, t: float, stride: float, energy: float
) -> np.ndarray:
    """(B, 4, 4) bone transforms of one moment."""
    cycle = 2 * np.pi * phase
    turn: dict[str, np.ndarray] = {}  # bone -> rotation vector about its joint
    sway, amount = np.sin(cycle), walk * energy
    breath = np.sin(2 * np.pi * t / 2.6)
    turn["pelvis"] = np.array(
        [0.03 * np.sin(2 * cycle + 0.6) * amount, 0.10 * sway * amount, 0.05 * np.sin(cycle + 0.5) * amount]
    )
    turn["loin"] = np.array(
        [-0.045 * np.sin(2 * cycle + 0.6) * amount + 0.01 * breath, -0.11 * sway * amount + 0.10 * yaw, 0.0]
    )
    turn["chest"] = np.array([0.012 * breath, -0.07 * sway * amount + 0.12 * yaw, -0.05 * np.sin(cycle + 0.5) * amount])
    nod = 0.05 * np.sin(2 * cycle + 1.0) * amount
    turn["neck"] = np.array([0.35 * pitch + nod, 0.30 * yaw + 0.05 * sway * amount, 0.0])
    turn["neck2"] = np.array([0.30 * pitch - 0.5 * nod, 0.30 * yaw, 0.0])
    turn["head"] = np.array([0.25 * pitch - nod, 0.30 * yaw, 0.10 * yaw])
    for k, side in enumerate(("left", "right")):
        twitch = 0.22 * max(0.0, np.sin(2 * np.pi * (t / 1.7 + 0.37 * k)) - 0.75) * 4
        turn[f"ear_{side}"] = np.array([-0.15 * twitch, 0.5 * twitch * (1 if k else -1), 0.05 * breath])
    for i in range(5):
        wave = np.sin(2 * np.pi * t / (1.5 - 0.3 * walk) - 0.75 * i)
        lift = 0.08 * (1 - walk) * np.sin(2 * np.pi * t / 4.1 + 0.5 * i)
        turn[f"tail{i}"] = np.array([lift, (0.11 + 0.05 * i) * wave * energy * (0.6 + 0.4 * walk), 0.0])

    bob = 0.018 * np.cos(2 * cycle + 0.3) * amount - 0.012 * walk
    pose = np.tile(np.eye(4), (len(body.bones), 1, 1))
    for index, bone in enumerate(body.bones):
        if bone.name in FOOT_PHASE:
            lower, foot = index + 1, index + 2
            parent = pose[bone.parent]
            vectors = _leg(body, index, parent, phase, walk, stride, bob)
            for which, vector in zip((index, lower, foot), vectors, strict=True):
                link = body.bones[which]
                pose[which] = pose[link.parent] @ _about(link.joint, vector)
        elif bone.name.split("_")[0] not in ("forearm", "hand", "shin", "foot"):
            base = _shift(bob) if bone.parent < 0 else pose[bone.parent]
            pose[index] = base @ _about(bone.joint, turn.get(bone.name, np.zeros(3)))
    return pose


def _leg(
    body: Body, index: int, parent: np.ndarray, phase: float, walk: float, stride: float, bob: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation vectors of upper, lower and end bone of one leg that put its foot where the gait wants it.

    Two-bone inverse kinematics in the leg's own plane; the end bone (paw and pastern) keeps an angle of its own.
    """
    upper, lower, end = body.bones[index], body.bones[index + 1], body.bones[index + 2]
    at = (phase + FOOT_PHASE[upper.name]) % 1.0
    fore = upper.name.startswith("arm")
    if at < DUTY:
        forward, height, s = 0.5 - at / DUTY, 0.0, 0.0
    else:
        s = (at - DUTY) / (1 - DUTY)
        forward = -0.5 + (s - np.sin(2 * np.pi * s) / (2 * np.pi))
        height = np.sin(np.pi * s) ** 1.5
    curl = np.sin(np.pi * s) * walk  # the paw folds back while it is in the air
    roll = (0.25 * max(0.0, -forward) if at < DUTY else 0.0) * walk  # heel lifts before the push-off
    target = end.tip + np.array([0.0, 0.13 * height * walk, forward * stride * walk])
    pastern = (0.9 if fore else 0.55) * curl + roll
    ankle_offset = Rotation.from_rotvec([pastern, 0, 0]).apply(end.joint - end.tip)
    goal = np.linalg.inv(parent) @ np.append(target + ankle_offset, 1.0)

    reach = goal[:3] - upper.joint
    rest = end.joint - upper.joint
    abduct = np.arctan2(reach[0], -reach[1]) - np.arctan2(rest[0], -rest[1])
    flat = Rotation.from_rotvec([0, 0, -abduct]).apply(reach)
    a = _length(lower.joint - upper.joint)
    b = _length(end.joint - lower.joint)
    c = float(np.clip(np.hypot(flat[1], flat[2]), abs(a - b) * 1.02, (a + b) * 0.995))
    knee = np.arccos(np.clip((a * a + b * b - c * c) / (2 * a * b), -1, 1))
    rest_c = float(np.hypot(rest[1], rest[2]))
    rest_knee = np.arccos(np.clip((a * a + b * b - rest_c**2) / (2 * a * b), -1, 1))
    at_hip = np.arccos(np.clip((a * a + c * c - b * b) / (2 * a * c), -1, 1))
    rest_hip = np.arccos(np.clip((a * a + rest_c**2 - b * b) / (2 * a * rest_c), -1, 1))
    bend = -1.0 if fore else 1.0  # elbows point back, knees forward
    swing = _angle(flat) - _angle(rest)
    upper_turn = swing - bend * (at_hip - rest_hip)
    lower_turn = -bend * (knee - rest_knee)
    first = (Rotation.from_rotvec([0, 0, abduct]) * Rotation.from_rotvec([upper_turn, 0, 0])).as_rotvec()
    last = pastern - upper_turn - lower_turn  # the paw keeps its angle to the ground
    return first, np.array([lower_turn, 0, 0]), np.array([last, 0, 0])


def _angle(v: np.ndarray) -> float:
    """Angle of a vector in the sagittal plane, growing with rotation about +x (y towards z)."""
    return float(np.arctan2(v[2], v[1]))


def _length(v: np.ndarray) -> float:
    return float(np.hypot(v[1], v[2]))


def _about(joint: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotation by a rotation vector about a point, as 4x4."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    matrix[:3, 3] = joint - matrix[:3, :3] @ joint
    return matrix


def _shift(up: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[1, 3] = up
    return matrix


def place_in_room(heading: float, east: float, north: float, height: float) -> np.ndarray:
    """room_from_object (4, 4): turned by `heading` (radians) about y, moved to (east, height, north)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([0, heading, 0]).as_matrix()
    matrix[:3, 3] = (east, height, north)
    return matrix


def _ease(x: np.ndarray) -> np.ndarray:
    x = np.clip(x * 0.5 + 0.5, 0, 1)
    return x * x * (3 - 2 * x)


def _wander(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    """A smooth random walk that stays within about `size`."""
    raw = rng.normal(0, 1, count + 4)
    return size * np.tanh(np.convolve(raw, [0.25, 0.5, 0.75, 0.5, 0.25], "valid")[:count])


def smooth_in_time(values: np.ndarray, width: int) -> np.ndarray:
    """Weighted mean of (N,) values with their neighbours; `width` (odd) samples in all, constant beyond the ends."""
    kernel = np.hanning(width + 2)[1:-1]
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), "valid")[: len(values)]
