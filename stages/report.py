"""Stage: one page that explains the result to a person, without a network: ``report.html``.

It holds the model, every clip beside its overlay, what each stage saw, curves and advice. Times and reasons of the
run are no part of a result (they differ from run to run); whoever copies the page to ``exports/`` puts them in.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline import BadInput, Folder, Resources, Run, Scene, stage
from stages import formats
from stages.animating.glb import GlbError, read_glb
from stages.perception.sheets import feature_colours, flow_colours, mask_overlay
from stages.registration.sheets import draw_pose
from stages.reporting import page, pictures, views
from stages.reporting.clips import Shrunk, shrink_video

_CURVES = {
    "total": "All terms together",
    "silhouette": "Silhouettes",
    "rgb": "Colours",
    "flow": "Motion in the picture (flow)",
    "feature": "Embedding",
    "match": "Matching",
    "cycle_2d": "Matching, back onto the pixel",
    "cycle_3d": "Bending there and back",
    "eikonal": "Smooth distances",
    "motion": "Jerk of the bones",
}
_ORDER = ("frames", "masks", "flow", "features", "poses", "fit", "correct", "refine", "export", "report")
_VERDICTS = {"good": "good", "usable with care": "care"}


@dataclass(frozen=True)
class ReportSettings:
    """What the page holds; it grows with the clips."""

    video_megabytes: float = 12.0
    """Clips in the page, all together; they are made smaller until they fit."""
    clips: int = 24
    """Clips that are shown with pictures; the others are listed with their figures."""


@stage(per=Scene, version=1, needs=Resources(cpus=1), data=("reporting/static/*",))
def report(
    export: Folder,
    fit: Folder,
    correct: Folder,
    refine: Folder,
    frames: dict[str, Folder],
    masks: dict[str, Folder],
    flow: dict[str, Folder],
    features: dict[str, Folder],
    poses: Folder,
    settings: ReportSettings,
    out: Path,
    run: Run,
) -> None:
    """A page that explains the result: the model to turn, clips beside overlays, what was seen, curves, advice."""
    if settings.clips < 0 or not 0 <= settings.video_megabytes <= 500:
        raise BadInput("report.clips is a count and report.video_megabytes lies in 0..500")
    quality = formats.read_json(export / "quality.json")
    names = list(frames)
    clips, azimuths = [], []
    shown = names[: settings.clips]
    budget = int(settings.video_megabytes * 1e6 / max(1, len(shown)))
    for name in run.progress(names, label="clips"):
        clip = formats.read_clip(frames[name].path)
        cameras = formats.read_poses(export / "cameras" / f"{name}.json").object_to_camera
        directions = views.camera_directions(cameras)
        azimuths.append(directions[:, 0])
        entry = _clip_facts(name, clip, quality.get("videos", {}).get(name, {}), directions)
        if name in shown:
            overlay = export / f"overlay-{name}.mp4"
            video = shrink_video(overlay, budget) if overlay.is_file() and budget else Shrunk(b"")
            entry["video"] = pictures.uri("video/mp4", video.data) if video.data else ""
            track = formats.read_poses(poses / f"{name}.json")
            entry["strips"] = _strips(clip, masks[name], flow[name], features[name], track)
        clips.append(entry)
    model = (export / "model.glb").read_bytes()
    sides, unseen = _sides(model)
    azimuth = np.concatenate(azimuths)
    advice = [str(s) for s in quality.get("advice", [])]
    advice += views.view_advice(azimuth, sides)
    for name in names:
        rows = quality.get("videos", {}).get(name, {}).get("frames", [])
        iou = [float(r["iou"]) for r in rows if r.get("iou") is not None]
        confidence = [float(r.get("mask_confidence", 1.0)) for r in rows]
        advice += views.clip_advice(name, iou, confidence, [list(r.get("flags", [])) for r in rows])
    data = {
        "title": _title(names),
        "verdict": str(quality.get("verdict", "")),
        "verdict_class": _VERDICTS.get(str(quality.get("verdict", "")), "bad"),
        "summary": _summary(quality, clips),
        "figures": _figures(quality, clips, unseen),
        "advice": list(dict.fromkeys(advice)),
        "seen_text": _seen_text(unseen if unseen is not None else quality.get("unseen_area")),
        "sides": [[name, 1 - share] for name, share in sides.items()],
        "clips": clips,
        **_curves([("fit", fit), ("correct", correct), ("refine", refine)]),
        "root_poses": _root_poses(poses),
        "stages": list(_ORDER),
        "three": "r187",
    }
    text = page.render(data, pictures.uri("model/gltf-binary", model))
    (out / "report.html").write_text(text, encoding="utf-8")
    run.metric("megabytes", round(len(text) / 1e6, 2))


@report.check
def _check(out: Path) -> None:
    """The page is whole, and nothing in it can be fetched from elsewhere."""
    text = (out / "report.html").read_text(encoding="utf-8")
    if not text.rstrip().endswith("</html>") or text.count(page.PROVENANCE_MARK) != 1:
        raise formats.FormatError("report.html is not whole")


# --------------------------------------------------------------------------------------------- parts


def _title(names: list[str]) -> str:
    stem = names[0]
    for name in names[1:]:
        while stem and not name.startswith(stem):
            stem = stem[:-1]
    stem = stem.rstrip("-_. 0")
    return stem if len(stem) >= 3 else ", ".join(names[:3]) + (" …" if len(names) > 3 else "")


def _summary(quality: dict[str, Any], clips: list[dict[str, Any]]) -> str:
    frames = sum(c["frames"] for c in clips)
    count = f"{len(clips)} clips" if len(clips) > 1 else "one clip"
    return (
        f"An animatable model from {count}, {frames} frames; trust {100 * float(quality.get('trust', 0)):.0f} of 100."
    )


def _figures(quality: dict[str, Any], clips: list[dict[str, Any]], unseen: float | None) -> list[dict[str, str]]:
    iou = quality.get("iou_mean")
    part = unseen if unseen is not None else quality.get("unseen_area")
    found = [
        ("Trust", f"{100 * float(quality.get('trust', 0)):.0f}", "of 100", "how far the result is backed by the clips"),
        (
            "Outlines agree",
            "–" if iou is None else f"{100 * float(iou):.0f}",
            "" if iou is None else "%",
            "model against masks, mean over frames (intersection over union)",
        ),
        ("Surface seen", "–" if part is None else f"{100 * (1 - float(part)):.0f}", "%", "the rest is made up"),
        ("Clips", str(len(clips)), "", f"{sum(c['frames'] for c in clips)} frames"),
        ("Triangles", f"{int(quality.get('faces', 0)):,}", "", "in model.glb"),
    ]
    return [dict(zip(("name", "value", "unit", "about"), row, strict=True)) for row in found]


def _seen_text(unseen: float | None) -> str:
    if unseen is None:
        return "The files do not say which part of the surface was seen."
    return f"{100 * (1 - unseen):.0f} % of the surface was seen in some frame; {100 * unseen:.0f} % never was."


def _clip_facts(name: str, clip: formats.Clip, facts: dict[str, Any], directions: np.ndarray) -> dict[str, Any]:
    """Figures of one clip; `directions` (N, 2) of all source frames."""
    start = float(clip.source_time_s[0])
    rows = facts.get("frames", [])
    agreement = [
        [round(float(clip.source_time_s[int(r["source_idx"])]) - start, 4), float(r["iou"])]
        for r in rows
        if r.get("iou") is not None
    ]
    length = float(clip.source_time_s[-1]) - start
    about = f"{len(clip.source_time_s)} frames, {length:.1f} s, {clip.width} × {clip.height}"
    if facts.get("iou_mean") is not None:
        about += (
            f"; outlines agree {100 * float(facts['iou_mean']):.0f} %, worst {100 * float(facts['iou_worst']):.0f} %"
        )
    step = max(1, len(directions) // 150)
    return {
        "name": name,
        "frames": len(clip.source_time_s),
        "seconds": round(length, 4),
        "about": about,
        "agreement": agreement,
        "directions": np.round(directions[::step], 1).tolist(),
        "video": "",
        "strips": [],
    }


def _strips(
    clip: formats.Clip, masks: Folder, flow: Folder, features: Folder, track: formats.PoseTrack
) -> list[dict[str, str]]:
    """Masks, flow, embedding and root poses at a few frames of one clip."""
    chosen = pictures.spread(len(clip))
    boxes = formats.read_mask_facts(masks.path).box
    images = [clip.image(int(i)) for i in chosen]
    cut = [formats.read_grey(masks / clip.names[int(i)]) for i in chosen]
    outlined = [mask_overlay(image, mask) for image, mask in zip(images, cut, strict=True)]
    moved = []
    for i, mask in zip(chosen.tolist(), cut, strict=True):
        step, backward = (1, False) if i + 1 < len(clip) else (1, True)
        path = formats.flow_path(flow.path, step, int(clip.source_idx[i]), backward)
        if path.is_file():
            motion, confidence = formats.read_flow(path)
            moved.append(flow_colours(motion, confidence * (mask > 127)))
        else:
            moved.append(np.full((*mask.shape, 3), 40, np.uint8))
    values, _ = formats.read_features(features.path)
    embedded = [cv2.resize(p, (224, 224)) for p in feature_colours(np.asarray(values[chosen], np.float32))]
    posed = [
        draw_pose(image, track.intrinsics, track.object_to_camera[int(i)])
        for image, i in zip(images, chosen, strict=True)
    ]

    def near(found: list[np.ndarray], margin: float) -> list[np.ndarray]:
        return [pictures.crop_to(p, boxes, int(i), margin) for p, i in zip(found, chosen, strict=True)]

    rows = (
        ("Masks", near(outlined, 1.35), "the subject as it was cut out"),
        ("Flow", near(moved, 1.35), "hue: direction of motion to the next frame; brightness: confidence"),
        ("Embedding", embedded, "like colours mean like places on the body (principal components)"),
        ("Root poses", near(posed, 1.9), "red: the subject's left, green: up, blue: front"),
    )
    return [{"name": n, "about": a, "picture": pictures.jpeg_uri(pictures.strip(p))} for n, p, a in rows]


def _curves(phases: list[tuple[str, Folder]]) -> dict[str, Any]:
    """Terms of the objective over the steps of all phases."""
    series: dict[str, list[list[float]]] = {}
    marks, offset = [], 0.0
    for name, folder in phases:
        path = folder / "metrics.jsonl"
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []
        marks.append([offset, name])
        for row in rows:
            for term in _CURVES:
                if isinstance(row.get(term), int | float):
                    series.setdefault(term, []).append([offset + float(row["step"]), float(row[term])])
        offset += float(rows[-1]["step"]) if rows else 0.0
    curves = [{"name": text, "points": series[term]} for term, text in _CURVES.items() if term in series]
    return {"curves": curves, "phases": marks, "steps": offset}


def _root_poses(poses: Folder) -> list[dict[str, str]]:
    rows = formats.read_json(poses / "poses.json").get("videos", {})
    return [
        {"name": name, "provider": str(row.get("provider", "")), "trust": f"{100 * float(row.get('trust', 0)):.0f} %"}
        for name, row in rows.items()
    ]


def _sides(data: bytes) -> tuple[dict[str, float], float | None]:
    """Unseen share of each side and of the whole surface, from the file's attribute ``_SEEN``; empty without it."""
    try:
        glb = read_glb(data)
        seen, vertices, normals = glb.attribute("_SEEN"), glb.attribute("POSITION"), glb.attribute("NORMAL")
        if seen is None or vertices is None or normals is None:
            return {}, None
        area = views.vertex_area(vertices.astype(np.float64), glb.faces())
    except GlbError:
        return {}, None
    ever = seen[:, 0] > 0
    return views.unseen_by_side(normals, area, ever), float(area[~ever].sum() / max(area.sum(), 1e-12))
