"""``banmo retarget``: the motion of a clip on a known model (paper, section 4.4).

It runs the pipeline ``stages.retargeting`` in a workspace of its own beside the model's results, so that a second
call does nothing, an interrupted one goes on, and every stage can be looked at.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from pipeline import BadInput, Results

SUMMARY = "drive the model by another clip: its motion becomes one more animation"
EXAMPLES = (
    "banmo retarget --video drive.mp4",
    "banmo retarget --model ~/cat-workspace --video tiger.mp4 --preset standard",
    "banmo retarget --video same-cat.mp4 --same-subject    its colours count, too",
    "banmo retarget --video drive.mp4 --track.iterations 600    any setting of its stages",
)
TAKES_SETTINGS = True
_MODELS = ("refine", "correct", "fit")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    add = parser.add_argument
    add("--video", type=Path, required=True, metavar="CLIP", help="the clip that drives: one video file")
    add(
        "--model",
        type=Path,
        dest="workspace",
        default=argparse.SUPPRESS,
        metavar="DIR",
        help="the workspace whose model is driven; the same as --workspace",
    )
    add("--to", type=Path, metavar="DIR", help="default: retarget/<clip> in that workspace")
    add("--preset", metavar="NAME", help="preview (minutes), standard or fine")
    add("--same-subject", action="store_true", help="the clip shows the very subject of the model: its colours count")


def run(args: argparse.Namespace, results: Results) -> int:
    """Find the model, run the pipeline on the clip, say where the files are."""
    clip = args.video.expanduser().absolute()
    if not clip.exists():
        raise BadInput("there is no such clip", where=clip)
    fitted, rig = _fitted(results), results.folder("export")
    target = (args.to or results.workspace / "retarget" / clip.stem).absolute()
    command = [sys.executable, "-P", "-m", "pipeline.cli", "run", str(clip)]
    command += ["--workspace", str(target), "--definition", "stages.retargeting"]
    command += [f"--known.model={fitted}", f"--known.rig={rig.path}"]
    command += ["--preset", args.preset] if args.preset else []
    command += ["--track.same_subject=true"] if args.same_subject else []
    command += [f"--{name}={text}" for name, text in args.overrides]
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    child = subprocess.run(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})
    if child.returncode == 0:
        sys.stdout.write(f"{target / 'exports' / 'model.glb'}: the model with the motion of {clip.name} added\n")
    return child.returncode


def _fitted(results: Results) -> Path:
    """The folder of the last optimisation phase that has a result."""
    for stage in _MODELS[:-1]:
        try:
            return results.folder(stage).path
        except BadInput:
            continue
    return results.folder(_MODELS[-1]).path
