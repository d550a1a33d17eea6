"""Sample clips of one generated animal or person in a room, filmed from several sides, with exact ground truth.

``python -m synthetic.clips OUT_DIR [--clips 3 --frames 40 --size 192 --seed 0 --truth]``

Writes ``OUT_DIR/<kind>-00.mp4`` ... (H.264). With ``--truth`` also what lies beside a clip when you already know the
answer: ``<clip>.masks.mp4`` (lossless) and ``<clip>.poses.json`` (root pose of every frame). With ``--motion`` also
``OUT_DIR/truth/<clip>.npz``: ``faces``, ``vertices`` (T, V, 3), ``joints`` (T, B, 3), ``bones`` (T, B, 4, 4: rest to
posed), ``bone_names``, ``parents``; object space.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated

import av
import numpy as np
import tyro

from synthetic import motion
from synthetic.bodies import KINDS, Body, quadruped, vary
from synthetic.clothes import clothes
from synthetic.coats import Coat, coat
from synthetic.people import person, vary_person
from synthetic.people_motion import perform_person
from synthetic.rendering import Camera, Look, draw, flow_between, look_at
from synthetic.rooms import make_room

log = logging.getLogger(__name__)

PERSON = "person"


@dataclass(frozen=True)
class Subject:
    """One individual: its body and what it wears."""

    kind: str
    body: Body
    coat: Coat


@dataclass(frozen=True)
class Film:
    """A clip and the truth about it. T frames of H x W pixels, V vertices; object space as in bodies.py."""

    name: str
    fps: int
    images: np.ndarray  # (T, H, W, 3) uint8
    masks: np.ndarray  # (T, H, W) bool
    intrinsics: np.ndarray  # (3, 3) pixels
    camera_from_object: np.ndarray  # (T, 4, 4) rigid root poses
    vertices: np.ndarray  # (T, V, 3) posed surface, object space
    body: Body
    bones: np.ndarray  # (T, B, 4, 4) rest to posed, object space

    @property
    def joints(self) -> np.ndarray:
        """(T, B, 3) where each bone's joint is, object space."""
        rest = np.stack([np.append(bone.joint, 1.0) for bone in self.body.bones])
        return np.einsum("tbij,bj->tbi", self.bones[:, :, :3], rest)

    def flow(self, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
        """Exact flow between two frames and where it is visible; see :func:`synthetic.rendering.flow_between`."""
        poses = self.camera_from_object
        size = self.masks.shape[1:]
        return flow_between(
            self.body, self.vertices[first], self.vertices[second], poses[first], poses[second], self.intrinsics, size
        )  # fmt: skip


def make_subject(seed: int, kind: str = "cat", pattern: str | None = None, palette: str | None = None) -> Subject:
    """An individual of a kind (a key of ``bodies.KINDS``, or ``person``).

    `pattern` and `palette` dress an animal, see :func:`synthetic.coats.coat`.
    """
    rng = np.random.default_rng([seed, 11])
    if kind == PERSON:
        grown = person(vary_person(rng, 0.03))
        return Subject(kind, grown, clothes(grown, rng))
    body = quadruped(vary(KINDS[kind], rng, 0.04))
    return Subject(kind, body, coat(body, rng, pattern, palette))


def film(subject: Subject, clip: int, clips: int, frames: int, size: int, seed: int, fps: int = 20) -> Film:
    """Film one clip: its own room, light and performance; cameras of all clips together go round the animal."""
    rng = np.random.default_rng([seed, 23, clip])
    times = np.arange(frames) / fps
    perform = perform_person if subject.kind == PERSON else motion.perform
    moving = perform(subject.body, motion.improvise(rng, frames / fps), times)
    room = make_room(rng)
    cameras = _orbit(rng, moving, 2 * np.pi * clip / clips, times, size)
    warm = rng.uniform(-0.05, 0.05)
    exposure = rng.uniform(0.92, 1.08)
    look = Look(sun=float(rng.uniform(0.55, 0.8)), sky=float(rng.uniform(0.5, 0.65)),
                gain=(exposure * (1 + warm), exposure, exposure * (1 - warm)))  # fmt: skip
    images, masks, poses, vertices = [], [], [], []
    for t in range(frames):
        posed = subject.body.skin(moving.bones[t])
        image, coverage = draw(subject.body, posed, moving.room_from_object[t], subject.coat, room, cameras[t],
                               (size, size), look, rng)  # fmt: skip
        images.append(image)
        masks.append(coverage >= 0.5)
        poses.append(cameras[t].camera_from_room @ moving.room_from_object[t])
        vertices.append(posed)
    return Film(
        f"{subject.kind}-{clip:02d}", fps, np.stack(images), np.stack(masks), cameras[0].intrinsics, np.stack(poses),
        np.stack(vertices), subject.body, moving.bones,
    )  # fmt: skip


def _orbit(
    rng: np.random.Generator, moving: motion.Motion, azimuth: float, times_s: np.ndarray, size: int
) -> list[Camera]:
    """A hand-held camera that follows the animal and walks part of the way round it."""
    focal = 1.35 * size
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    progress = times_s / max(float(times_s[-1]), 1e-6) - 0.5
    sweep = rng.choice([-1, 1]) * rng.uniform(1.4, 2.0)
    angle = azimuth + sweep * progress + rng.uniform(-0.2, 0.2)
    distance = 3.4 + 0.25 * np.sin(2 * np.pi * times_s / 5.0 + rng.uniform(0, 6))
    elevation = rng.uniform(0.18, 0.45) + 0.05 * np.sin(2 * np.pi * times_s / 4.0 + rng.uniform(0, 6))
    shake = _shake(rng, times_s, 6) * 0.035
    target = moving.room_from_object[:, :3, 3] + np.array([0, 0.02, 0])
    kernel = np.ones(9) / 9
    target = np.stack([np.convolve(np.pad(target[:, i], 4, mode="edge"), kernel, "valid") for i in range(3)], 1)
    cameras = []
    for t in range(len(times_s)):
        level, up = np.cos(elevation[t]), np.sin(elevation[t])
        offset = distance[t] * np.array([np.sin(angle[t]) * level, up, np.cos(angle[t]) * level])
        eye = target[t] + offset + shake[t, :3]
        cameras.append(Camera(intrinsics, look_at(eye, target[t] + shake[t, 3:], float(shake[t, 0]))))
    return cameras


def _shake(rng: np.random.Generator, times_s: np.ndarray, channels: int) -> np.ndarray:
    """Smooth hand tremor (T, channels) of about unit size."""
    waves = rng.uniform(0.3, 1.6, (4, channels))
    offsets = rng.uniform(0, 2 * np.pi, (4, channels))
    return np.sin(2 * np.pi * times_s[:, None, None] * waves + offsets).mean(1)


def write_video(path: Path, images: np.ndarray, fps: int, crf: int = 18, lossless: bool = False) -> None:
    """Write (T, H, W, 3) or (T, H, W) uint8 as H.264 in the container the suffix names; even sizes only."""
    with av.open(str(path), "w") as container:
        options = {"qp": "0"} if lossless else {"crf": str(crf)}
        # Without macroblock trees x264 writes the same bytes every time; with them its AVX-512 code does not.
        options |= {"preset": "veryfast", "x264-params": "mbtree=0"}
        stream = container.add_stream("libx264", rate=Fraction(fps), options={**options, "threads": "1"})
        stream.height, stream.width, stream.pix_fmt = images.shape[1], images.shape[2], "yuv420p"
        for image in images:
            rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
        container.mux(stream.encode())


def write_truth(folder: Path, made: Film) -> None:
    """Write true masks and root poses beside the clip, in the form the pipeline accepts."""
    write_video(folder / f"{made.name}.masks.mp4", made.masks.astype(np.uint8) * 255, made.fps, lossless=True)
    poses = {
        "convention": "OpenCV camera: x right, y down, z forward; x_camera = R x_object + t",
        "K": made.intrinsics.tolist(),
        "object_to_camera": made.camera_from_object.tolist(),
    }
    (folder / f"{made.name}.poses.json").write_text(json.dumps(poses) + "\n", encoding="utf-8")


def write_motion(folder: Path, made: Film) -> None:
    """Write the true surface, joints and bone transforms of every frame as an .npz; see the module's text."""
    folder.mkdir(parents=True, exist_ok=True)
    bones = made.body.bones
    np.savez_compressed(
        folder / f"{made.name}.npz",
        faces=made.body.faces.astype(np.int32),
        vertices=made.vertices.astype(np.float32),
        joints=made.joints.astype(np.float32),
        bones=made.bones.astype(np.float32),
        bone_names=np.array([b.name for b in bones]),
        parents=np.array([b.parent for b in bones], np.int32),
    )


def write_clips(
    folder: Path,
    clips: int = 3,
    frames: int = 40,
    size: int = 192,
    seed: int = 0,
    truth: bool = False,
    kind: str = "cat",
    with_motion: bool = False,
) -> list[Film]:
    """Film and write sample clips; returns them with their truth."""
    folder.mkdir(parents=True, exist_ok=True)
    usual = (
        {"pattern": "tabby", "palette": "ginger"} if seed == 0 and kind != PERSON else {}
    )  # the sample everyone sees first
    subject = make_subject(seed, kind, **usual)
    films = []
    for clip in range(clips):
        made = film(subject, clip, clips, frames, size, seed)
        write_video(folder / f"{made.name}.mp4", made.images, made.fps)
        if truth:
            write_truth(folder, made)
        if with_motion:
            write_motion(folder / "truth", made)
        films.append(made)
        log.info("wrote %s (%d frames)", folder / f"{made.name}.mp4", frames)
    return films


def main(
    out: Annotated[Path, tyro.conf.Positional],
    clips: int = 3,
    frames: int = 40,
    size: int = 192,
    seed: int = 0,
    kind: str = "cat",
    truth: bool = False,
    motion: bool = False,
) -> None:
    """Write sample clips of a generated animal or person.

    Args:
        out: Folder to write to; made if missing.
        clips: How many clips; their cameras share the way round the animal.
        frames: Frames a clip, at 20 a second.
        size: Side of the square picture in pixels, even.
        seed: Another seed, another animal.
        kind: cat, dog, fox, horse or person.
        truth: Also write true masks and root poses beside the clips.
        motion: Also write true surfaces, joints and bones of every frame, into a folder `truth`.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    write_clips(out, clips, frames, size, seed, truth, kind, motion)


if __name__ == "__main__":
    tyro.cli(main)
