"""``banmo render``: films and pictures of the model from anywhere, at any moment of its clips."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline import BadInput, Results

if TYPE_CHECKING:
    import numpy as np

    from stages.animating.glb import Animation, Glb
    from stages.animating.playing import Player
    from stages.rendering.paths import Shot

SUMMARY = "films and pictures of the model: turntable, camera path, bullet time"
EXAMPLES = (
    "banmo render                                        a turn about the model at rest",
    "banmo render --clip cat-03                          a turn about it while it moves",
    "banmo render --clip cat-03 --at 1.2                 bullet time: frozen at 1.2 s, the camera goes round",
    "banmo render --clip cat-03 --filmed --show colour,normals,depth",
    "banmo render --clip cat-03 --path flight.json --format gif",
    "banmo render --glb retarget/drive/exports/model.glb --clip drive",
)
_KINDS = ("colour", "silhouette", "depth", "normals", "correspondence")
_FORMATS = ("mp4", "png", "gif")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    add = parser.add_argument
    add("--clip", metavar="NAME", help="the animation that plays (default: none, the model at rest)")
    add("--at", type=float, metavar="SECONDS", help="stand still at this moment of the clip")
    add(
        "--path",
        type=Path,
        metavar="FILE",
        help="a camera path (JSON: keys with at, azimuth, elevation, distance, ...)",
    )
    add("--filmed", action="store_true", help="through the clip's own camera")
    add("--show", default="colour", metavar="KINDS", help=f"one or more of {','.join(_KINDS)} (default: colour)")
    add("--format", choices=_FORMATS, default="mp4", help="mp4 (default), png (one a picture, with alpha) or gif")
    add("--size", metavar="WxH", help="pixels, such as 640x480 (default: 512x512, with --filmed the clip's own)")
    add("--seconds", type=float, default=4.0, help="length of a turn (default 4)")
    add("--fps", type=float, default=24.0, help="pictures a second (default 24)")
    add("--elevation", type=float, default=12.0, metavar="DEG", help="height of the camera in a turn (default 12)")
    add("--turns", type=float, default=1.0, help="turns in all; negative goes the other way (default 1)")
    add("--background", default="#eeeeee", metavar="COLOUR", help="#rrggbb behind the model (default #eeeeee)")
    add("--glb", type=Path, metavar="FILE", help="another file than the workspace's model.glb")
    add("--to", default="", metavar="NAME", help="folder in the workspace (default: render/<what it shows>)")


def run(args: argparse.Namespace, results: Results) -> int:
    """Draw the shot; one file (or folder of pictures) a kind."""
    from pipeline.console import progress
    from stages.animating.glb import GlbError, read_glb
    from stages.animating.playing import Player
    from stages.rendering.film import pictures

    kinds = _kinds(args.show)
    if args.filmed and (args.path or not args.clip):
        raise BadInput("--filmed is the clip's own camera", hint="name a --clip, and leave --path out")
    if args.at is not None and not args.clip:
        raise BadInput("--at is a moment of a clip", hint="name a --clip")
    if not 0 < args.fps <= 240 or not 0 < args.seconds <= 3600:
        raise BadInput("--fps lies in 0..240 and --seconds in 0..3600")
    path = args.glb or results.folder("export").path / "model.glb"
    try:
        glb = read_glb(path.read_bytes())
        player = Player.of(glb)
        animation = glb.animation(args.clip) if args.clip else None
    except FileNotFoundError as error:
        raise BadInput("there is no such file", where=path) from error
    except GlbError as error:
        raise BadInput(str(error), where=path) from error
    shot, size = _shot(args, glb, player, animation)
    name = args.to or "render/" + _label(args)
    shown = pictures(player, animation, shot, size, kinds, _colour(args.background), args.filmed)
    with results.publish_dir(name) as out:
        _write(out, progress(shown, len(shot.at_s), "rendering"), kinds, args.format, shot.at_s)
    sys.stdout.write(f"{results.workspace / name}: {len(shot.at_s)} pictures of {', '.join(kinds)}\n")
    return 0


def _kinds(text: str) -> list[str]:
    kinds = [k.strip() for k in text.split(",") if k.strip()]
    for kind in kinds:
        if kind not in _KINDS:
            raise BadInput(f"there is nothing called {kind!r} to show", hint=f"known: {', '.join(_KINDS)}")
    if not kinds:
        raise BadInput("--show names nothing", hint=f"known: {', '.join(_KINDS)}")
    return list(dict.fromkeys(kinds))


def _colour(text: str) -> np.ndarray:
    import numpy as np

    if not re.fullmatch(r"#?[0-9a-fA-F]{6}", text):
        raise BadInput(f"{text!r} is not a colour", hint="such as #ffffff")
    digits = text.lstrip("#")
    return np.array([int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)])


def _size(text: str | None) -> tuple[int, int] | None:
    """Height and width, even so that films can hold them."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if not found or not all(16 <= int(v) <= 4096 for v in found.groups()):
        raise BadInput(f"--size {text!r} is not a size", hint="such as 640x480; each side is 16 to 4096")
    width, height = (int(v) // 2 * 2 for v in found.groups())
    return height, width


def _label(args: argparse.Namespace) -> str:
    how = "filmed" if args.filmed else "path" if args.path else "bullet" if args.at is not None else "turntable"
    clip = re.sub(r"[^\w.-]+", "-", args.clip or "rest").strip(".-") or "clip"
    return f"{clip}-{how}"


def _shot(
    args: argparse.Namespace, glb: Glb, player: Player, animation: Animation | None
) -> tuple[Shot, tuple[int, int]]:
    from stages.rendering.film import as_filmed, extent, turntable
    from stages.rendering.paths import PathError, parse_path, shot_of_path

    size = _size(args.size)
    length = 0.0 if animation is None else float(animation.time_s[-1])
    if args.at is not None and not 0 <= args.at <= length:
        raise BadInput(f"the clip has no moment {args.at} s", hint=f"it lasts {length:.2f} s")
    if args.filmed:
        assert animation is not None
        try:
            shot, shape = as_filmed(glb, animation, size)
        except (StopIteration, KeyError, TypeError, ValueError) as error:
            raise BadInput(f"the file has no camera of {args.clip!r}", hint="leave --filmed out") from error
        return shot, (shape[0] // 2 * 2, shape[1] // 2 * 2)
    shape = size or (512, 512)
    points = extent(player, animation)
    if args.path:
        try:
            document = parse_path(args.path.read_text(encoding="utf-8"))
            centre = (points.min(axis=0) + points.max(axis=0)) / 2
            return shot_of_path(document, centre, shape[1], shape[0], args.fps), shape
        except (OSError, UnicodeDecodeError) as error:
            raise BadInput("the camera path cannot be read", where=args.path) from error
        except PathError as error:
            raise BadInput(f"the camera path {error}", where=args.path) from error
    return turntable(points, shape, args.seconds, args.fps, args.elevation, args.turns, args.at, length), shape


def _write(out: Path, shown: Iterator[list[np.ndarray]], kinds: list[str], kind_of_file: str, at_s: np.ndarray) -> None:
    """Pictures as they come: films are encoded one frame at a time."""
    import numpy as np
    from PIL import Image

    from stages.video_io import VideoWriter

    if kind_of_file == "png":
        for i, row in enumerate(shown):
            for kind, picture in zip(kinds, row, strict=True):
                (out / kind).mkdir(exist_ok=True)
                Image.fromarray(picture, "RGBA").save(out / kind / f"{i:05d}.png")
        return
    if kind_of_file == "gif":
        frames: list[list[Image.Image]] = [[] for _ in kinds]
        for row in shown:
            for held, picture in zip(frames, row, strict=True):
                held.append(Image.fromarray(picture[..., :3]).quantize(128, dither=Image.Dither.NONE))
        pause = round(1000 * float(np.median(np.diff(at_s)))) if len(at_s) > 1 else 100
        for kind, held in zip(kinds, frames, strict=True):
            held[0].save(out / f"{kind}.gif", save_all=True, append_images=held[1:], duration=max(20, pause), loop=0)
        return
    writers = [VideoWriter(out / f"{kind}.mp4", at_s) for kind in kinds]
    for row in shown:
        for writer, picture in zip(writers, row, strict=True):
            writer.add(picture[..., :3])
    for writer in writers:
        writer.close()
