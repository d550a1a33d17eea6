"""Writing H.264 videos that every browser plays."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

_TICKS_PER_S = 90_000


class VideoWriter:
    """An H.264 video written picture by picture; the same pictures give the same bytes.

    Each picture (H, W, 3) uint8 RGB, even height and width, is shown from its time on.
    """

    def __init__(self, path: Path, time_s: np.ndarray, crf: int = 20) -> None:
        """Open `path` (ends in ``.mp4``).

        `time_s` are increasing seconds, of which the first is moved to zero; `crf` is x264's quality, lower is better.
        """
        ticks = np.round((np.asarray(time_s, np.float64) - time_s[0]) * _TICKS_PER_S).astype(int)
        for i in range(1, len(ticks)):
            ticks[i] = max(ticks[i], ticks[i - 1] + 1)
        spacing = float(np.median(np.diff(ticks))) if len(ticks) > 1 else _TICKS_PER_S / 10
        self._rate = Fraction(_TICKS_PER_S / max(spacing, _TICKS_PER_S / 240)).limit_denominator(1001)
        self._ticks = iter(ticks.tolist())
        self._crf = crf
        self._container = av.open(str(path), "w", options={"movflags": "+faststart"})
        self._stream: av.VideoStream | None = None

    def add(self, picture: np.ndarray) -> None:
        """The next picture. Raises StopIteration beyond the last time."""
        tick = next(self._ticks)
        if self._stream is None:
            stream = self._container.add_stream("libx264", rate=self._rate)
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "yuv420p"
            stream.time_base = stream.codec_context.time_base = Fraction(1, _TICKS_PER_S)
            # One thread: with several, the bytes would depend on the machine. No macroblock trees: x264's AVX-512
            # code for them reads memory it never wrote, and now and then the bytes differ.
            stream.options = {"crf": str(self._crf), "preset": "veryfast", "threads": "1", "x264-params": "mbtree=0"}
            self._stream = stream
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts, frame.time_base = tick, Fraction(1, _TICKS_PER_S)
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def write_video(path: Path, pictures: Iterable[np.ndarray], time_s: np.ndarray, crf: int = 20) -> None:
    """Write (H, W, 3) uint8 RGB pictures, as many as times; see :class:`VideoWriter`."""
    with VideoWriter(path, time_s, crf) as writer:
        for picture, _ in zip(pictures, time_s, strict=True):
            writer.add(picture)


def read_pictures(path: Path, count: int) -> list[np.ndarray]:
    """`count` pictures (H, W, 3) uint8 RGB spread evenly over a video written here (fewer if it is shorter)."""
    with av.open(str(path)) as container:
        total = max(container.streams.video[0].frames, 1)
        wanted = {int(i) for i in np.linspace(0, total - 1, count).round()}
        return [f.to_ndarray(format="rgb24") for i, f in enumerate(container.decode(video=0)) if i in wanted]
