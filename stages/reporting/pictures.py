"""Small pictures for the report, as data URIs: strips of masks, flow, embedding and root poses."""

from __future__ import annotations

import base64

import cv2
import numpy as np

STRIP_FRAMES = 8
STRIP_SIDE_PX = 112


def spread(count: int, most: int = STRIP_FRAMES) -> np.ndarray:
    """Up to `most` indices, evenly over `count`, ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def fitted(image: np.ndarray, side_px: int = STRIP_SIDE_PX) -> np.ndarray:
    """A picture (H, W, 3) uint8 with its shorter side made `side_px`, cut to a square about its middle."""
    scale = side_px / min(image.shape[:2])
    size = (max(side_px, round(image.shape[1] * scale)), max(side_px, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    top, left = (small.shape[0] - side_px) // 2, (small.shape[1] - side_px) // 2
    return np.asarray(small[top : top + side_px, left : left + side_px])


def strip(images: list[np.ndarray]) -> np.ndarray:
    """Pictures side by side, squares with a hair of white between them."""
    gap = np.full((STRIP_SIDE_PX, 3, 3), 255, np.uint8)
    parts: list[np.ndarray] = []
    for image in images:
        parts += [gap, fitted(image)] if parts else [fitted(image)]
    return np.concatenate(parts, axis=1)


def jpeg_uri(image: np.ndarray, quality: int = 80) -> str:
    """(H, W, 3) uint8 RGB as a data URI."""
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode a picture of shape {image.shape}")
    return uri("image/jpeg", bytes(data))


def uri(kind: str, data: bytes) -> str:
    """Bytes as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def crop_to(image: np.ndarray, boxes: np.ndarray, index: int, margin: float = 1.35) -> np.ndarray:
    """The square of an image around the object's box (x0, y0, x1, y1), padded at the picture's edges."""
    x0, y0, x1, y1 = boxes[index]
    side = max(8.0, margin * max(x1 - x0, y1 - y0))
    if not np.isfinite(side) or x1 <= x0 or y1 <= y0:
        return image
    left, top, size = round((x0 + x1 - side) / 2), round((y0 + y1 - side) / 2), round(side)
    padded = cv2.copyMakeBorder(image, size, size, size, size, cv2.BORDER_REPLICATE)
    return np.asarray(padded[top + size : top + 2 * size, left + size : left + 2 * size])
