"""``banmo extend``: clips that were added to the folder join a finished model, which is gone on from."""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from pipeline import BadInput, Results
from stages.again import run_pipeline

SUMMARY = "take clips that were added to the folder into the finished model, going on from it"
EXAMPLES = (
    "banmo extend                     the clips' folder of last time, now with more in it",
    "banmo extend clips/ --preset standard",
    "banmo extend --fit.iterations 800",
)
TAKES_SETTINGS = True
_SHARE = 0.5
_LEAST = 40


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    parser.add_argument(
        "videos", nargs="?", type=Path, metavar="VIDEOS", help="folder of clips (default: that of last time)"
    )
    parser.add_argument("--preset", metavar="NAME", help="settings by purpose; see `banmo settings`")


def run(args: argparse.Namespace, results: Results) -> int:
    """Keep the model aside, then run with it as the start and half the steps."""
    model = results.folder("refine")
    name = Path("earlier") / model.digest[:12]
    kept = results.workspace / name
    if not (kept / "model.json").is_file():
        with results.publish_dir(name) as out:
            for file in ("model.safetensors", "model.json"):
                shutil.copyfile(model.path / file, out / file)
    words = [str(args.videos)] if args.videos else []
    words += ["--workspace", str(results.workspace), f"--fit.warm={kept}"]
    words += ["--preset", args.preset] if args.preset else []
    named = {n for n, _ in args.overrides}
    if "fit.warm" in named:
        raise BadInput("`extend` says itself what to go on from", hint="leave --fit.warm out, or use `banmo run`")
    before = results.settings("fit").get("iterations")
    if "fit.iterations" not in named and isinstance(before, int):
        words.append(f"--fit.iterations={max(_LEAST, round(_SHARE * before))}")
    words += [f"--{n}={text}" for n, text in args.overrides]
    code = run_pipeline(words)
    if code == 0:
        sys.stdout.write(
            f"went on from {name}; a plain `banmo run` would begin anew. To stay with it, write into pipeline.toml:\n"
            f'[fit]\nwarm = "{name}"\n'
        )
    return code
