"""How a generated person moves over time: walks, stands, turns, lifts and waves the arms.

Takes the same :class:`synthetic.motion.Performance` as a quadruped and gives the same :class:`synthetic.motion.Motion`.
The lower foot always stands on the floor; the root's speed follows the foot that bears the weight.
"""

from __future__ import annotations

import numpy as np

from synthetic.flesh import Body
from synthetic.motion import Motion, Performance, place_in_room, smooth_in_time
from synthetic.postures import SIDES, Posture, bone_transforms

HANG = 0.55
"""Radians by which arms are let down from their rest pose."""


def perform_person(body: Body, performance: Performance, times_s: np.ndarray) -> Motion:
    """Sample the motion at `times_s` (T,), any times from 0 on."""
    step_s = 0.02
    fine = np.arange(0.0, float(np.max(times_s)) + 2 * step_s, step_s)
    walk = smooth_in_time(np.interp(fine, performance.times_s, performance.walk), 13)
    heading = smooth_in_time(np.interp(fine, performance.times_s, performance.turn), 17)
    yaw = smooth_in_time(np.interp(fine, performance.times_s, performance.look_yaw), 15)
    pitch = smooth_in_time(np.interp(fine, performance.times_s, performance.look_pitch), 15)
    phase = np.cumsum(walk) * step_s / performance.stride_s
    soles = {side: body.weights[:, body.index(f"foot_{side}")] > 0.6 for side, _ in SIDES}
    poses, heights, speeds = [], [], []
    before: dict[str, np.ndarray] = {}
    for i, t in enumerate(fine):
        bones = bone_transforms(body, moment(walk[i], phase[i], yaw[i], pitch[i], float(t), performance.energy))
        posed = body.skin(bones)
        feet = {side: posed[rows] for side, rows in soles.items()}
        bearing = min(feet, key=lambda side: feet[side][:, 1].min())
        place = {side: points.mean(0) for side, points in feet.items()}
        speeds.append((before[bearing] - place[bearing])[2] / step_s if before else 0.0)
        before = place
        poses.append(bones)
        heights.append(-posed[:, 1].min())
    speed = smooth_in_time(np.array(speeds), 9)
    height = smooth_in_time(np.array(heights), 3)
    east, north = np.cumsum(speed * np.sin(heading)) * step_s, np.cumsum(speed * np.cos(heading)) * step_s
    nearest = np.clip(np.round(np.asarray(times_s, float) / step_s).astype(int), 0, len(fine) - 1)
    places = [place_in_room(heading[i], east[i], north[i], height[i]) for i in nearest]
    return Motion(np.stack([poses[i] for i in nearest]), np.stack(places))


def moment(walk: float, phase: float, yaw: float, pitch: float, t: float, energy: float) -> Posture:
    """Joint angles of one moment: `walk` 0 standing to 1 walking, `phase` in strides, looks in radians, `t` seconds."""
    cycle, amount = 2 * np.pi * phase, walk * energy
    sway = np.sin(2 * np.pi * t / 3.1)
    p: Posture = {
        "pelvis": np.array([0.02, 0.10 * np.sin(cycle) * amount, 0.03 * np.cos(cycle) * amount + 0.02 * sway]),
        "spine": np.array([0.03 * amount, -0.12 * np.sin(cycle) * amount + 0.1 * yaw, -0.02 * sway]),
        "chest": np.array([0.02 * amount, -0.10 * np.sin(cycle) * amount + 0.15 * yaw, 0.0]),
        "neck": np.array([0.4 * pitch, 0.3 * yaw, 0.0]),
        "head": np.array([0.5 * pitch, 0.4 * yaw, 0.08 * np.sin(2 * np.pi * t / 2.3)]),
    }
    still = np.clip(1 - walk, 0, 1)
    for side, sign in SIDES:
        turn = cycle if sign > 0 else cycle + np.pi
        lift = max(0.0, np.cos(turn)) ** 1.5
        p[f"thigh_{side}"] = np.array([-0.42 * np.sin(turn) * amount - 0.25 * lift * amount, 0.0, sign * 0.04])
        p[f"shin_{side}"] = np.array([0.85 * lift * amount + 0.06, 0.0, 0.0])
        p[f"foot_{side}"] = np.array([-0.12 * np.sin(turn) * amount - 0.06, 0.0, 0.0])
        raised = still * energy * max(0.0, np.sin(2 * np.pi * (t / 4.4 + (0.0 if sign > 0 else 0.35)))) ** 1.5
        swing = 0.45 * np.sin(turn) * amount
        p[f"arm_{side}"] = np.array([swing - 0.5 * raised, 0.0, sign * (-HANG + 1.9 * raised)])
        wave = raised * (0.5 + 0.4 * np.sin(2 * np.pi * t / 0.8))
        p[f"forearm_{side}"] = np.array([-0.25 - 0.3 * amount * (1 + np.sin(turn)), 0.0, sign * wave])
    return p
