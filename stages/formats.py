"""Typed readers and writers of every folder that flows between stages.

One folder a stage and video (or a stage and collection); see the table in docs/workspace.md. Every reader
raises :class:`FormatError` with one sentence when a folder does not hold what it should. Nothing here unpickles.

Frames are named by their index in the source clip (``00042.png``), so names survive dropped frames.
``frame_idx`` counts kept frames from 0; ``source_idx`` is the index in the source clip.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

FLOW_STEPS = (1, 2, 4, 8, 16, 32)
FEATURE_SIZE = 112
FEATURE_CHANNELS = 16


class FormatError(ValueError):
    """A folder or file does not hold what its format promises."""


# --------------------------------------------------------------------------------------------- json and images


def read_json(path: Path) -> Any:
    """Read one JSON file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise FormatError(f"{path.name}: cannot be read as JSON ({error})") from error


def write_json(path: Path, value: Any) -> None:
    """Write one JSON file; NaN is refused, keys keep their order, bytes are the same for the same value."""
    path.write_text(json.dumps(value, allow_nan=False, indent=1) + "\n", encoding="utf-8")


def read_image(path: Path) -> np.ndarray:
    """Read an sRGB image, (H, W, 3) uint8."""
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise FormatError(f"{path.name}: not an image")
    return np.ascontiguousarray(image[:, :, ::-1])


def read_grey(path: Path) -> np.ndarray:
    """Read a one-channel 8-bit image, (H, W) uint8."""
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise FormatError(f"{path.name}: not an image")
    return image


def write_image(path: Path, image: np.ndarray) -> None:
    """Write (H, W, 3) RGB uint8 or (H, W) uint8 as PNG."""
    bgr = image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
    ok, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise FormatError(f"{path.name}: cannot encode an image of shape {image.shape}")
    data.tofile(path)


def frame_name(source_idx: int) -> str:
    """File name of a frame: ``00042.png``."""
    return f"{source_idx:05d}.png"


# --------------------------------------------------------------------------------------------- frames


@dataclass(frozen=True)
class Clip:
    """The ``frames`` folder of one video: T kept frames of H x W pixels, times in seconds.

    ``source_time_s`` lists the times of *all* frames of the source, kept or not: exports cover them all.
    """

    root: Path
    width: int
    height: int
    source_idx: np.ndarray  # (T,) int64, strictly increasing
    source_time_s: np.ndarray  # (N,) float64, N >= T
    focal_hint_px: float | None = None  # from metadata, in pixels of the kept frames
    rotation_deg: int = 0  # clockwise, already applied

    def __len__(self) -> int:
        return len(self.source_idx)

    @property
    def time_s(self) -> np.ndarray:
        """(T,) float64: time of each kept frame."""
        return self.source_time_s[self.source_idx]

    @property
    def names(self) -> list[str]:
        """File name of each kept frame."""
        return [frame_name(int(i)) for i in self.source_idx]

    def image(self, frame_idx: int) -> np.ndarray:
        """One kept frame, (H, W, 3) uint8 sRGB."""
        return read_image(self.root / self.names[frame_idx])

    def images(self) -> np.ndarray:
        """All kept frames, (T, H, W, 3) uint8 sRGB."""
        return np.stack([self.image(i) for i in range(len(self))])


def read_clip(root: Path) -> Clip:
    """Read a ``frames`` folder."""
    info = read_json(root / "frames.json")
    try:
        frames = info["frames"]
        focal = info.get("focal_hint_px")
        clip = Clip(
            root=root,
            width=int(info["width"]),
            height=int(info["height"]),
            source_idx=np.array([f["source_idx"] for f in frames], np.int64),
            source_time_s=np.array(info["source_time_s"], np.float64),
            focal_hint_px=None if focal is None else float(focal),
            rotation_deg=int(info.get("rotation_deg", 0)),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"frames.json: {error!r} missing or malformed") from error
    if len(clip) == 0 or (np.diff(clip.source_idx) <= 0).any() or clip.source_idx[-1] >= len(clip.source_time_s):
        raise FormatError("frames.json: frame indices must increase and lie inside the source clip")
    return clip


def write_clip_info(clip: Clip, root: Path, extra: dict[str, Any] | None = None) -> None:
    """Write ``frames.json`` beside the frames; `extra` adds keys for people to read."""
    frames = [
        {"name": n, "source_idx": int(i), "time_s": float(t)}
        for n, i, t in zip(clip.names, clip.source_idx, clip.time_s, strict=True)
    ]
    write_json(
        root / "frames.json",
        {
            "width": clip.width,
            "height": clip.height,
            "rotation_deg": clip.rotation_deg,
            "focal_hint_px": clip.focal_hint_px,
            **(extra or {}),
            "frames": frames,
            "source_time_s": [float(t) for t in clip.source_time_s],
        },
    )


# --------------------------------------------------------------------------------------------- masks


def read_masks(root: Path, clip: Clip) -> np.ndarray:
    """Foreground probability of every kept frame, (T, H, W) uint8 (255 = object)."""
    masks = np.stack([read_grey(root / name) for name in clip.names])
    if masks.shape != (len(clip), clip.height, clip.width):
        raise FormatError(f"masks are {masks.shape[2]}x{masks.shape[1]}, frames {clip.width}x{clip.height}")
    return masks


@dataclass(frozen=True)
class MaskFacts:
    """What ``masks.json`` says of each kept frame."""

    provider: str
    box: np.ndarray  # (T, 4) float: x0, y0, x1, y1 in pixels; zeros where the object is missing
    area: np.ndarray  # (T,) float, fraction of the image
    confidence: np.ndarray  # (T,) float in 0..1
    flags: list[list[str]]  # a frame: subset of "missing", "border", "jumped"


def write_mask_facts(root: Path, facts: MaskFacts, clip: Clip, extra: dict[str, Any] | None = None) -> None:
    """Write ``masks.json``."""
    rows = [
        {
            "name": name,
            "box": [round(float(v), 2) for v in facts.box[i]],
            "area": round(float(facts.area[i]), 6),
            "confidence": round(float(facts.confidence[i]), 4),
            "flags": facts.flags[i],
        }
        for i, name in enumerate(clip.names)
    ]
    write_json(root / "masks.json", {"provider": facts.provider, **(extra or {}), "frames": rows})


def read_mask_facts(root: Path) -> MaskFacts:
    """Read ``masks.json``."""
    info = read_json(root / "masks.json")
    try:
        rows = info["frames"]
        return MaskFacts(
            provider=str(info["provider"]),
            box=np.array([r["box"] for r in rows], np.float64).reshape(len(rows), 4),
            area=np.array([r["area"] for r in rows], np.float64),
            confidence=np.array([r["confidence"] for r in rows], np.float64),
            flags=[list(r["flags"]) for r in rows],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"masks.json: {error!r} missing or malformed") from error


# --------------------------------------------------------------------------------------------- flow


def flow_path(root: Path, step: int, source_idx: int, backward: bool = False) -> Path:
    """Where the flow from one frame to the kept frame `step` later (earlier if `backward`) lies."""
    return root / f"{'bw' if backward else 'fw'}-{step:02d}" / frame_name(source_idx)


def write_flow(path: Path, flow: np.ndarray, confidence: np.ndarray) -> None:
    """Write (H, W, 2) flow in pixels and (H, W) confidence in 0..1 as KITTI's 16-bit PNG.

    Steps of 1/64 px, range +-512 px; the third channel is the confidence times 65535 (zero = invalid).
    """
    encoded = np.empty((*flow.shape[:2], 3), np.uint16)
    valid = np.round(np.clip(confidence, 0, 1) * 65535.0).astype(np.uint16)
    uv = np.clip(np.round(flow * 64.0 + 32768.0), 0, 65535).astype(np.uint16)
    uv[valid == 0] = 0  # what nobody may read costs no bytes
    encoded[..., 0], encoded[..., 1], encoded[..., 2] = valid, uv[..., 1], uv[..., 0]
    ok, data = cv2.imencode(".png", encoded, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise FormatError(f"{path.name}: cannot encode flow of shape {flow.shape}")
    data.tofile(path)


def read_flow(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read flow (H, W, 2) float32 in pixels and confidence (H, W) float32; zero flow where invalid."""
    data = np.fromfile(path, np.uint8)
    encoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if encoded is None or encoded.dtype != np.uint16 or encoded.ndim != 3:
        raise FormatError(f"{path.name}: not a 16-bit flow PNG")
    confidence = encoded[..., 0].astype(np.float32) / 65535.0
    flow = (encoded[..., 2:0:-1].astype(np.float32) - 32768.0) / 64.0
    flow[confidence == 0] = 0.0
    return flow, confidence


# --------------------------------------------------------------------------------------------- features


def read_features(root: Path) -> tuple[np.ndarray, np.ndarray]:
    """Embeddings (T, 112, 112, 16) float16 (memory-mapped) and crop boxes (T, 4) x0, y0, x1, y1 in pixels.

    Cell (row r, column c) of the map is centred on pixel x0 + (c + 0.5) (x1 - x0) / 112, likewise y.
    """
    try:
        features = np.load(root / "features.npy", mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise FormatError(f"features.npy: {error}") from error
    info = read_json(root / "features.json")
    boxes = np.array([row["crop"] for row in info["frames"]], np.float64).reshape(-1, 4)
    if features.shape != (len(boxes), FEATURE_SIZE, FEATURE_SIZE, FEATURE_CHANNELS):
        raise FormatError(f"features.npy has shape {features.shape}, features.json {len(boxes)} frames")
    return features, boxes


# --------------------------------------------------------------------------------------------- poses


@dataclass(frozen=True)
class PoseTrack:
    """Root poses of one video, at its kept frames: ``x_cam = R x_obj + t`` (OpenCV camera)."""

    intrinsics: np.ndarray  # (3, 3) float64, pixels
    object_to_camera: np.ndarray  # (T, 4, 4) float64, rigid
    confidence: np.ndarray  # (T,) float in 0..1
    provider: list[str]  # who spoke, a frame
    wave_rad: tuple[float, float, float] | None = None
    """By how much the rotations may be off about object space's axes, slowly: root mean square; None if unknown."""


def write_poses(path: Path, track: PoseTrack, clip: Clip) -> None:
    """Write ``<video>.json``."""
    write_json(
        path,
        {
            "K": [[float(v) for v in row] for row in track.intrinsics],
            "object_to_camera": [[[float(v) for v in row] for row in m] for m in track.object_to_camera],
            "source_idx": [int(i) for i in clip.source_idx],
            "time_s": [float(t) for t in clip.time_s],
            "confidence": [round(float(c), 4) for c in track.confidence],
            "provider": track.provider,
            "wave_rad": None if track.wave_rad is None else [float(w) for w in track.wave_rad],
        },
    )


def read_poses(path: Path) -> PoseTrack:
    """Read ``<video>.json`` as a stage wrote it."""
    info = read_json(path)
    try:
        poses = np.array(info["object_to_camera"], np.float64)
        track = PoseTrack(
            intrinsics=np.array(info["K"], np.float64).reshape(3, 3),
            object_to_camera=poses.reshape(-1, 4, 4),
            confidence=np.array(info.get("confidence", [1.0] * len(poses)), np.float64),
            provider=list(info.get("provider", ["given"] * len(poses))),
            wave_rad=(float(w[0]), float(w[1]), float(w[2])) if (w := info.get("wave_rad")) else None,
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path.name}: {error!r} missing or malformed") from error
    if not (len(track.object_to_camera) == len(track.confidence) == len(track.provider)):
        raise FormatError(f"{path.name}: lists of different lengths")
    check_rigid(track.object_to_camera, path.name)
    return track


def check_rigid(transforms: np.ndarray, name: str, tolerance: float = 1e-3) -> None:
    """Refuse (T, 4, 4) transforms that are not finite or whose 3x3 part is not a rotation."""
    if not np.isfinite(transforms).all():
        bad = int(np.argmax(~np.isfinite(transforms).all(axis=(1, 2))))
        raise FormatError(f"{name}: pose of frame {bad} is not finite")
    rotation = transforms[:, :3, :3]
    error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad_rows = (error > tolerance) | (np.linalg.det(rotation) < 0)
    bad_rows |= np.abs(transforms[:, 3] - np.array([0, 0, 0, 1.0])).max(axis=1) > tolerance
    if bad_rows.any():
        raise FormatError(f"{name}: pose of frame {int(np.argmax(bad_rows))} is not a rigid transform")


# --------------------------------------------------------------------------------------------- model


def write_model(root: Path, tensors: dict[str, Any], description: dict[str, Any]) -> None:
    """Write ``model.safetensors`` (name -> torch tensor) and ``model.json`` (architecture, bounds, videos)."""
    from safetensors.torch import save_file

    save_file({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, root / "model.safetensors")
    write_json(root / "model.json", description)


def read_model(root: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read what :func:`write_model` wrote: tensors and description."""
    from safetensors.torch import load_file

    try:
        tensors = load_file(root / "model.safetensors")
    except Exception as error:  # safetensors raises its own untyped error for damaged files
        raise FormatError(f"model.safetensors: {error}") from error
    return tensors, read_json(root / "model.json")


def read_collection(folders: dict[str, Any], names: Sequence[str]) -> dict[str, Clip]:
    """Clips of a scene stage's ``frames`` input, sorted as `names`."""
    return {name: read_clip(Path(folders[name].path)) for name in names}
