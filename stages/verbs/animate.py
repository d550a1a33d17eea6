"""``banmo animate``: a motion from a file (BVH or GLB) on the model's skeleton."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline import BadInput, Results
from stages.again import add_model

if TYPE_CHECKING:
    from stages.animating.transfer import Motion

SUMMARY = "move the model by a motion file: BVH or GLB becomes one more animation"
EXAMPLES = (
    "banmo animate --from walk.bvh",
    "banmo animate --from other.glb --clip Run          one animation of a file with several",
    'banmo animate --from walk.bvh --map joints.json    {"spine_1": "Hips", ...}: our joint -> theirs',
    "banmo animate --from walk.bvh --name walk --in-place",
)
_MOST_BYTES = 500_000_000


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    add = parser.add_argument
    add_model(parser, "moved")
    add("--from", type=Path, required=True, dest="source", metavar="FILE", help="a .bvh or a .glb with a skeleton")
    add("--clip", metavar="NAME", help="which animation of a GLB (default: the first)")
    add("--map", type=Path, metavar="FILE", help="JSON: names of our joints -> names of theirs; others match by name")
    add("--name", metavar="NAME", help="what the new animation is called (default: like the file)")
    add("--in-place", action="store_true", help="leave the motion of the whole out")
    add("--glb", type=Path, metavar="FILE", help="another model than the workspace's model.glb")
    add("--to", default="", metavar="NAME", help="folder in the workspace (default: animate/<name>)")


def run(args: argparse.Namespace, results: Results) -> int:
    """Read both skeletons, carry the motion over, write the model with one more animation."""
    import numpy as np

    from stages.animating.adding import NewMotion, add_motion
    from stages.animating.glb import GlbError, read_glb
    from stages.animating.playing import ROOT_MOTION
    from stages.animating.transfer import NoPartners, local_of, partners, skeleton_of, transfer

    path = args.glb or results.folder("export").path / "model.glb"
    data = _bytes(path)
    source = _source(args)
    try:
        glb = read_glb(data)
        nodes, parent, rest = skeleton_of(glb)
    except GlbError as error:
        raise BadInput(str(error), where=path) from error
    names = [glb.names[n] for n in nodes]
    try:
        pairs = partners(names, source.names, _map(args.map))
    except NoPartners as error:
        raise BadInput(str(error), where=args.source, hint="say which joint is which by --map joints.json") from error
    posed = transfer(source, rest, parent, pairs)
    local = local_of(posed, parent)
    moving = {node: local[:, j] for j, node in enumerate(nodes)}
    if ROOT_MOTION in glb.names:
        still = np.repeat(np.eye(4)[None], len(posed), axis=0)
        moving[glb.names.index(ROOT_MOTION)] = still if args.in_place or source.root is None else source.root
    name = args.name or args.clip or args.source.stem
    folder = args.to or "animate/" + (re.sub(r"[^\w.-]+", "-", name).strip(".-") or "motion")
    made = add_motion(data, NewMotion(name, source.time_s - source.time_s[0], moving, {"source": args.source.name}))
    with results.publish_dir(folder) as out:
        (out / "model.glb").write_bytes(made)
        facts: dict[str, Any] = {
            "animation": name,
            "from": args.source.name,
            "frames": len(posed),
            "seconds": round(float(source.time_s[-1] - source.time_s[0]), 4),
            "joints": {names[a]: source.names[b] for a, b in sorted(pairs.items())},
            "still": [n for j, n in enumerate(names) if j not in pairs],
        }
        (out / "motion.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
        _film(out, made, name)
    text = (
        f"{results.workspace / folder / 'model.glb'}: {len(pairs)} of {len(names)} joints move, {facts['seconds']} s\n"
    )
    sys.stdout.write(text)
    return 0


def _bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise BadInput(f"this file is larger than {_MOST_BYTES // 1_000_000} MB", where=path)
        return path.read_bytes()
    except OSError as error:
        raise BadInput(f"it cannot be read ({error.strerror})", where=path) from error


def _source(args: argparse.Namespace) -> Motion:
    """The motion file."""
    from stages.animating.bvh import BvhError, read_bvh
    from stages.animating.glb import GlbError, read_glb
    from stages.animating.transfer import motion_of_bvh, motion_of_glb

    path: Path = args.source
    data = _bytes(path)
    try:
        if path.suffix.lower() == ".bvh":
            if args.clip:
                raise BadInput("a BVH holds one motion", where=path, hint="leave --clip out")
            return motion_of_bvh(read_bvh(data.decode("utf-8", errors="replace")))
        glb = read_glb(data)
        if not glb.animations:
            raise BadInput("it has no animation that moves joints", where=path)
        return motion_of_glb(glb, glb.animation(args.clip) if args.clip else glb.animations[0])
    except (BvhError, GlbError) as error:
        raise BadInput(f"it {error}", where=path) from error


def _map(path: Path | None) -> dict[str, str] | None:
    if path is None:
        return None
    try:
        named = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput("the map of joints cannot be read as JSON", where=path) from error
    if not isinstance(named, dict) or not all(isinstance(v, str) for v in named.values()):
        raise BadInput("the map of joints is an object: our joint -> their joint", where=path)
    return named


def _film(out: Path, data: bytes, name: str) -> None:
    """A small film of the motion in place, to look at."""
    import numpy as np

    from pipeline.console import progress
    from stages.animating.glb import read_glb
    from stages.animating.playing import Player
    from stages.rendering.film import extent, pictures, turntable
    from stages.video_io import write_video

    player = Player.of(read_glb(data))
    animation = player.glb.animation(name)
    length = float(animation.time_s[-1])
    size, fps = (384, 384), 15.0
    seconds = min(max(length, 1.0 / fps), 8.0)
    shot = turntable(extent(player, animation), size, seconds, fps, 12.0, 0.0, None, length)
    shown = pictures(player, animation, shot, size, ["colour"], np.full(3, 0.93))
    write_video(out / "preview.mp4", (row[0][..., :3] for row in progress(shown, len(shot.at_s), "preview")), shot.at_s)
