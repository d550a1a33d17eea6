"""Videos and image folders as upright RGB frames with time stamps, through PyAV and Pillow.

Everything that reads pixels of a user's file goes through here: rotation metadata and non-square pixels are
applied, times are the stream's own (variable frame rate), and a damaged file ends in one sentence (`BadInput`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from PIL import ExifTags, Image, ImageOps

from pipeline import BadInput

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
FULL_FRAME_MM = 36.0  # width of the 35 mm film that "35 mm equivalent" focal lengths speak of


@dataclass(frozen=True)
class Frame:
    """One source frame, upright, with square pixels."""

    source_idx: int
    time_s: float  # from the first frame of the clip
    image: np.ndarray  # (H, W, 3) uint8 sRGB
    rotation_deg: int  # clockwise, already applied


def natural_key(name: str) -> tuple[object, ...]:
    """Sort key that puts ``frame2`` before ``frame10``."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part)


def list_images(folder: Path) -> list[Path]:
    """Image files directly in a folder, in natural order of their names; hidden files are left out."""
    try:
        entries = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    except OSError as error:
        raise BadInput(f"{folder.name} cannot be listed ({error.strerror})") from error
    return sorted(entries, key=lambda p: natural_key(p.name))


def read_frames(path: Path, *, folder_fps: float = 10.0, accept_damaged: bool = False) -> Iterator[Frame]:
    """Every frame of a video file or a folder of images, in order of presentation.

    `folder_fps` gives the times of a folder's images. Raises `BadInput` when there is no video stream, when nothing
    can be decoded, and, unless `accept_damaged`, when the file breaks off before its stated end.
    """
    if path.is_dir():
        yield from _folder_frames(path, folder_fps)
    else:
        yield from _video_frames(path, accept_damaged)


# --------------------------------------------------------------------------------------------- folders


def load_image(path: Path) -> np.ndarray:
    """One image file, upright (EXIF), (H, W, 3) uint8 sRGB; transparency is shown on black."""
    try:
        with Image.open(path) as opened:
            image = ImageOps.exif_transpose(opened)
            if image.mode.startswith(("I", "F")):  # 16-bit and float grey
                values = np.asarray(image, np.float64)
                top = 65535.0 if values.max() > 255 else 255.0
                grey = np.clip(values / top * 255.0, 0, 255).astype(np.uint8)
                return np.repeat(grey[..., None], 3, axis=2)
            if "A" in image.getbands() or "transparency" in image.info:
                rgba = image.convert("RGBA")
                image = Image.alpha_composite(Image.new("RGBA", rgba.size, (0, 0, 0, 255)), rgba)
            return np.asarray(image.convert("RGB"), np.uint8).copy()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise BadInput(f"{path.name} cannot be read as an image", hint=str(error)) from error


def _folder_frames(folder: Path, fps: float) -> Iterator[Frame]:
    paths = list_images(folder)
    if not paths:
        raise BadInput(f"the folder {folder.name} holds no images")
    size: tuple[int, ...] | None = None
    for idx, path in enumerate(paths):
        image = load_image(path)
        size = size or image.shape
        if image.shape != size:
            raise BadInput(
                f"{folder.name}/{path.name} is {image.shape[1]}x{image.shape[0]}, the images before it "
                f"{size[1]}x{size[0]}: a folder of images must have one size",
            )
        yield Frame(idx, idx / fps, image, 0)


# --------------------------------------------------------------------------------------------- videos


def _open(path: Path) -> av.container.InputContainer:
    try:
        # "file:" keeps names such as "a:b.mp4" or "-x.mp4" from being read as protocols or options.
        return av.open(f"file:{path.absolute()}", metadata_errors="ignore", options={"protocol_whitelist": "file"})
    except PermissionError as error:
        raise BadInput(f"{path.name} may not be read (permission denied)") from error
    except (av.FFmpegError, OSError, ValueError) as error:
        raise BadInput(
            f"{path.name} is not a video that can be opened, or it is truncated", hint=_reason(error)
        ) from error


def _reason(error: BaseException) -> str:
    return str(getattr(error, "strerror", None) or error)


def _rotation_deg(frame: av.VideoFrame) -> int:
    """Clockwise rotation that puts the decoded picture upright, a multiple of 90 degrees."""
    return round(-float(frame.rotation) / 90.0) * 90 % 360


def _upright(frame: av.VideoFrame, aspect: float) -> tuple[np.ndarray, int]:
    image: np.ndarray = frame.to_ndarray(format="rgb24")
    if abs(aspect - 1.0) > 0.01:  # non-square pixels: widen or narrow, never throw rows away
        width = max(1, round(image.shape[1] * aspect))
        image = cv2.resize(image, (width, image.shape[0]), interpolation=cv2.INTER_AREA)
    turn = _rotation_deg(frame)
    return np.ascontiguousarray(np.rot90(image, -turn // 90)) if turn else image, turn


def _video_frames(path: Path, accept_damaged: bool) -> Iterator[Frame]:
    with _open(path) as container:
        if not container.streams.video:
            raise BadInput(f"{path.name} has no video stream")
        stream = container.streams.video[0]
        stream.thread_type = "SLICE"  # several clips are decoded side by side: one thread each is enough
        aspect = float(stream.sample_aspect_ratio or 1) or 1.0
        rate = float(stream.average_rate or stream.guessed_rate or 0) or 25.0
        first: float | None = None
        last, count = 0.0, 0
        shape: tuple[int, ...] | None = None
        try:
            for decoded in container.decode(stream):
                time_s = decoded.time if decoded.time is not None else count / rate
                first = time_s if first is None else first
                # Times must increase; broken files repeat them.
                time_s = time_s - first if count == 0 else max(time_s - first, last + 1e-4)
                image, turn = _upright(decoded, aspect)
                shape = shape or image.shape
                if image.shape != shape:
                    height, width = shape[:2]
                    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
                yield Frame(count, time_s, image, turn)
                last, count = time_s, count + 1
        except av.FFmpegError as error:
            if not (accept_damaged and count):
                raise _broken(path, count, stream, _reason(error)) from error
        if count == 0:
            raise BadInput(f"{path.name} has a video stream but no frame of it can be decoded")
        if not accept_damaged and _stops_early(container, stream, last + 1.0 / rate, count, rate):
            raise _broken(path, count, stream, "")


def _stops_early(
    container: av.container.InputContainer, stream: av.VideoStream, end_s: float, count: int, rate: float
) -> bool:
    """Whether much less could be decoded than the container promises."""
    if stream.frames:
        return count < 0.9 * stream.frames
    stated_s = 0.0
    if stream.duration and stream.time_base:
        stated_s = float(stream.duration * stream.time_base)
    elif container.duration and not container.streams.audio:
        stated_s = container.duration / 1e6
    return stated_s > 0 and end_s < 0.9 * stated_s - 2.0 / rate


def _broken(path: Path, count: int, stream: av.VideoStream, reason: str) -> BadInput:
    of = f" of {stream.frames}" if stream.frames else ""
    return BadInput(
        f"{path.name} breaks off after {count}{of} frames: the file is truncated or damaged",
        hint=(f"{reason}; " if reason else "") + "set frames.accept_damaged = true to use what can be decoded",
    )


@dataclass(frozen=True)
class Glance:
    """What a file says of itself without being decoded."""

    width: int
    height: int
    frames: int


def glance(path: Path) -> Glance | None:
    """Size and number of frames as the container states them (a guess where it does not); None where it cannot."""
    try:
        if path.is_dir():
            paths = list_images(path)
            with Image.open(paths[0]) as image:
                return Glance(*image.size, len(paths))
        with _open(path) as container:
            stream = container.streams.video[0]
            seconds = (container.duration or 0) / 1e6
            rate = float(stream.average_rate or 25.0)
            return Glance(stream.width, stream.height, stream.frames or max(1, round(seconds * rate)))
    except (BadInput, IndexError, OSError, SyntaxError):
        return None


# --------------------------------------------------------------------------------------------- focal length


def focal_hint(path: Path, width: int, height: int) -> float | None:
    """Focal length in pixels of a `width` x `height` frame from "35 mm equivalent" metadata, or None.

    The equivalent is relative to the longer side of the frame here (the film is 36 mm wide).
    """
    millimetres = _folder_focal_mm(path) if path.is_dir() else _video_focal_mm(path)
    if millimetres is None or not 5.0 <= millimetres <= 1000.0:
        return None
    return millimetres / FULL_FRAME_MM * max(width, height)


def _folder_focal_mm(folder: Path) -> float | None:
    paths = list_images(folder)
    if not paths:
        return None
    try:
        with Image.open(paths[0]) as image:
            value = image.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
        return float(value) if value else None
    except (OSError, ValueError, TypeError, SyntaxError):
        return None


def _video_focal_mm(path: Path) -> float | None:
    with _open(path) as container:
        tables = [container.metadata] + [s.metadata for s in container.streams.video]
    for table in tables:
        for key, value in table.items():
            if "focal" in key.lower() and "35mm" in key.lower().replace("_", "").replace(".", ""):
                number = re.search(r"\d+(\.\d+)?", str(value))
                if number:
                    return float(number.group())
    return None


def is_high_dynamic_range(path: Path) -> bool:
    """Whether a video is HLG or PQ; it is decoded without tone mapping, so colours look pale."""
    if path.is_dir():
        return False
    with _open(path) as container:
        streams = container.streams.video
        return bool(streams) and int(streams[0].codec_context.color_trc or 0) in (16, 18)
