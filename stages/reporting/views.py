"""From where a collection was filmed, and what that says in plain words.

Directions are those of the camera as seen from the object: azimuth 0 is in front of it (+z), 90 degrees at its left
(+x), 180 behind it; elevation is above its horizon (y up).
"""

from __future__ import annotations

import numpy as np

SIDES = ("front", "front left", "left", "back left", "back", "back right", "right", "front right")
_WIDE_GAP_DEG = 100.0
_UNSEEN_SIDE = 0.5


def camera_directions(object_to_camera: np.ndarray) -> np.ndarray:
    """Azimuth and elevation (T, 2), degrees, of the cameras of object_to_camera (T, 4, 4)."""
    rotation, shift = object_to_camera[:, :3, :3], object_to_camera[:, :3, 3]
    place = -(np.swapaxes(rotation, 1, 2) @ shift[..., None])[..., 0]
    place /= np.maximum(np.linalg.norm(place, axis=1, keepdims=True), 1e-9)
    azimuth = np.degrees(np.arctan2(place[:, 0], place[:, 2])) % 360.0
    return np.stack([azimuth, np.degrees(np.arcsin(np.clip(place[:, 1], -1, 1)))], axis=1)


def widest_gap(azimuth_deg: np.ndarray) -> tuple[float, float]:
    """Width and middle, degrees, of the widest range of azimuths (N,) that holds none of them."""
    if not len(azimuth_deg):
        return 360.0, 0.0
    ordered = np.sort(azimuth_deg % 360.0)
    gaps = np.diff(np.append(ordered, ordered[0] + 360.0))
    k = int(gaps.argmax())
    return float(gaps[k]), float((ordered[k] + gaps[k] / 2) % 360.0)


def side_name(azimuth_deg: float) -> str:
    """The nearest of eight sides."""
    return SIDES[int(np.round(azimuth_deg / 45.0)) % 8]


def unseen_by_side(normals: np.ndarray, area: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Share of the area of each side that no frame saw: of vertices with normals (V, 3), areas (V,), seen (V,) bool.

    Sides are front, back, left, right, top and underside by the normal's largest component.
    """
    names = (("left", "right"), ("top", "underside"), ("front", "back"))
    axis = np.abs(normals).argmax(axis=1)
    found = {}
    for k, (plus, minus) in enumerate(names):
        for name, sign in ((plus, 1), (minus, -1)):
            here = (axis == k) & (np.sign(normals[:, k]) == sign)
            total = float(area[here].sum())
            if total > 0:
                found[name] = float(area[here & ~seen].sum()) / total
    return found


def vertex_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) a third of the area of the triangles (F, 3) around each vertex (V, 3)."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    result = np.zeros(len(vertices))
    for k in range(3):
        np.add.at(result, faces[:, k], area / 3)
    return result


def view_advice(azimuth_deg: np.ndarray, unseen: dict[str, float]) -> list[str]:
    """Sentences about what to film next."""
    advice = []
    width, middle = widest_gap(azimuth_deg)
    if width > _WIDE_GAP_DEG:
        advice.append(
            f"Nothing was filmed from the {side_name(middle)}: {width:.0f}° of the way round are empty. "
            "A clip from there would show what is now made up."
        )
    for name, share in unseen.items():
        if share > _UNSEEN_SIDE:
            where = "from below" if name == "underside" else "from above" if name == "top" else f"from the {name}"
            advice.append(f"{100 * share:.0f} % of the {name} was never seen: add a clip {where}.")
    return advice


def clip_advice(name: str, iou: list[float], mask_confidence: list[float], flags: list[list[str]]) -> list[str]:
    """Sentences about one clip, from figures of its kept frames."""
    advice: list[str] = []
    count = len(iou)
    if not count:
        return advice
    missing = sum("missing" in f for f in flags)
    border = sum("border" in f for f in flags)
    poor = sum(c < 0.5 for c in mask_confidence)
    apart = sum(v < 0.7 for v in iou)
    if missing > 0.1 * count:
        advice.append(f"{name}: the subject was not found in {_share(missing, count)} of the frames.")
    if border > 0.3 * count:
        advice.append(f"{name}: the subject is cut off by the picture's edge in {_share(border, count)} of the frames.")
    if poor > 0.2 * count:
        advice.append(
            f"{name}: {_share(poor, count)} of the frames have poor masks; see the strip of masks below, and give a "
            "box or a few clicks in a hints file."
        )
    if apart > 0.2 * count:
        advice.append(f"{name}: in {_share(apart, count)} of the frames the model does not lie on the subject.")
    return advice


def _share(part: int, count: int) -> str:
    return f"{100 * part / count:.0f} %"
