"""Text formats that other programs read: Wavefront OBJ with MTL, Biovision BVH, COLMAP's sparse model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stages.meshing.skeleton import Skeleton


def write_obj(
    vertices: np.ndarray,
    faces: np.ndarray,
    colour: np.ndarray,
    material_file: str,
    corner_uv: np.ndarray | None = None,
) -> str:
    """A mesh as Wavefront OBJ: colours (V, 3) in 0..1 behind the positions, as most programs read them.

    Args:
        vertices: (V, 3). faces: (F, 3). material_file: name of the MTL file beside it.
        corner_uv: (F, 3, 2) texture coordinates of each corner, v downward as in glTF; None for none.
    """
    lines = ["# banmo-pipeline: y up, z front", f"mtllib {material_file}", "o model", "usemtl surface"]
    lines += [
        f"v {x:.6g} {y:.6g} {z:.6g} {r:.4g} {g:.4g} {b:.4g}"
        for (x, y, z), (r, g, b) in zip(vertices.tolist(), np.clip(colour, 0, 1).tolist(), strict=True)
    ]
    if corner_uv is None:
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    else:
        flat = np.round(corner_uv.reshape(-1, 2), 6)
        uv, index = np.unique(flat, axis=0, return_inverse=True)
        lines += [f"vt {u:.6g} {1 - v:.6g}" for u, v in uv.tolist()]
        rows = np.concatenate([faces + 1, index.reshape(-1, 3) + 1], axis=1).tolist()
        lines += [f"f {a}/{i} {b}/{j} {c}/{k}" for a, b, c, i, j, k in rows]
    return "\n".join(lines) + "\n"


def write_mtl(texture_file: str | None) -> str:
    """A matte material called ``surface``, with a texture if there is one."""
    lines = ["newmtl surface", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "illum 1"]
    return "\n".join(lines + ([f"map_Kd {texture_file}"] if texture_file else [])) + "\n"


# --------------------------------------------------------------------------------------------- BVH


def even_times(time_s: np.ndarray) -> np.ndarray:
    """Times (N,) in even steps over the same span: the median step of times (T,), stretched to fit."""
    if len(time_s) < 2:
        return np.asarray(time_s, np.float64)
    span, step = float(time_s[-1] - time_s[0]), float(np.median(np.diff(time_s)))
    count = max(2, round(span / max(step, 1e-6)) + 1)
    return float(time_s[0]) + np.arange(count) * span / (count - 1)


def resample(transforms: np.ndarray, time_s: np.ndarray, wanted_s: np.ndarray) -> np.ndarray:
    """Rigid transforms (T, ..., 4, 4) at other times (N,): rotations slerped, translations linear."""
    if len(time_s) == len(wanted_s) and np.abs(time_s - wanted_s).max() < 1e-6:
        return transforms
    flat = transforms.reshape(len(transforms), -1, 4, 4)
    strictly = np.maximum.accumulate(time_s + np.arange(len(time_s)) * 1e-9)
    inside = np.clip(wanted_s, strictly[0], strictly[-1])
    result = np.tile(np.eye(4), (len(wanted_s), flat.shape[1], 1, 1))
    for k in range(flat.shape[1]):
        result[:, k, :3, :3] = Slerp(strictly, Rotation.from_matrix(flat[:, k, :3, :3]))(inside).as_matrix()
        for axis in range(3):
            result[:, k, axis, 3] = np.interp(inside, strictly, flat[:, k, axis, 3])
    return result.reshape(len(wanted_s), *transforms.shape[1:])


def write_bvh(skeleton: Skeleton, joints: np.ndarray, world_from_object: np.ndarray, time_s: np.ndarray) -> str:
    """The motion of the joints as BVH, y up, in units of the model; the first joint carries the root motion alone.

    Every joint has position and rotation channels, since ours may slip a little; a position replaces the OFFSET.
    Rotations are in degrees, Z X Y: ``R = Rz Rx Ry``. Uneven time stamps are resampled to even ones, as BVH knows no
    other.

    Args:
        skeleton: joints at rest. joints: (T, B, 4, 4) object_from_joint. world_from_object: (T, 4, 4), y up.
        time_s: (T,) seconds.
    """
    local = np.concatenate([world_from_object[:, None], skeleton.local(joints)], axis=1)
    even = even_times(time_s)
    local = resample(local, time_s, even)
    children: list[list[int]] = [[] for _ in range(len(skeleton))]
    for joint, parent in enumerate(skeleton.parent.tolist()):
        if parent >= 0:
            children[parent].append(joint)
    offset = skeleton.local(skeleton.rest)[:, :3, 3]
    lines, order = ["HIERARCHY", "ROOT root_motion", "{"], [0]
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"

    def body(indent: str, at: np.ndarray) -> None:
        lines.append(f"{indent}OFFSET {at[0]:.6f} {at[1]:.6f} {at[2]:.6f}")
        lines.append(indent + channels)

    def visit(joint: int, depth: int) -> None:
        indent = "\t" * depth
        order.append(joint + 1)
        lines.extend([f"{indent}JOINT {skeleton.names[joint]}", indent + "{"])
        body(indent + "\t", offset[joint])
        for child in children[joint]:
            visit(child, depth + 1)
        if not children[joint]:
            tip = skeleton.centre[joint] - skeleton.rest[joint, :3, 3]
            lines.extend([f"{indent}\tEnd Site", indent + "\t{"])
            lines.extend([f"{indent}\t\tOFFSET {tip[0]:.6f} {tip[1]:.6f} {tip[2]:.6f}", indent + "\t}"])
        lines.append(indent + "}")

    body("\t", np.zeros(3))
    for joint in np.flatnonzero(skeleton.parent < 0).tolist():
        visit(joint, 1)
    lines.append("}")
    step = float(even[1] - even[0]) if len(even) > 1 else 1.0
    lines += ["MOTION", f"Frames: {len(even)}", f"Frame Time: {step:.8f}"]
    ordered = local[:, order]
    angle = Rotation.from_matrix(ordered[..., :3, :3].reshape(-1, 3, 3)).as_euler("ZXY", degrees=True)
    values = np.concatenate([ordered[..., :3, 3], angle.reshape(*ordered.shape[:2], 3)], axis=-1)
    lines += [" ".join(f"{v:.5f}" for v in row) for row in values.reshape(len(even), -1).tolist()]
    return "\n".join(lines) + "\n"


# --------------------------------------------------------------------------------------------- COLMAP


def write_colmap(
    cameras: Sequence[tuple[str, np.ndarray, int, int, np.ndarray]],
) -> dict[str, str]:
    """``cameras.txt``, ``images.txt`` and ``points3D.txt`` of COLMAP's text format; the world is object space.

    Args:
        cameras: a video each: name, K (3, 3), width and height in pixels, camera_from_object (T, 4, 4). Images are
            called ``<name>/00042.png``; blanks in the name become ``_``, since COLMAP splits lines at them.
    """
    lens = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# (a line of 2D points each: none)"]
    count = 0
    for number, (name, k, width, height, poses) in enumerate(cameras, 1):
        values = " ".join(f"{v:.8g}" for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        lens.append(f"{number} PINHOLE {width} {height} {values}")
        quaternion = np.atleast_2d(Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True))
        folder = "_".join(name.split())
        for i, (x, y, z, w) in enumerate(quaternion.tolist()):
            count += 1
            place = " ".join(f"{v:.9g}" for v in (w, x, y, z, *poses[i, :3, 3].tolist()))
            images += [f"{count} {place} {number} {folder}/{i:05d}.png", ""]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]: none"]
    files = {"cameras.txt": lens, "images.txt": images, "points3D.txt": points}
    return {file: "\n".join(lines) + "\n" for file, lines in files.items()}
