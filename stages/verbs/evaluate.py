"""``banmo evaluate``: the paper's measures of a finished workspace against known truth."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline import BadInput, Results
from pipeline.console import progress

if TYPE_CHECKING:
    import numpy as np

    from stages.ground_truth import TrueSurfaces
    from stages.scoring.metrics import SurfaceScore
    from stages.scoring.surfaces import Surface

SUMMARY = "measure the result against known surfaces, poses, masks and flow"
EXAMPLES = (
    "banmo evaluate --truth data/fox --look clean",
    "banmo evaluate --truth data/fox --only mesh --every 5",
    "banmo evaluate --truth data/fox/gt/meshes.npz --meshes out/meshes --align all",
    "banmo evaluate --truth data/fox --look casual --json scores.json",
)

PARTS = ("mesh", "pose", "mask", "flow")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Flags."""
    add = parser.add_argument
    add("--truth", type=Path, required=True, metavar="DIR", help="folder of the object, or its meshes.npz")
    add("--look", metavar="NAME", help="which look of the object the videos show, where there are several")
    add("--only", choices=PARTS, action="append", metavar="PART", help=f"{', '.join(PARTS)}; may be repeated")
    add("--meshes", type=Path, metavar="DIR", help="other meshes, a folder a video; default: those of the workspace")
    add(
        "--align",
        choices=("video", "all", "frame", "none"),
        default="video",
        help="one similarity a video (default), for all videos, a frame, or none",
    )
    add(
        "--distance",
        choices=("surface", "points"),
        default="surface",
        help="from samples to the other surface itself, or to its samples",
    )
    add("--samples", type=int, default=10_000, metavar="N", help="samples of each surface (10000)")
    add("--every", type=int, default=1, metavar="N", help="meshes of every Nth frame only")
    add("--json", type=Path, metavar="FILE", help="write everything here, too")


def run(args: argparse.Namespace, results: Results) -> int:
    """Measure what there is truth for; print a table; exit 0."""
    from stages.ground_truth import looks

    if not args.truth.exists():
        raise BadInput("there is no such folder", where=args.truth)
    if args.samples < 100 or args.every < 1:
        raise BadInput("--samples must be at least 100 and --every at least 1")
    known = looks(args.truth)
    look = args.look or (known[0] if len(known) == 1 else None)
    if args.look and args.look not in known:
        raise BadInput(
            f"there is no look {args.look!r}", where=args.truth, hint=f"it has: {', '.join(known) or 'none'}"
        )
    wanted = args.only or PARTS
    found: dict[str, Any] = {"look": look}
    if "mesh" in wanted:
        found["mesh"] = _meshes(args, results)
    if look is None and (args.only is None and known):
        sys.stdout.write(f"poses, masks and flow: say which look with --look ({', '.join(known)})\n")
    if look is not None:
        truth = args.truth / look / "gt"
        for part, measure in (("pose", _poses), ("mask", _masks), ("flow", _flow)):
            if part in wanted:
                found[part] = measure(truth, results)
    elif args.only and set(args.only) - {"mesh"}:
        raise BadInput("poses, masks and flow belong to a look", hint=f"--look {' or '.join(known) or 'NAME'}")
    if not any(found.get(part) for part in PARTS):
        raise BadInput("there is nothing to measure", where=args.truth, hint="are the videos named as in the truth?")
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


# --------------------------------------------------------------------------------------------- surfaces


def _meshes(args: argparse.Namespace, results: Results) -> dict[str, Any] | None:
    from stages.ground_truth import read_surfaces
    from stages.scoring.metrics import REST_CM, sampling_floor
    from stages.scoring.surfaces import Surface

    truth = read_surfaces(args.truth)
    folder = args.meshes or results.folder("export").path / "meshes"
    names = [n for n in truth.vertices if (folder / n).is_dir()]
    if not names:
        hint = "the settings export.frame_meshes makes them" if args.meshes is None else "a folder a video is expected"
        raise BadInput("no meshes of these videos: " + ", ".join(truth.vertices), where=folder, hint=hint)
    out = sys.stdout.write
    out(f"surfaces, aligned by {args.align}, {args.distance} distance (cm; the rest shape counts as {REST_CM:g} cm)\n")
    out(f"{'':14}{'CD':>8}{'CD sum':>8}{'pred>gt':>9}{'gt>pred':>9}{'F@1%':>8}{'F@2%':>8}{'F@5%':>8}{'drift':>8}\n")
    found = _score_all(args, truth, folder, names)
    for name, row in found["videos"].items():
        out(_line(name, row))
    out(_line("all", found["all"]))
    first = truth.vertices[names[0]][0]
    edge = float((first.max(axis=0) - first.min(axis=0)).max())
    surface = Surface(first, truth.faces, args.samples)
    floor = sampling_floor(surface, edge, REST_CM / truth.rest_edge, args.distance)
    found["sampling_floor_cm"] = floor.chamfer_cm
    out(f"{found['all']['frames']} frames, {found['all']['missing']} without a mesh; ")
    out(f"the truth against itself, sampled anew: CD {floor.chamfer_cm:.3f}, F@2% {floor.f[2]:.2f}\n")
    return found


def _score_all(args: argparse.Namespace, truth: TrueSurfaces, folder: Path, names: list[str]) -> dict[str, Any]:
    """Scores of every video; surfaces of one video are held at a time unless all are aligned as one."""
    import numpy as np

    from stages.ground_truth import frame_meshes, read_mesh
    from stages.scoring.alignment import IDENTITY, Similarity, align, cube_rotations
    from stages.scoring.metrics import REST_CM, summarise, surface_score, tracking_error_cm
    from stages.scoring.surfaces import Surface

    cm, starts = REST_CM / truth.rest_edge, cube_rotations()
    missing: dict[str, int] = {}
    drift: dict[str, float] = {}
    scores: dict[str, list[SurfaceScore]] = {n: [] for n in names}
    held: list[tuple[str, Surface, Surface]] = []

    def settle(frames: list[tuple[str, Surface, Surface]]) -> None:
        if not frames:
            return
        common: Similarity | None = IDENTITY if args.align == "none" else None
        if args.align in ("video", "all"):
            common = align([p for _, p, _ in frames], [t for _, _, t in frames], starts)
        for name, p, t in progress(frames, len(frames), "comparing"):
            similarity = align([p], [t], starts) if common is None else common
            edge = float(np.ptp(t.vertices, axis=0).max())
            scores[name].append(surface_score(p, t, similarity, edge, cm, args.distance))
        if common is None:
            return
        for name in {n for n, _, _ in frames}:
            own = [(p, t) for n, p, t in frames if n == name]
            if len({len(p.vertices) for p, _ in own}) == 1:
                drift[name] = tracking_error_cm([p for p, _ in own], [t for _, t in own], common, cm)

    for name in names:
        vertices = truth.vertices[name]
        files = frame_meshes(folder / name, len(vertices))
        chosen = range(0, len(vertices), args.every)
        missing[name] = sum(i not in files for i in chosen)
        frames = [
            (name, Surface(*read_mesh(files[i]), args.samples), Surface(vertices[i], truth.faces, args.samples))
            for i in progress([c for c in chosen if c in files], label=f"reading {name}")
        ]
        if args.align == "all":
            held += frames
        else:
            settle(frames)
    settle(held)

    def row(parts: list[str]) -> dict[str, Any]:
        summary = summarise([s for n in parts for s in scores[n]], sum(missing[n] for n in parts))
        drifts = [drift[n] for n in parts if n in drift]
        return {
            "frames": summary.frames,
            "missing": summary.missing,
            "cd_cm": summary.chamfer_cm,
            "cd_sum_cm": summary.chamfer_sum_cm,
            "pred_to_gt_cm": summary.forth_cm,
            "gt_to_pred_cm": summary.back_cm,
            **{f"f{t}": value for t, value in summary.f.items()},
            "drift_cm": float(np.mean(drifts)) if drifts else None,
        }

    return {"align": args.align, "distance": args.distance, "videos": {n: row([n]) for n in names}, "all": row(names)}


def _line(name: str, row: dict[str, Any]) -> str:
    keys = ("cd_cm", "cd_sum_cm", "pred_to_gt_cm", "gt_to_pred_cm")
    distances = f"{row[keys[0]]:8.3f}{row[keys[1]]:8.3f}{row[keys[2]]:9.3f}{row[keys[3]]:9.3f}"
    drift = "" if row["drift_cm"] is None else f"{row['drift_cm']:8.2f}"
    return f"{name:14}{distances}{row['f1']:8.2f}{row['f2']:8.2f}{row['f5']:8.2f}{drift}\n"


# --------------------------------------------------------------------------------------------- poses, masks, flow


def _poses(truth: Path, results: Results) -> dict[str, Any] | None:
    import numpy as np

    from stages.ground_truth import read_rotations
    from stages.scoring.metrics import rotation_errors_deg

    cameras = results.folder("export").path / "cameras"
    pairs = {}
    for path in sorted(cameras.glob("*.json")):
        if (truth / path.name).is_file():
            pairs[path.stem] = read_rotations(path), read_rotations(truth / path.name)
            if len(pairs[path.stem][0]) != len(pairs[path.stem][1]):
                counts = " and ".join(str(len(r)) for r in pairs[path.stem])
                raise BadInput(f"{path.stem}: {counts} root poses, they must be as many", where=truth)
    if not pairs:
        return None
    error = rotation_errors_deg(*(np.concatenate([p[k] for p in pairs.values()]) for k in (0, 1)))
    sys.stdout.write("root poses, degrees, after one turn of the object's frame for all videos\n")
    found, start = {}, 0
    for name, (own, _) in pairs.items():
        found[name] = _spread(error[start : start + len(own)])
        start += len(own)
    found["all"] = _spread(error)
    for name, row in found.items():
        sys.stdout.write(f"{name:14}{row['mean']:8.2f} +- {row['std']:.2f}, median {row['median']:.2f}\n")
    return found


def _spread(values: np.ndarray) -> dict[str, float]:
    import numpy as np

    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "median": float(np.median(values)),
        "least": float(values.min()),
        "largest": float(values.max()),
    }


def _masks(truth: Path, results: Results) -> dict[str, Any] | None:
    import numpy as np

    from stages.formats import read_clip, read_grey
    from stages.ground_truth import read_true_masks
    from stages.scoring.metrics import mask_ious

    found: dict[str, Any] = {}
    for name in results.videos:
        path = truth / f"{name}-mask.npz"
        if not path.is_file():
            continue
        clip, folder = read_clip(results.folder("frames", name).path), results.folder("masks", name)
        own = np.stack([read_grey(folder / file) > 127 for file in clip.names])
        known = read_true_masks(path)
        if clip.source_idx[-1] >= len(known):
            raise BadInput(f"{name}: frame {clip.source_idx[-1]}, and {len(known)} true masks", where=truth)
        found[name] = _spread(mask_ious(own, known[clip.source_idx]))
    if found:
        sys.stdout.write("masks, intersection over union\n")
        for name, row in found.items():
            sys.stdout.write(f"{name:14}{row['mean']:8.3f}, least {row['least']:.3f}\n")
    return found or None


def _flow(truth: Path, results: Results) -> dict[str, Any] | None:
    import numpy as np

    from stages.formats import flow_path, read_flow
    from stages.ground_truth import read_true_flow
    from stages.scoring.metrics import endpoint_errors_px

    found: dict[str, Any] = {}
    for name in results.videos:
        path = truth / f"{name}-flow.npz"
        if not path.is_file():
            continue
        folder, known = results.folder("flow", name).path, read_true_flow(path)
        errors: list[tuple[np.ndarray, int]] = []
        for k, i in enumerate(known["frames"].tolist()):
            file = flow_path(folder, 1, i)
            if file.is_file():
                own = read_flow(file)[0]
                if own.shape != known["flow"][k].shape:
                    raise BadInput(
                        f"{name}: flow of {own.shape[:2]}, truth of {known['flow'][k].shape[:2]}", where=truth
                    )
                errors.append((endpoint_errors_px(own, known["flow"][k].astype(np.float64)), k))
        if errors:
            on = np.concatenate([e[known["object"][k].astype(bool)] for e, k in errors])
            visible = np.concatenate([e[known["visible"][k].astype(bool)] for e, k in errors])
            found[name] = {"object_px": float(on.mean()), "visible_px": float(visible.mean()), "pairs": len(errors)}
    if found:
        sys.stdout.write("flow to the next frame, mean endpoint error in pixels: visible object, whole object\n")
        for name, row in found.items():
            sys.stdout.write(f"{name:14}{row['visible_px']:8.3f}{row['object_px']:8.3f}\n")
    return found or None
