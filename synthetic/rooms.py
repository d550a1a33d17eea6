"""A room for an animal to stand in: floor, rug, walls with a window and pictures, a few pieces of furniture.

Everything is procedural and drawn once into textures; a view is one ray a pixel against a handful of boxes.
Room space: y up, the floor is y = 0, units as the object's (the animal is 2 long). Colours are sRGB, 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

TEXELS_PER_UNIT = 48
_LEVELS = 5


@dataclass(frozen=True)
class Surface:
    """A rectangle `origin + u * edge_u + v * edge_v`, u and v in 0..1, with a texture pyramid."""

    origin: np.ndarray  # (3,)
    edge_u: np.ndarray  # (3,)
    edge_v: np.ndarray  # (3,)
    pyramid: tuple[np.ndarray, ...]  # (h, w, 3) float32 sRGB, finest first
    floor: bool = False


@dataclass(frozen=True)
class Room:
    """Surfaces, the direction light comes from and how bright it is."""

    surfaces: tuple[Surface, ...]
    light: np.ndarray  # (3,) unit, towards the light
    half: float  # half the length of the floor's sides


def make_room(rng: np.random.Generator, half: float = 6.0, height: float = 3.6) -> Room:
    """Furnish a room of 2 `half` by 2 `half` units."""
    light = np.array([rng.uniform(-0.6, 0.6), rng.uniform(0.75, 1.0), rng.uniform(-0.6, 0.6)])
    light /= np.linalg.norm(light)
    tint = _pastel(rng)
    surfaces = [_surface((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), _floor(rng, half), floor=True)]
    ceiling = np.ones((32, 32, 3)) * np.array([0.88, 0.87, 0.84])
    surfaces.append(_surface((-half, height, -half), (2 * half, 0, 0), (0, 0, 2 * half), ceiling))
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    window = int(rng.integers(4))
    for k in range(4):
        (x0, z0), (x1, z1) = corners[k], corners[(k + 1) % 4]
        wall = _wall(rng, 2 * half, height, tint, k == window)
        surfaces.append(_surface((x0, height, z0), (x1 - x0, 0, z1 - z0), (0, -height, 0), wall))
    for k in range(4):  # one or two pieces of furniture along each wall
        for _ in range(int(rng.integers(1, 3))):
            surfaces += _furniture(rng, k, half)
    return Room(tuple(surfaces), light, half)


def draw_room(room: Room, room_from_camera: np.ndarray, intrinsics: np.ndarray, height_px: int, width_px: int,
              shadow: tuple[np.ndarray, np.ndarray, float] | None = None) -> np.ndarray:  # fmt: skip
    """Picture of the empty room, (H, W, 3) float32 sRGB.

    `shadow` darkens the floor: an image (n, n) of 0..1, the (x, z) of its centre and half its side in room units.
    """
    fx, fy, cx, cy = (float(intrinsics[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    across = ((np.arange(width_px) + 0.5 - cx) / fx).astype(np.float32)[None]
    down = ((np.arange(height_px) + 0.5 - cy) / fy).astype(np.float32)[:, None]
    length = np.sqrt(1 + across**2 + down**2)
    rotation, eye = room_from_camera[:3, :3], room_from_camera[:3, 3]

    def along(direction: np.ndarray) -> np.ndarray:
        """Dot product of every pixel's ray (unit depth) with a direction of the room, (H, W) float32."""
        a, b, c = (float(v) for v in direction @ rotation)
        return a * across + (b * down + c)

    nearest = np.full((height_px, width_px), np.inf, np.float32)
    image = np.zeros((height_px, width_px, 3), np.float32)
    for surface in room.surfaces:
        normal = np.cross(surface.edge_u, surface.edge_v)
        normal = normal / np.linalg.norm(normal)
        facing = along(normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = float((surface.origin - eye) @ normal) / facing
        axis_u = surface.edge_u / float(surface.edge_u @ surface.edge_u)
        axis_v = surface.edge_v / float(surface.edge_v @ surface.edge_v)
        with np.errstate(invalid="ignore", over="ignore"):
            u = depth * along(axis_u) + float((eye - surface.origin) @ axis_u)
            v = depth * along(axis_v) + float((eye - surface.origin) @ axis_v)
            hit = (depth > 1e-3) & (depth < nearest) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        if not hit.any():
            continue
        y0, y1 = np.flatnonzero(hit.any(1))[[0, -1]]
        x0, x1 = np.flatnonzero(hit.any(0))[[0, -1]]
        window = (slice(y0, y1 + 1), slice(x0, x1 + 1))
        seen = hit[window]
        z, u, v = (np.where(seen, value[window], np.float32(0)) for value in (depth, u, v))
        slant = np.sqrt(np.maximum(np.abs(facing[window]) / length[window], np.float32(0.05)))
        colour = _sample(surface, u, v, z / (fx * slant), seen)
        if surface.floor and shadow is not None:
            x = u * float(surface.edge_u[0]) + v * float(surface.edge_v[0]) + float(surface.origin[0])
            y = u * float(surface.edge_u[2]) + v * float(surface.edge_v[2]) + float(surface.origin[2])
            colour = colour * _shadow_factor(x, y, *shadow)
        np.copyto(image[window], colour, where=seen[..., None])
        np.copyto(nearest[window], z, where=seen)
    return image


def cast_shadow(room: Room, vertices_room: np.ndarray, size_px: int = 128) -> tuple[np.ndarray, np.ndarray, float]:
    """Soft shadow of (V, 3) points on the floor, as :func:`draw_room` takes it."""
    foot = vertices_room[:, [0, 2]] - vertices_room[:, 1:2] * (room.light[[0, 2]] / room.light[1])
    centre, half = foot.mean(0), 2.2
    height = np.clip(vertices_room[:, 1], 0, None)
    grid = (foot - centre + half) / (2 * half) * size_px
    cast = _splat(grid, np.ones(len(grid)), size_px)
    grid = (vertices_room[:, [0, 2]] - centre + half) / (2 * half) * size_px
    contact = _splat(grid, np.exp(-height / 0.06), size_px)
    blurred = cv2.GaussianBlur(cv2.dilate(cast, np.ones((3, 3))), (0, 0), 2.0)
    touch = cv2.GaussianBlur(contact, (0, 0), 2.2)
    return np.clip(0.42 * blurred + 0.6 * touch, 0, 0.8).astype(np.float32), centre, half


def _splat(grid: np.ndarray, value: np.ndarray, size_px: int) -> np.ndarray:
    image = np.zeros((size_px, size_px), np.float32)
    cell = np.clip(grid, 0, size_px - 1).astype(int)
    np.maximum.at(image, (cell[:, 1], cell[:, 0]), value.astype(np.float32))
    return image


def _shadow_factor(x: np.ndarray, z: np.ndarray, shadow: np.ndarray, centre: np.ndarray, half: float) -> np.ndarray:
    texel = shadow.shape[0] / (2 * half)
    column = ((x - float(centre[0]) + half) * texel - 0.5).astype(np.float32)
    row = ((z - float(centre[1]) + half) * texel - 0.5).astype(np.float32)
    return 1.0 - cv2.remap(shadow, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[..., None]


def _surface(origin: tuple, edge_u: tuple, edge_v: tuple, texture: np.ndarray, floor: bool = False) -> Surface:
    pyramid = [np.clip(texture, 0, 1).astype(np.float32)]
    while len(pyramid) < _LEVELS and min(pyramid[-1].shape[:2]) > 8:
        pyramid.append(cv2.pyrDown(pyramid[-1]))
    return Surface(np.array(origin, float), np.array(edge_u, float), np.array(edge_v, float), tuple(pyramid), floor)


def _sample(surface: Surface, u: np.ndarray, v: np.ndarray, footprint: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Texture colours at (u, v), from the pyramid level whose texels are about as large as the pixel's footprint."""
    texel = float(np.linalg.norm(surface.edge_u)) / surface.pyramid[0].shape[1]
    top = len(surface.pyramid) - 1
    level = np.clip(np.log2(np.maximum(footprint / texel, 0.5)) + 0.5, 0, top).astype(np.int8)
    out = np.zeros((*u.shape, 3), np.float32)
    for k in np.flatnonzero(np.bincount(level[seen], minlength=top + 1)):
        texture = surface.pyramid[k]
        chosen = level == k
        rows = np.flatnonzero(chosen.any(1))
        part = slice(rows[0], rows[-1] + 1)
        x, y = u[part] * texture.shape[1] - 0.5, v[part] * texture.shape[0] - 0.5
        colour = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        np.copyto(out[part], colour, where=chosen[part][..., None])
    return out


# --------------------------------------------------------------------------------------------- textures


def _pastel(rng: np.random.Generator) -> np.ndarray:
    hue = rng.uniform(0, 1)
    wheel = 0.5 + 0.5 * np.cos(2 * np.pi * (hue + np.array([0.0, 0.33, 0.67])))
    return (0.62 + 0.2 * rng.random()) * (0.82 + 0.18 * wheel)


def _grain(rng: np.random.Generator, height: int, width: int, cell: int, stretch: int = 1) -> np.ndarray:
    """Smooth random image of about -1..1 with features of `cell` texels (`stretch` times longer sideways)."""
    coarse = rng.normal(0, 1, (max(2, height // cell), max(2, width // (cell * stretch)))).astype(np.float32)
    return np.clip(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), -2, 2) / 1.5


def _floor(rng: np.random.Generator, half: float) -> np.ndarray:
    n = int(2 * half * TEXELS_PER_UNIT)
    kind = rng.choice(["planks", "tiles", "carpet"])
    if kind == "planks":
        wood = np.array([(0.55, 0.38, 0.24), (0.68, 0.53, 0.37), (0.42, 0.28, 0.18)][int(rng.integers(3))])
        plank = TEXELS_PER_UNIT // 3
        tone = np.zeros((n, n), np.float32)
        seams = np.zeros((n, n), np.float32)
        for y in range(0, n, plank):
            x = -int(rng.integers(0, 3 * TEXELS_PER_UNIT))
            while x < n:
                length = int(rng.integers(2, 5) * TEXELS_PER_UNIT * 0.8)
                tone[y : y + plank, max(0, x) : x + length] = rng.normal(0, 0.09)
                seams[y : y + plank, max(0, x) : max(0, x) + 1] = 1
                x += length
            seams[y : y + 1] = 1
        image = wood * (1 + tone + 0.10 * _grain(rng, n, n, 3, 14) + 0.05 * _grain(rng, n, n, 40))[..., None]
        image *= (1 - 0.45 * seams)[..., None]
    elif kind == "tiles":
        side = int(TEXELS_PER_UNIT * rng.uniform(0.6, 1.1))
        a, b = _pastel(rng) * 0.9, _pastel(rng) * 0.6
        index = np.arange(n) // side
        checks = ((index[:, None] + index[None]) % 2)[..., None]
        image = a + (b - a) * checks
        grout = ((np.arange(n) % side < 2)[:, None] | (np.arange(n) % side < 2)[None])[..., None]
        image = np.where(grout, 0.45, image * (1 + 0.10 * _grain(rng, n, n, 9)[..., None]))
    else:
        image = _pastel(rng) * 0.75 * (1 + 0.16 * _grain(rng, n, n, 2) + 0.10 * _grain(rng, n, n, 30))[..., None]
    return _rug(rng, image) * _pool(n, n, rng, 0.25)


def _rug(rng: np.random.Generator, floor: np.ndarray) -> np.ndarray:
    n = len(floor)
    unit = TEXELS_PER_UNIT
    h, w = int(unit * rng.uniform(2.5, 5.5)), int(unit * rng.uniform(3.0, 6.0))
    y, x = (n - h) // 2 + int(rng.normal(0, unit)), (n - w) // 2 + int(rng.normal(0, unit))
    colours = [_pastel(rng) * rng.uniform(0.35, 0.9) for _ in range(3)]
    rows, columns = np.mgrid[0:h, 0:w].astype(np.float32)
    period = unit * rng.uniform(0.5, 1.0)
    wave = np.sin(2 * np.pi * rows / period) * np.sin(2 * np.pi * columns / period)
    diamond = np.abs((rows / period) % 1 - 0.5) + np.abs((columns / period) % 1 - 0.5) < 0.28
    rug = np.where(diamond[..., None], colours[1], np.where((wave > 0.2)[..., None], colours[2], colours[0]))
    edge = np.minimum(np.minimum(rows, h - 1 - rows), np.minimum(columns, w - 1 - columns))
    rug = np.where(((edge > unit * 0.15) & (edge < unit * 0.3))[..., None], colours[2], rug)
    rug = rug * (1 + 0.12 * _grain(rng, h, w, 2))[..., None]
    out = floor.copy()
    out[y : y + h, x : x + w] = rug
    return out


def _wall(rng: np.random.Generator, width: float, height: float, tint: np.ndarray, window: bool) -> np.ndarray:
    w, h = int(width * TEXELS_PER_UNIT), int(height * TEXELS_PER_UNIT)
    image = np.ones((h, w, 3)) * tint * rng.uniform(0.9, 1.05)
    kind = rng.choice(["plain", "stripes", "motif"])
    columns = np.arange(w)
    if kind == "stripes":
        period = int(TEXELS_PER_UNIT * rng.uniform(0.25, 0.6))
        image *= np.where((columns // period) % 2, 0.86, 1.0)[None, :, None]
    elif kind == "motif":
        period = int(TEXELS_PER_UNIT * rng.uniform(0.35, 0.6))
        rows = np.arange(h)
        shift = (rows[:, None] // period) % 2 * period // 2  # every other row half a step aside
        dy, dx = rows[:, None] % period - period / 2, (columns[None] + shift) % period - period / 2
        dots = dy**2 + dx**2 < (period * 0.22) ** 2
        image = np.where(dots[..., None], image * _pastel(rng), image)
    image *= (1 + 0.03 * _grain(rng, h, w, 3) + 0.05 * _grain(rng, h, w, 60))[..., None]
    image[h - int(0.2 * TEXELS_PER_UNIT) :] = np.array([0.85, 0.84, 0.8])  # skirting board
    image[h - int(0.2 * TEXELS_PER_UNIT) - 2 : h - int(0.2 * TEXELS_PER_UNIT)] *= 0.6
    for slot in range(3):
        x = int((slot + 0.5 + rng.uniform(-0.2, 0.2)) * w / 3)
        if window and slot == 1:
            _paint_window(rng, image, x, h)
        elif rng.random() < 0.75:
            _paint_picture(rng, image, x, h)
    return image * _pool(h, w, rng, 0.2)


def _paint_window(rng: np.random.Generator, image: np.ndarray, x: int, h: int) -> None:
    unit = TEXELS_PER_UNIT
    y0, y1, half = int(h * 0.12), int(h * 0.68), int(unit * 1.1)
    sky = np.linspace(1.0, 0.85, y1 - y0)[:, None, None] * np.array([0.86, 0.94, 1.0])
    view = np.broadcast_to(sky, (y1 - y0, 2 * half, 3)).copy()
    hill = (y1 - y0) * (0.65 + 0.12 * _grain(rng, 1, 2 * half, unit)[0])
    view[np.arange(y1 - y0)[:, None] > hill[None]] = np.array([0.45, 0.6, 0.38])
    image[y0 - 4 : y1 + 4, x - half - 4 : x + half + 4] = 0.93
    image[y0:y1, x - half : x + half] = view
    image[(y0 + y1) // 2 - 2 : (y0 + y1) // 2 + 2, x - half : x + half] = 0.93
    image[y0:y1, x - 2 : x + 2] = 0.93


def _paint_picture(rng: np.random.Generator, image: np.ndarray, x: int, h: int) -> None:
    unit = TEXELS_PER_UNIT
    hh, ww = int(unit * rng.uniform(0.3, 0.6)), int(unit * rng.uniform(0.3, 0.7))
    y = int(h * rng.uniform(0.3, 0.48))
    frame = np.array([(0.25, 0.17, 0.1), (0.1, 0.1, 0.1), (0.75, 0.6, 0.3)][int(rng.integers(3))])
    image[y - hh - 3 : y + hh + 3, x - ww - 3 : x + ww + 3] = frame
    art = np.ones((2 * hh, 2 * ww, 3)) * _pastel(rng)
    for _ in range(5):
        mask = _grain(rng, 2 * hh, 2 * ww, max(4, hh // 2)) > 0.25
        art[mask] = _pastel(rng) * rng.uniform(0.3, 1.1)
    image[y - hh : y + hh, x - ww : x + ww] = art


def _pool(h: int, w: int, rng: np.random.Generator, depth: float) -> np.ndarray:
    """A broad pool of light: 1 at its middle, 1 - `depth` far from it."""
    cy, cx = rng.uniform(0.3, 0.7, 2)
    y, x = np.linspace(0, 1, h)[:, None] - cy, np.linspace(0, 1, w)[None] - cx
    return (1 - depth * np.clip(2.2 * (x * x + y * y), 0, 1))[..., None]


def _furniture(rng: np.random.Generator, wall: int, half: float) -> list[Surface]:
    """A box against one wall: cabinet, sofa or shelf; five painted sides."""
    w, d, h = rng.uniform(1.0, 2.8), rng.uniform(0.6, 1.1), rng.uniform(0.7, 2.4)
    along = rng.uniform(-half + w, half - w)
    x0, z0, x1, z1 = along - w / 2, -half, along + w / 2, -half + d
    tone = _pastel(rng) * rng.uniform(0.3, 0.9)
    boxes = []
    sides = [
        ((x0, h, z1), (x1 - x0, 0, 0), (0, -h, 0), 1.0),
        ((x0, h, z0), (0, 0, d), (0, -h, 0), 0.8),
        ((x1, h, z1), (0, 0, -d), (0, -h, 0), 0.75),
        ((x0, h, z0), (x1 - x0, 0, 0), (0, 0, d), 1.12),
    ]
    angle = wall * np.pi / 2
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    for origin, edge_u, edge_v, brightness in sides:
        u, v = np.linalg.norm(edge_u), np.linalg.norm(edge_v)
        th, tw = max(16, int(v * 32)), max(16, int(u * 32))
        texture = np.ones((th, tw, 3)) * tone * brightness * (1 + 0.08 * _grain(rng, th, tw, 3, 3))[..., None]
        for k in range(1, 4):  # drawers or cushions
            texture[min(th - 1, k * th // 4)] *= 0.55
        texture[:, [0, tw - 1, tw // 2]] *= 0.6
        boxes.append(_surface(tuple(turn @ origin), tuple(turn @ edge_u), tuple(turn @ edge_v), texture))
    return boxes
