"""frames: the user's video as upright sRGB pictures with their time stamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline import BadInput, Resources, Run, Source, Video, stage
from stages.decoding import Frame, focal_hint, glance, is_high_dynamic_range, read_frames
from stages.formats import Clip, FormatError, frame_name, read_clip, read_image, write_clip_info, write_image
from stages.perception.sampling import at_rate, evenly_in_time, fit_size, moving_frames, thumbnail
from stages.perception.sheets import frame_sheet

MIN_SIDE_PX = 64
MIN_FRAMES = 2


@dataclass(frozen=True)
class FrameSettings:
    """Settings of the `frames` stage."""

    fps: float = 0.0
    """Frames a second to keep; 0 keeps the source's own rate."""
    max_frames: int = 150
    """Most frames to keep of one clip, evenly in time; 0 keeps all."""
    max_side_px: int = 480
    """Longer side of the kept frames; larger ones are reduced, smaller ones left alone; 0 keeps the size."""
    least_change: float = 1.0
    """Frames that differ nowhere by this many grey levels (of 255) from the one before are dropped; 0 keeps them."""
    start_s: float = 0.0
    """Leave out what comes before this time."""
    end_s: float = 0.0
    """Leave out what comes after this time; 0 for the end of the clip."""
    folder_fps: float = 10.0
    """Frames a second of a folder of images, which has no times of its own."""
    accept_damaged: bool = False
    """Use what can be decoded of a truncated file instead of refusing it."""


@stage(per=Video, version=1, needs=Resources(cpus=1))
def frames(video: Source, settings: FrameSettings, out: Path, run: Run) -> None:
    """Upright sRGB frames as PNG, `frames.json` with their indices and times in the source.

    The clip is decoded twice: once for times and thumbnails, from which the frames are chosen, once for pixels;
    memory does not grow with its length.
    """
    times, thumbs, size, rotation_deg = _survey(video.path, settings, run)
    keep = choose_frames(np.array(times), np.stack(thumbs), settings)
    _require_frames(video, keep, times)
    if min(size) < MIN_SIDE_PX:
        raise BadInput(
            f"{video.path.name} is {size[0]}x{size[1]} pixels: the smaller side must be at least {MIN_SIDE_PX}",
        )
    width, height = fit_size(*size, settings.max_side_px)
    if min(width, height) < MIN_SIDE_PX:
        raise BadInput(
            f"{video.path.name} becomes {width}x{height} pixels: the smaller side must be at least {MIN_SIDE_PX}",
            hint=f"raise frames.max_side_px (now {settings.max_side_px})",
        )
    clip = Clip(
        root=out,
        width=width,
        height=height,
        source_idx=keep,
        source_time_s=np.array(times),
        focal_hint_px=focal_hint(video.path, width, height),
        rotation_deg=rotation_deg,
    )
    _write(video.path, clip, settings, run)
    static = len(times) - len(moving_frames(np.stack(thumbs), settings.least_change))
    extra = {"source_width": size[0], "source_height": size[1], "static_frames_dropped": static}
    write_clip_info(clip, out, extra)
    run.metric("frames_kept", len(clip))
    run.metric("frames_source", len(times))
    run.log.info("kept %d of %d frames (%d static), %dx%d", len(clip), len(times), static, width, height)
    if is_high_dynamic_range(video.path):
        run.warn(f"{video.path.name} is a high-dynamic-range video; it is used without tone mapping and looks pale")


def choose_frames(time_s: np.ndarray, thumbs: np.ndarray, settings: FrameSettings) -> np.ndarray:
    """(T,) source indices to keep: inside the time limits, moving, at the rate asked for, at most `max_frames`."""
    end_s = settings.end_s if settings.end_s > 0 else np.inf
    inside = np.flatnonzero((time_s >= settings.start_s) & (time_s <= end_s))
    if len(inside) == 0:
        return inside
    keep = inside[moving_frames(thumbs[inside], settings.least_change)]
    keep = keep[at_rate(time_s[keep], settings.fps)]
    return keep[evenly_in_time(time_s[keep], settings.max_frames)]


def _survey(
    path: Path, settings: FrameSettings, run: Run
) -> tuple[list[float], list[np.ndarray], tuple[int, int], int]:
    """Times and thumbnails of all source frames, size (width, height) of the upright picture, rotation applied."""
    times: list[float] = []
    thumbs: list[np.ndarray] = []
    size, rotation_deg = (0, 0), 0
    for frame in _decode(path, settings):
        times.append(round(frame.time_s, 6))
        thumbs.append(thumbnail(frame.image))
        size, rotation_deg = (frame.image.shape[1], frame.image.shape[0]), frame.rotation_deg
        if frame.source_idx % 50 == 0:
            run.tick(frame.source_idx, 0, label="surveying")
    return times, thumbs, size, rotation_deg


def _decode(path: Path, settings: FrameSettings) -> Iterator[Frame]:
    return read_frames(path, folder_fps=settings.folder_fps, accept_damaged=settings.accept_damaged)


def _require_frames(video: Source, keep: np.ndarray, times: list[float]) -> None:
    if len(keep) >= MIN_FRAMES:
        return
    name = video.path.name
    if len(times) < MIN_FRAMES:
        raise BadInput(f"{name} has only one frame: a clip needs at least {MIN_FRAMES} to show motion")
    left = "no frame" if len(keep) == 0 else "only one frame"
    raise BadInput(
        f"{name}: {left} of {len(times)} is left after filtering, at least {MIN_FRAMES} are needed",
        hint="look at frames.start_s, end_s, fps, max_frames and least_change (a still picture does not move)",
    )


def _write(path: Path, clip: Clip, settings: FrameSettings, run: Run) -> None:
    wanted = {int(i) for i in clip.source_idx}
    done = 0
    for frame in _decode(path, settings):
        if frame.source_idx not in wanted:
            continue
        image = frame.image
        if image.shape[:2] != (clip.height, clip.width):
            image = cv2.resize(image, (clip.width, clip.height), interpolation=cv2.INTER_AREA)
        write_image(clip.root / frame_name(frame.source_idx), image)
        done += 1
        run.tick(done, len(wanted), label="writing")
        if done == len(wanted):
            break


@frames.check
def _check(out: Path) -> None:
    clip = read_clip(out)
    for name in clip.names:
        image = read_image(out / name)
        if image.shape != (clip.height, clip.width, 3):
            raise FormatError(
                f"{name} is {image.shape[1]}x{image.shape[0]}, frames.json says {clip.width}x{clip.height}"
            )


@frames.estimate
def _bytes(video: Source, settings: FrameSettings) -> int:
    """PNGs of noisy video take up to 2 bytes a pixel. What cannot be opened is the stage's to refuse."""
    seen = glance(video.path)
    if seen is None:
        return 0
    width, height = fit_size(seen.width, seen.height, settings.max_side_px)
    kept = min(seen.frames, settings.max_frames) if settings.max_frames > 0 else seen.frames
    return 2 * width * height * kept


@frames.sheet
def _sheet(out: Path, picture: Path) -> None:
    clip = read_clip(out)
    write_image(picture, frame_sheet(clip.images()))
