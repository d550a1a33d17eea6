"""``banmo retarget``: the motion of a clip on a known model (paper, section 4.4).

It runs the pipeline ``stages.retargeting`` in a workspace of its own beside the model's results, so that a second
call does nothing, an interrupted one goes on, and every stage can be looked at.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pipeline import BadInput, Results
from stages.again import add_model, run_pipeline

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
    add_model(parser, "driven")
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
    words = [str(clip), "--workspace", str(target), "--definition", "stages.retargeting"]
    words += [f"--known.model={fitted}", f"--known.rig={rig.path}"]
    words += ["--preset", args.preset] if args.preset else []
    words += ["--track.same_subject=true", "--onto.follow=pixels"] if args.same_subject else []
    words += [f"--{name}={text}" for name, text in args.overrides]
    code = run_pipeline(words)
    if code == 0:
        sys.stdout.write(f"{target / 'exports' / 'model.glb'}: the model with the motion of {clip.name} added\n")
    return code


def _fitted(results: Results) -> Path:
    """The folder of the last optimisation phase that has a result."""
    for stage in _MODELS[:-1]:
        try:
            return results.folder(stage).path
        except BadInput:
            continue
    return results.folder(_MODELS[-1]).path
