"""Small clips for the tests of perception: a textured thing that moves over a textured room, with its true masks."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from pipeline import Folder, Given, Run, Source
from stages.formats import Clip, MaskFacts, frame_name, write_clip_info, write_image, write_mask_facts
from stages.frames import FrameSettings, frames
from stages.perception.temporal import mask_box


def texture(rng: np.random.Generator, height: int, width: int, low: tuple[int, int, int], high: tuple[int, int, int]):
    """(H, W, 3) uint8 blurred noise between two colours."""
    noise = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (0, 0), 1.2)
    noise = np.clip((noise - noise.mean()) / noise.std() * 0.25 + 0.5, 0, 1)[..., None]
    return (np.array(low) * (1 - noise) + np.array(high) * noise).astype(np.uint8)


def moving_clip(count: int = 12, side: int = 128, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames (T, S, S, 3), masks (T, S, S) bool and the object's displacement a frame (2,) in pixels.

    The room moves by (2, 0.5) px a frame, an ellipse with an arm by (-1.5, 0.25) px a frame.
    """
    rng = np.random.default_rng(seed)
    room = texture(rng, side + 8, side + 4 * count, (30, 50, 30), (120, 140, 120))
    coat = texture(rng, 2 * side, 2 * side, (150, 70, 10), (250, 160, 60))
    speed = np.array([-1.5, 0.25])
    images, masks = [], []
    for t in range(count):
        room_at = np.float32([[1, 0, 2.0 * t - 4 * count + 10], [0, 1, 0.5 * t - 4]])
        image = cv2.warpAffine(room, room_at, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        centre = np.array([side * 0.55, side * 0.5]) + speed * t
        stamp = np.zeros((side, side), np.uint8)
        middle = tuple(round(float(v) * 16) for v in centre)
        cv2.ellipse(stamp, middle, (int(side * 0.2 * 16), int(side * 0.13 * 16)), 0, 0, 360, 255, -1, shift=4)
        cv2.ellipse(
            stamp,
            (middle[0], middle[1] + int(side * 2)),
            (int(side * 0.06 * 16), int(side * 0.2 * 16)),
            0,
            0,
            360,
            255,
            -1,
            shift=4,
        )
        coat_at = np.float32([[1, 0, centre[0] - side], [0, 1, centre[1] - side]])
        front = cv2.warpAffine(coat, coat_at, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        mask = stamp > 127
        image[mask] = front[mask]
        images.append(np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
        masks.append(mask)
    return np.stack(images), np.stack(masks), speed


def write_video(
    path: Path,
    images: np.ndarray,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    fps: int = 20,
    times: list[int] | None = None,
    rotation_deg: int = 0,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
) -> Path:
    """Encode frames (T, H, W, 3); `times` are presentation times in milliseconds for variable frame rates."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=fps, options=options or {})
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = pixels
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        if rotation_deg:
            stream.set_display_rotation(rotation_deg)
        for i, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[i], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def frames_of(video: Path, out: Path, **settings: object) -> Folder:
    """The `frames` stage's folder of a video."""
    out.mkdir(parents=True, exist_ok=True)
    frames(
        video=Source(video, video.stem, is_folder=video.is_dir()),
        settings=FrameSettings(**settings),  # type: ignore[arg-type]
        out=out,
        run=Run(video=video.stem),
    )
    return Folder(out)


def write_frames_folder(root: Path, images: np.ndarray, kept: list[int] | None = None, fps: float = 20.0) -> Folder:
    """A `frames` folder written directly; `kept` are the source indices of the images."""
    root.mkdir(parents=True, exist_ok=True)
    kept = kept if kept is not None else list(range(len(images)))
    times = np.arange(max(kept) + 1) / fps
    clip = Clip(root, images.shape[2], images.shape[1], np.array(kept), times)
    for name, image in zip(clip.names, images, strict=True):
        write_image(root / name, image)
    write_clip_info(clip, root, {"source_width": images.shape[2], "source_height": images.shape[1]})
    return Folder(root)


def write_masks_folder(root: Path, masks: np.ndarray, clip: Clip) -> Folder:
    """A `masks` folder written directly from boolean masks."""
    root.mkdir(parents=True, exist_ok=True)
    for name, mask in zip(clip.names, masks, strict=True):
        write_image(root / name, mask.astype(np.uint8) * 255)
    box = np.stack([mask_box(m) for m in masks])
    area = masks.reshape(len(masks), -1).mean(axis=1)
    write_mask_facts(root, MaskFacts("given-folder", box, area, np.ones(len(masks)), [[] for _ in masks]), clip)
    return Folder(root)


def write_pngs(folder: Path, pictures: np.ndarray, names: list[str] | None = None) -> Path:
    """A folder of PNGs named 00000.png and on, or by `names`."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, picture in enumerate(pictures):
        write_image(folder / (names[i] if names else frame_name(i)), picture)
    return folder


def given(**paths: Path) -> Given:
    """What lies beside a video: ``given(masks=folder, masks_mp4=file)``."""
    return Given({"." + key.replace("_", "."): path for key, path in paths.items()})


def overlap(found: np.ndarray, truth: np.ndarray) -> float:
    """Mean intersection over union of boolean (T, H, W) masks."""
    both = (found & truth).reshape(len(truth), -1).sum(axis=1)
    either = (found | truth).reshape(len(truth), -1).sum(axis=1)
    return float((both / np.maximum(either, 1)).mean())
