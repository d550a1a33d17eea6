"""``banmo view``: the model live in a browser, also while it is still being fitted (extra ``[view]``: viser)."""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline import BadInput, Results

if TYPE_CHECKING:
    from stages.viewing.content import Finished, Growing, Shown

SUMMARY = "look at the model live in a browser, also while it is being fitted"
EXAMPLES = (
    "banmo view                       then open http://127.0.0.1:8080",
    "banmo view --port 9000",
    "banmo view --fitting             the unfinished model, newer every few seconds",
    "banmo view --host 0.0.0.0        reachable from other machines: anyone there can look",
)
_LOOPBACK = "127.0.0.1"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    add = parser.add_argument
    add("--port", type=int, default=8080, help="default 8080")
    add("--host", default=_LOOPBACK, help=f"address to listen on (default {_LOOPBACK}: this machine alone)")
    add("--glb", type=Path, metavar="FILE", help="another file than the workspace's model.glb")
    add("--fitting", action="store_true", help="the model as it is being fitted, even where there is a finished one")
    add("--seconds", type=float, default=0.0, help="end after so long (default: until Ctrl-C)")


def run(args: argparse.Namespace, results: Results) -> int:
    """Serve until stopped."""
    try:
        import viser
    except ImportError as error:
        raise BadInput("the viewer needs viser", hint="pip install 'banmo-pipeline[view]'") from error
    from stages.viewing.content import Growing

    if not 0 < args.port < 65536:
        raise BadInput(f"there is no port {args.port}")
    finished = None if args.fitting else _finished(args, results)
    growing = Growing(results.workspace / "checkpoints")
    if finished is None and not growing.refresh():
        raise BadInput(
            "there is neither a finished model nor one that is being fitted",
            where=results.workspace,
            hint="banmo run, in another terminal",
        )
    with contextlib.redirect_stdout(io.StringIO()):  # it has a banner of its own
        server = viser.ViserServer(host=args.host, port=args.port, label="banmo", verbose=False)
    try:
        server.scene.set_up_direction("+y")
        server.initial_camera.position = (2.2, 1.0, 3.0)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        view = _play(server, finished) if finished is not None else _grow(server, growing)
        where = _LOOPBACK if args.host in ("0.0.0.0", "::") else args.host
        sys.stdout.write(f"http://{where}:{server.get_port()}  (Ctrl-C ends it)\n")
        sys.stdout.flush()
        end = time.monotonic() + args.seconds if args.seconds > 0 else float("inf")
        while time.monotonic() < end:
            time.sleep(view())
    finally:
        server.stop()
    return 0


def _finished(args: argparse.Namespace, results: Results) -> Finished | None:
    """The exported model; None where there is none and none was named."""
    from stages.animating.glb import GlbError, read_glb
    from stages.animating.playing import Player
    from stages.viewing.content import Finished

    if args.glb is not None:
        path = args.glb
    else:
        try:
            path = results.folder("export").path / "model.glb"
        except BadInput:
            return None
    try:
        return Finished(Player.of(read_glb(path.read_bytes())))
    except OSError as error:
        raise BadInput(f"it cannot be read ({error.strerror})", where=path) from error
    except GlbError as error:
        raise BadInput(str(error), where=path) from error


def _draw(server: Any, shown: Shown, wireframe: bool, bones: bool) -> None:
    """Put a mesh (again) into the scene."""
    import trimesh

    if wireframe:
        edges = {"color": (90, 95, 100), "wireframe": True, "side": "double"}
        server.scene.add_mesh_simple("/model", shown.vertices.astype("float32"), shown.faces, **edges)
    else:
        mesh = trimesh.Trimesh(shown.vertices, shown.faces, vertex_colors=shown.colours, process=False)
        server.scene.add_mesh_trimesh("/model", mesh)
    if bones and len(shown.bones):
        server.scene.add_line_segments("/bones", shown.bones.astype("float32"), (25, 25, 30), thickness=0.008)
    elif not bones:
        server.scene.remove_by_name("/bones")


def _play(server: Any, finished: Finished) -> Any:
    """Controls of a finished model; returns what draws what was asked for and says how long to wait.

    A playing clip goes to the browser whole, which plays it by itself; a moment of it is one mesh.
    """
    rest = "at rest"
    gui = server.gui
    clip = gui.add_dropdown("Clip", (*finished.clips, rest))
    playing = gui.add_checkbox("Play", True)
    clock = gui.add_slider("Moment (share of the clip)", 0.0, 1.0, 0.005, 0.0)
    look = gui.add_dropdown("Colours", finished.looks)
    wire, bones = gui.add_checkbox("Wireframe", False), gui.add_checkbox("Bones", False)
    drawn: list[tuple[Any, ...]] = [()]

    def step() -> float:
        whole = playing.value and clip.value != rest and not wire.value and not bones.value
        clock.disabled = whole
        wanted = (clip.value, whole or clock.value, look.value, wire.value, bones.value)
        if wanted != drawn[0]:
            drawn[0] = wanted
            if whole:
                server.scene.remove_by_name("/bones")
                server.scene.add_glb("/model", finished.playing(clip.value, look.value))
            else:
                moment = clock.value * finished.seconds(clip.value)
                _draw(server, finished.at(clip.value, moment, look.value), wire.value, bones.value)
        return 1 / 10

    step()
    return step


def _grow(server: Any, growing: Growing, every_s: float = 3.0) -> Any:
    """The unfinished model, its loss curve and its last preview picture; looked for again every few seconds."""
    import numpy as np
    from PIL import Image

    gui = server.gui
    said = gui.add_markdown("")
    wire, bones = gui.add_checkbox("Wireframe", False), gui.add_checkbox("Bones", False)
    held: dict[str, Any] = {"curve": None, "picture": None, "drawn": None, "next": 0.0}

    def step() -> float:
        now = time.monotonic()
        newer = now >= held["next"] and growing.refresh()
        if now >= held["next"]:
            held["next"] = now + every_s
        drawn = (growing.step, wire.value, bones.value)
        if growing.shown is not None and drawn != held["drawn"]:
            held["drawn"] = drawn
            _draw(server, growing.shown, wire.value, bones.value)
        if newer or said.content == "":
            loss = f", loss {growing.loss[-1][1]:.4f}" if growing.loss else ""
            said.content = f"Step {growing.step}{loss}. Newer every {every_s:.0f} s while it is fitted."
            if len(growing.loss) > 1:
                steps, values = (np.array(v) for v in zip(*growing.loss, strict=True))
                _replace(held, "curve", _curve(gui, steps, values))
            if growing.preview is not None:
                picture = np.asarray(Image.open(growing.preview).convert("RGB"))
                _replace(held, "picture", gui.add_image(picture, label="frames and model"))
        return 0.2

    step()
    return step


def _curve(gui: Any, steps: Any, values: Any) -> Any:
    from viser import uplot

    series = (uplot.Series(label="step"), uplot.Series(label="loss", stroke="#2f6f5e", width=2))
    return gui.add_uplot((steps, values), series, aspect=1.6)


def _replace(held: dict[str, Any], name: str, handle: Any) -> None:
    if held[name] is not None:
        held[name].remove()
    held[name] = handle
