"""A bank of geometry: many bodies in many postures seen from many sides, as buffers that can be dressed anew each time.

A rendered picture holds, for every pixel, the canonical vertex it shows, the part of the body it belongs to and the
surface normal. Colour, light, background and camera faults are put on later, differently at every use, so that a few
ten thousand renderings are worth millions of pictures. The object fills the picture (largest side of its box times
``BOX_MARGIN``); the camera looks at the middle of the box, so the rotation is the one seen along the ray to it.

Views are OpenCV's: ``R = Rz(roll) Rx(elevation) diag(1, -1, -1) Ry(azimuth)`` takes object to camera axes. Azimuth 0
faces the camera, +90 degrees looks to the image's right; a positive elevation is seen from above; a positive roll turns
the picture clockwise.

``python -m synthetic.bank OUT_DIR --category human --bodies 200 --views 100 --seed 0``
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from stages.geometry.raster import rasterise, vertex_normals
from synthetic.bodies import quadruped, vary_quadruped
from synthetic.canonical import Carrier, canonical_body
from synthetic.flesh import Body
from synthetic.people import person, vary_person
from synthetic.postures import Posture, bone_transforms, person_posture, quadruped_posture
from synthetic.things import place_labels, thing, thing_parts

log = logging.getLogger(__name__)

SIDE_PX = 96
BOX_MARGIN = 1.08
NOTHING = 65535
"""Canonical vertex of a pixel that shows no object."""
FRONT = np.diag([1.0, -1.0, -1.0])
QUADRUPED_PARTS = (
    "torso", "belly", "neck", "head", "muzzle", "ear", "ear_inside", "upper_leg", "lower_leg", "paw", "tail",
    "tail_tip", "rump", "eye", "nose", "mane",
)  # fmt: skip
HUMAN_PARTS = (
    "face", "hair", "neck", "top", "top_front", "top_back", "pelvis", "sleeve", "forearm", "hand", "thigh", "shin",
    "shoe", "eye", "mouth", "brow",
)  # fmt: skip
PARTS = {"quadruped": QUADRUPED_PARTS, "human": HUMAN_PARTS, "thing": tuple(f"piece_{k}" for k in range(8))}


_POSTURES: dict[str, Callable[[np.random.Generator], Posture]] = {
    "quadruped": quadruped_posture,
    "human": person_posture,
    "thing": lambda _: {},
}


@dataclass(frozen=True)
class Shard:
    """N renderings of one category, S x S pixels."""

    vertex: np.ndarray  # (N, S, S) uint16 canonical vertex, NOTHING off the object
    part: np.ndarray  # (N, S, S) uint8 index into PARTS[category]
    normal: np.ndarray  # (N, S, S, 3) int8, camera frame, 127 = 1
    rotation: np.ndarray  # (N, 3, 3) float32 camera_from_object
    view: np.ndarray  # (N, 3) float32 azimuth, elevation, roll in radians

    def save(self, path: Path) -> None:
        """Write as an uncompressed .npz."""
        with path.open("wb") as file:
            np.savez(file, **vars(self))

    @classmethod
    def load(cls, path: Path) -> Shard:
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            return cls(**{name: file[name] for name in file.files})


def view_rotation(azimuth: float, elevation: float, roll: float) -> np.ndarray:
    """camera_from_object (3, 3) of a view; angles in radians, as the module's text says."""
    turns = Rotation.from_euler("z", roll) * Rotation.from_euler("x", elevation)
    return turns.as_matrix() @ FRONT @ Rotation.from_euler("y", azimuth).as_matrix()


def random_view(rng: np.random.Generator, category: str) -> tuple[float, float, float]:
    """Azimuth (any), elevation and roll (as people hold cameras), radians."""
    if category == "human":
        elevation = rng.normal(12, 12) if rng.random() < 0.85 else rng.uniform(-25, 65)
    else:
        elevation = rng.normal(16, 13) if rng.random() < 0.8 else rng.uniform(-15, 75)
    roll = rng.normal(0, 7) if rng.random() < 0.9 else rng.uniform(-35, 35)
    return float(rng.uniform(-np.pi, np.pi)), float(np.deg2rad(elevation)), float(np.deg2rad(roll))


def random_body(rng: np.random.Generator, category: str) -> Body:
    """A body of the category with its proportions drawn anew."""
    if category == "thing":
        return thing(rng)
    return person(vary_person(rng), 72) if category == "human" else quadruped(vary_quadruped(rng), 84)


def vertex_parts(body: Body, category: str, rng: np.random.Generator) -> np.ndarray:
    """(V,) uint8 part of every vertex; hair lines, collars and the like vary with `rng`."""
    if category == "thing":
        return thing_parts(body, rng)
    return _person_parts(body, rng) if category == "human" else _quadruped_parts(body, rng)


def render_views(
    body: Body, category: str, labels: np.ndarray, views: int, rng: np.random.Generator, side_px: int = SIDE_PX
) -> Shard:
    """Pictures of one body in `views` postures from `views` sides; `labels` (V,) canonical vertex of each vertex."""
    shape = (views, side_px, side_px)
    shard = Shard(
        np.full(shape, NOTHING, np.uint16), np.zeros(shape, np.uint8), np.zeros((*shape, 3), np.int8),
        np.zeros((views, 3, 3), np.float32), np.zeros((views, 3), np.float32),
    )  # fmt: skip
    parts = vertex_parts(body, category, rng)
    for k in range(views):
        posed = body.skin(bone_transforms(body, _POSTURES[category](rng)))
        posed = posed - (posed.min(0) + posed.max(0)) / 2
        azimuth, elevation, roll = random_view(rng, category)
        rotation = view_rotation(azimuth, elevation, roll)
        seen = posed @ rotation.T + np.array([0, 0, np.exp(rng.uniform(np.log(2.2), np.log(8.0)))])
        flat = seen[:, :2] / seen[:, 2:]
        low, high = flat.min(0), flat.max(0)
        focal = side_px / (float((high - low).max()) * BOX_MARGIN)
        centre = side_px / 2 - focal * (low + high) / 2
        intrinsics = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
        fragments = rasterise(seen, body.faces, intrinsics, side_px, side_px)
        pixels = fragments.pixels()
        weight = fragments.barycentric.reshape(-1, 3)[pixels]
        corners = body.faces[fragments.face_idx.reshape(-1)[pixels]]
        nearest = corners[np.arange(len(pixels)), weight.argmax(1)]
        normal = fragments.at_pixels(pixels, body.faces, vertex_normals(seen, body.faces))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        part = parts[nearest].copy()
        _paint_marks(part, fragments.at_pixels(pixels, body.faces, body.vertices), body, PARTS[category])
        shard.vertex[k].reshape(-1)[pixels] = labels[nearest]
        shard.part[k].reshape(-1)[pixels] = part
        shard.normal[k].reshape(-1, 3)[pixels] = np.round(normal * 127)
        shard.rotation[k], shard.view[k] = rotation, (azimuth, elevation, roll)
    return shard


def _paint_marks(part: np.ndarray, rest: np.ndarray, body: Body, names: tuple[str, ...]) -> None:
    """Eyes, nose and the like, a pixel at a time (in place): where the rest position lies in a mark's ball."""
    for name, (centre, radius) in body.marks.items():
        kind = name.split("_")[0]
        if kind not in names:
            continue
        offset = rest - centre
        if kind in ("mouth", "brow"):
            offset = offset * np.array([1.0, 2.6, 1.0])  # wider than high
        part[(offset**2).sum(1) < radius**2] = names.index(kind)


def _of(body: Body, *starts: str) -> np.ndarray:
    """(V,) bool: the heaviest bone's name starts with one of these."""
    heaviest = body.weights.argmax(1)
    return np.array([b.name.startswith(starts) for b in body.bones])[heaviest]


def _quadruped_parts(body: Body, rng: np.random.Generator) -> np.ndarray:
    names, x = QUADRUPED_PARTS, body.vertices
    normal = vertex_normals(x, body.faces)
    part = np.zeros(len(x), np.uint8)

    def put(name: str, where: np.ndarray) -> None:
        part[where] = names.index(name)

    torso = _of(body, "pelvis", "loin", "chest")
    put("belly", torso & (normal[:, 1] < rng.uniform(-0.7, -0.1)))
    put("rump", _of(body, "pelvis") & (normal[:, 1] > -0.2))
    neck = _of(body, "neck")
    put("neck", neck)
    put("mane", (neck | (torso & (x[:, 2] > 0))) & (normal[:, 1] > rng.uniform(0.5, 0.9)) & (np.abs(x[:, 0]) < 0.06))
    head = body.bones[body.index("head")]
    on_head = _of(body, "head")
    along = head.tip - head.joint
    ahead = (x - head.joint) @ along / float(along @ along)
    put("head", on_head)
    put("muzzle", on_head & (ahead > rng.uniform(0.5, 0.75)))
    for side in ("left", "right"):
        ear = _of(body, f"ear_{side}")
        put("ear", ear)
        put("ear_inside", ear & (normal[:, 2] > 0.35))
    put("upper_leg", _of(body, "arm", "thigh"))
    put("lower_leg", _of(body, "forearm", "shin"))
    put("paw", _of(body, "hand", "foot"))
    put("tail", _of(body, "tail"))
    put("tail_tip", _of(body, "tail4", *(["tail3"] if rng.random() < 0.5 else [])))
    return part


def _person_parts(body: Body, rng: np.random.Generator) -> np.ndarray:
    names, x = HUMAN_PARTS, body.vertices
    normal = vertex_normals(x, body.faces)
    part = np.zeros(len(x), np.uint8)

    def put(name: str, where: np.ndarray) -> None:
        part[where] = names.index(name)

    centre, radius = body.marks["skull"]
    d = (x - centre) / radius
    head = _of(body, "head", "neck") & (d[:, 1] > -1.15)
    put("neck", _of(body, "neck") & ~head)
    hairline, temple = rng.uniform(0.35, 0.8), rng.uniform(-0.2, 0.35)
    hair = _of(body, "head") & ((d[:, 1] > hairline - 0.35 * np.clip(-d[:, 2], 0, 1)) | (d[:, 2] < temple))
    hanging = (d[:, 2] < 0.1) & _of(body, "head", "neck") & (d[:, 1] < -0.5)
    put("face", head)
    if rng.random() < 0.94:
        put("hair", hair | hanging)
    torso = _of(body, "spine", "chest", "clavicle")
    put("top", torso)
    scale = float(np.abs(x[:, 1]).max())
    put("top_front", torso & (normal[:, 2] > 0.3) & (np.abs(x[:, 0]) < scale * rng.uniform(0.03, 0.14)))
    put("top_back", torso & (normal[:, 2] < -0.3) & (np.abs(x[:, 0]) < scale * rng.uniform(0.08, 0.2)))
    chest_top = body.bones[body.index("chest")].tip[1]
    if rng.random() < 0.6:  # a neckline: bare skin below the chin
        depth = scale * rng.uniform(0.02, 0.14)
        put("neck", torso & (normal[:, 2] > 0) & (x[:, 1] > chest_top - depth + np.abs(x[:, 0])))
    put("pelvis", _of(body, "pelvis"))
    put("sleeve", _of(body, "arm"))
    put("forearm", _of(body, "forearm"))
    put("hand", _of(body, "hand"))
    put("thigh", _of(body, "thigh"))
    put("shin", _of(body, "shin"))
    put("shoe", _of(body, "foot"))
    return part


def main(
    out: Annotated[Path, tyro.conf.Positional],
    category: str = "quadruped",
    bodies: int = 200,
    views: int = 100,
    seed: int = 0,
    first: int = 0,
    side_px: int = SIDE_PX,
) -> None:
    """Render a bank; one file a body.

    Args:
        out: Folder to write to; made if missing.
        category: quadruped, human or thing.
        bodies: How many bodies.
        views: Pictures a body.
        seed: Another seed, another bank.
        first: Number of the first body, to go on with a bank begun before.
        side_px: Side of a picture; networks of poses take the default, the one that refines masks twice that.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    out.mkdir(parents=True, exist_ok=True)
    label = place_labels if category == "thing" else Carrier.of(canonical_body(category)).labels
    begun = time.perf_counter()
    for k in range(first, first + bodies):
        rng = np.random.default_rng([seed, len(category), k])
        part = out / f".{category}-{k:04d}.part"
        body = random_body(rng, category)
        render_views(body, category, label(body), views, rng, side_px).save(part)
        part.rename(out / f"{category}-{k:04d}.npz")
    spent = time.perf_counter() - begun
    log.info("%d pictures in %.0f s, %.0f a second", bodies * views, spent, bodies * views / spent)


if __name__ == "__main__":
    tyro.cli(main)
