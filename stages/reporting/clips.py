"""Videos small enough to lie inside a page."""

from __future__ import annotations

import io
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av


@dataclass(frozen=True)
class Shrunk:
    """An H.264 MP4; empty where none would fit."""

    data: bytes


def shrink_video(path: Path, most_bytes: int) -> Shrunk:
    """The video as it is where it fits into `most_bytes`, else made smaller; empty if even the smallest does not."""
    if path.stat().st_size <= most_bytes:
        return Shrunk(path.read_bytes())
    for scale, crf in ((0.75, 28), (0.5, 30), (0.34, 34)):
        data = encoded(path, scale, crf)
        if len(data) <= most_bytes:
            return Shrunk(data)
    return Shrunk(b"")


def encoded(path: Path, scale: float, crf: int) -> bytes:
    """The same pictures at the same times, `scale` times as large, by x264 with one thread: the same bytes always."""
    target = io.BytesIO()
    with av.open(str(path)) as source, av.open(target, "w", format="mp4") as sink:
        old = source.streams.video[0]
        width = max(2, round(old.codec_context.width * scale / 2) * 2)
        height = max(2, round(old.codec_context.height * scale / 2) * 2)
        base = old.time_base or Fraction(1, 90_000)
        new = sink.add_stream("libx264", rate=old.average_rate or 25)
        new.width, new.height, new.pix_fmt, new.time_base = width, height, "yuv420p", base
        new.options = {"crf": str(crf), "preset": "veryfast", "threads": "1", "x264-params": "mbtree=0"}
        for frame in source.decode(video=0):
            small = frame.reformat(width=width, height=height, format="yuv420p")
            small.pts, small.time_base = frame.pts, frame.time_base
            sink.mux(new.encode(small))
        sink.mux(new.encode())
    return target.getvalue()
