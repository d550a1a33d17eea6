"""Backgrounds to put a generated object on: rooms, clutter, tilings, natural spectra and a few photographs.

The photographs are bundled with scikit-image; those with an animal or a person in them are left out.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from skimage import data, io

from synthetic.rendering import look_at
from synthetic.rooms import draw_room, make_room

PHOTOGRAPHS = (
    "motorcycle_left.png", "motorcycle_right.png", "coins.png", "cell.png", "page.png", "text.png", "moon.png",
    "hubble_deep_field.jpg", "retina.jpg", "color.png", "microaneurysms.png",
)  # fmt: skip


def backgrounds(rng: np.random.Generator, count: int, side_px: int = 128) -> np.ndarray:
    """(count, side, side, 3) uint8 pictures with no animal and no person in them."""
    photos = _photographs(side_px)
    rooms = _rooms(rng, max(1, count // 60), side_px)
    kinds: list[tuple[float, Callable[[], np.ndarray]]] = [
        (0.22, lambda: _spectrum(rng, side_px)),
        (0.20, lambda: _clutter(rng, side_px)),
        (0.16, lambda: _scene(rng, side_px)),
        (0.16, lambda: _photograph(rng, photos, side_px)),
        (0.26, lambda: rooms(rng)),
    ]
    share = np.array([k[0] for k in kinds])
    out = np.zeros((count, side_px, side_px, 3), np.uint8)
    for i in range(count):
        image = kinds[int(rng.choice(len(kinds), p=share / share.sum()))][1]()
        if rng.random() < 0.15:
            image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.7, 4.0)))
        out[i] = np.clip(image * 255, 0, 255).astype(np.uint8)
    return out


def _photographs(side_px: int) -> list[np.ndarray]:
    found = []
    for name in PHOTOGRAPHS:
        path = data.__file__.replace("__init__.py", name)
        image = np.asarray(io.imread(path), np.float32) / 255.0
        image = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image[..., :3]
        if min(image.shape[:2]) >= side_px:
            found.append(image)
    return found


def _photograph(rng: np.random.Generator, photos: list[np.ndarray], side_px: int) -> np.ndarray:
    """A random window of a random photograph, its colours changed, perhaps upside down."""
    image = photos[int(rng.integers(len(photos)))]
    side = int(rng.integers(min(side_px // 2, min(image.shape[:2]) - 1), min(image.shape[:2])))
    y, x = (int(rng.integers(0, image.shape[k] - side + 1)) for k in (0, 1))
    image = np.rot90(image[y : y + side, x : x + side], int(rng.integers(4)))
    image = cv2.resize(np.ascontiguousarray(image), (side_px, side_px), interpolation=cv2.INTER_AREA)
    return np.clip(image[..., rng.permutation(3)] * rng.uniform(0.5, 1.4, 3), 0, 1)


def _rooms(rng: np.random.Generator, count: int, side_px: int) -> Callable[[np.random.Generator], np.ndarray]:
    """Views into `count` furnished rooms, from where a person would film."""
    rooms = [make_room(rng) for _ in range(min(count, 40))]

    def view(rng: np.random.Generator) -> np.ndarray:
        room = rooms[int(rng.integers(len(rooms)))]
        angle = rng.uniform(0, 2 * np.pi)
        eye = np.array([rng.uniform(-4, 4), rng.uniform(0.4, 2.6), rng.uniform(-4, 4)])
        target = eye + np.array([np.sin(angle), rng.normal(-0.3, 0.3), np.cos(angle)])
        focal = side_px * rng.uniform(0.8, 2.2)
        intrinsics = np.array([[focal, 0, side_px / 2], [0, focal, side_px / 2], [0, 0, 1.0]])
        room_from_camera = np.linalg.inv(look_at(eye, target, float(rng.normal(0, 0.1))))
        return np.clip(draw_room(room, room_from_camera, intrinsics, side_px, side_px) * rng.uniform(0.5, 1.15), 0, 1)

    return view


def _colour(rng: np.random.Generator) -> np.ndarray:
    """A colour, more often dull than bright."""
    grey = rng.uniform(0.05, 0.95)
    return np.clip(grey + rng.normal(0, 0.18 if rng.random() < 0.7 else 0.4, 3), 0, 1).astype(np.float32)


def _spectrum(rng: np.random.Generator, side_px: int) -> np.ndarray:
    """Noise with the falling spectrum of natural pictures, in two or three colours."""
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(side_px) * rng.uniform(0.5, 2), np.fft.rfftfreq(side_px), indexing="ij"))
    f[0, 0] = 1.0
    slope = rng.uniform(0.7, 2.2)
    layers = []
    for _ in range(2):
        noise = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(side_px, side_px))) / f**slope, (side_px, side_px))
        layers.append(noise / (noise.std() + 1e-9))
    a, b, c = _colour(rng), _colour(rng), _colour(rng)
    sharp = rng.choice([1.0, 1.0, 6.0])
    u = 1 / (1 + np.exp(-sharp * layers[0]))[..., None]
    v = 1 / (1 + np.exp(-sharp * (layers[1] - 1)))[..., None]
    return ((a + (b - a) * u) * (1 - v) + c * v).astype(np.float32)


def _texture(rng: np.random.Generator, side_px: int) -> np.ndarray:
    """Stripes, checks, bricks or grain."""
    y, x = np.mgrid[0:side_px, 0:side_px].astype(np.float32)
    angle, period = rng.uniform(0, np.pi), rng.uniform(4, 40)
    u, v = (x * np.cos(angle) + y * np.sin(angle)) / period, (y * np.cos(angle) - x * np.sin(angle)) / period
    kind = rng.choice(["plain", "stripes", "checks", "bricks", "grain", "spots"])
    a, b = _colour(rng), _colour(rng)
    if kind == "stripes":
        m = (u % 1 < rng.uniform(0.2, 0.8)).astype(np.float32)
    elif kind == "checks":
        m = ((np.floor(u) + np.floor(v)) % 2).astype(np.float32)
    elif kind == "bricks":
        row = np.floor(v)
        m = (((v % 1) < 0.12) | (((u / 2 + 0.5 * (row % 2)) % 1) < 0.06)).astype(np.float32)
    elif kind == "spots":
        m = (((u % 1 - 0.5) ** 2 + (v % 1 - 0.5) ** 2) < 0.08).astype(np.float32)
    elif kind == "grain":
        small = rng.normal(
            0.5, 0.4, (max(2, side_px // int(rng.integers(1, 9))), max(2, side_px // int(rng.integers(1, 9))))
        )
        m = np.clip(cv2.resize(small.astype(np.float32), (side_px, side_px)), 0, 1)
    else:
        m = np.zeros((side_px, side_px), np.float32)
    image = a + (b - a) * m[..., None] * rng.uniform(0.2, 1.0)
    ramp = 1 + rng.uniform(-0.4, 0.4) * (x / side_px - 0.5) + rng.uniform(-0.4, 0.4) * (y / side_px - 0.5)
    return np.clip(image * ramp[..., None] + rng.normal(0, 0.03, image.shape), 0, 1).astype(np.float32)


def _scene(rng: np.random.Generator, side_px: int) -> np.ndarray:
    """A floor in perspective before a wall, with some things standing about."""
    horizon = int(side_px * rng.uniform(0.1, 0.8))
    wall, floor = _texture(rng, side_px), _texture(rng, side_px)
    image = wall.copy()
    if horizon < side_px - 8:
        pinch = rng.uniform(0.0, 0.4)
        corners = np.array([[0, 0], [side_px, 0], [side_px, side_px], [0, side_px]], np.float32)
        goal = np.array(
            [[pinch * side_px, 0], [(1 - pinch) * side_px, 0], [side_px, side_px], [0, side_px]], np.float32
        )
        warp = cv2.getPerspectiveTransform(corners, goal)
        bent = cv2.warpPerspective(floor, warp, (side_px, side_px), borderMode=cv2.BORDER_REFLECT)
        image[horizon:] = cv2.resize(bent, (side_px, side_px - horizon), interpolation=cv2.INTER_AREA)
    return _things(rng, image, int(rng.integers(0, 5)))


def _clutter(rng: np.random.Generator, side_px: int) -> np.ndarray:
    """Many things over one another."""
    return _things(rng, _texture(rng, side_px), int(rng.integers(4, 16)))


def _things(rng: np.random.Generator, image: np.ndarray, count: int) -> np.ndarray:
    side = image.shape[0]
    for _ in range(count):
        mask = np.zeros((side, side), np.float32)
        centre, size = rng.uniform(0, side, 2), rng.uniform(0.04, 0.35) * side
        kind = rng.choice(["polygon", "ellipse", "bar", "blob"])
        if kind == "ellipse":
            axes = (max(1, int(size)), max(1, int(size * rng.uniform(0.2, 1))))
            cv2.ellipse(mask, (int(centre[0]), int(centre[1])), axes, float(rng.uniform(0, 180)), 0, 360, 1.0, -1)
        elif kind == "bar":  # legs of tables, poles, cables
            way = rng.normal(size=2) * side
            ends = [(int(v[0]), int(v[1])) for v in (centre - way, centre + way)]
            cv2.line(mask, ends[0], ends[1], 1.0, int(rng.integers(1, max(2, side // 14))))
        else:
            corners = int(rng.integers(3, 6)) if kind == "polygon" else 12
            angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
            radius = size * rng.uniform(0.4, 1.0, corners)
            points = centre + np.stack([np.cos(angle), np.sin(angle)], 1) * radius[:, None]
            cv2.fillPoly(mask, [points.astype(np.int32)], 1.0)
        inside = mask[..., None]
        image = image * (1 - inside) + (_texture(rng, side) if rng.random() < 0.6 else _colour(rng)) * inside
    return image.astype(np.float32)
