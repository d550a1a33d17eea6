"""OBJ, BVH, COLMAP text and USDZ read back by other means; coarse meshes; joints named by place."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.meshing import textfiles, usdz
from stages.meshing.coarse import coarse_subset
from stages.meshing.gltf import RiggedMesh
from stages.meshing.naming import kind_of_body, name_by_place
from stages.meshing.skeleton import Skeleton
from stages.meshing.surface import Mesh, clean_surface, extract


def ball(radius: float = 1.0, cells: int = 40) -> Mesh:
    """A sphere."""
    bounds = np.array([[-1.3] * 3, [1.3] * 3])
    return clean_surface(extract(lambda p: p.norm(dim=-1) - radius, bounds, cells), 100_000)[0]


def chain(count: int = 3) -> Skeleton:
    """Joints along x, a unit apart, each the parent of the next, turned a little at rest."""
    rest = np.tile(np.eye(4), (count, 1, 1))
    rest[:, 0, 3] = np.arange(count)
    rest[:, :3, :3] = Rotation.from_rotvec(np.outer(np.linspace(0, 0.7, count), [0, 1, 0])).as_matrix()
    centre = rest[:, :3, 3] + [0.5, 0, 0]
    names = ["root", "a joint", "tip é", *map(str, range(count))][:count]
    return Skeleton(names, np.arange(count), np.arange(count) - 1, rest, centre)


def motion(skeleton: Skeleton, frames: int, seed: int = 0) -> np.ndarray:
    """(T, B, 4, 4) rigid motions of every joint."""
    rng = np.random.default_rng(seed)
    result = np.tile(np.eye(4), (frames, len(skeleton), 1, 1))
    vectors = rng.normal(size=(frames * len(skeleton), 3))
    result[..., :3, :3] = Rotation.from_rotvec(vectors).as_matrix().reshape(frames, len(skeleton), 3, 3)
    result[..., :3, 3] = rng.normal(size=(frames, len(skeleton), 3))
    return result


# --------------------------------------------------------------------------------------------- OBJ


def test_obj_holds_positions_colours_and_texture_coordinates() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]])
    faces = np.array([[0, 1, 2], [0, 3, 1]])
    uv = np.random.default_rng(0).random((2, 3, 2))
    lines = textfiles.write_obj(vertices, faces, np.full((4, 3), 0.25), "rest.mtl", uv).splitlines()
    assert "mtllib rest.mtl" in lines and "usemtl surface" in lines
    points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(points, np.hstack([vertices, np.full((4, 3), 0.25)]))
    texture = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], float)
    corners = [[part.split("/") for part in line.split()[1:]] for line in lines if line.startswith("f ")]
    index = np.array(corners, int) - 1
    np.testing.assert_array_equal(index[..., 0], faces)
    np.testing.assert_allclose(texture[index[..., 1]] * [1, -1] + [0, 1], uv, atol=1e-5)


# --------------------------------------------------------------------------------------------- BVH


class Bvh:
    """A reading of BVH by its own rules: a tree of joints, channels, frames."""

    def __init__(self, text: str) -> None:
        head, tail = text.split("MOTION")
        words = head.split()
        self.names: list[str] = []
        self.parent: list[int] = []
        self.channels: list[list[str]] = []
        open_joints: list[int] = []
        at = 0
        while at < len(words):
            if words[at] in ("ROOT", "JOINT"):
                end = words.index("{", at)
                self.names.append(" ".join(words[at + 1 : end]))
                self.parent.append(open_joints[-1] if open_joints else -1)
                open_joints.append(len(self.names) - 1)
                at = end
            elif words[at] == "End":
                at = words.index("}", at)
            elif words[at] == "CHANNELS":
                count = int(words[at + 1])
                self.channels.append(words[at + 2 : at + 2 + count])
                at += count + 1
            elif words[at] == "}":
                open_joints.pop()
            at += 1
        lines = tail.strip().splitlines()
        self.frame_time_s = float(lines[1].split(":")[1])
        self.values = np.array([line.split() for line in lines[2:]], float)
        assert len(self.values) == int(lines[0].split(":")[1])

    def globals_at(self, frame: int) -> np.ndarray:
        """(J, 4, 4) by forward kinematics: position, then the rotations in the order of the channels."""
        result, at = np.tile(np.eye(4), (len(self.names), 1, 1)), 0
        for joint, channels in enumerate(self.channels):
            local = np.eye(4)
            for channel in channels:
                value, step = self.values[frame, at], np.eye(4)
                if channel.endswith("position"):
                    step["XYZ".index(channel[0]), 3] = value
                else:
                    step[:3, :3] = Rotation.from_euler(channel[0].lower(), value, degrees=True).as_matrix()
                local, at = local @ step, at + 1
            result[joint] = local if self.parent[joint] < 0 else result[self.parent[joint]] @ local
        return result


def test_bvh_moves_the_joints_as_we_do() -> None:
    skeleton = chain(3)
    joints, time_s = motion(skeleton, 5), np.arange(5) / 20
    world = motion(skeleton, 5, 1)[:, 0]
    bvh = Bvh(textfiles.write_bvh(skeleton, joints, world, time_s))
    assert bvh.names == ["root_motion", *skeleton.names]
    assert bvh.parent == [-1, 0, 1, 2]
    assert bvh.frame_time_s == pytest.approx(1 / 20)
    for frame in range(5):
        np.testing.assert_allclose(bvh.globals_at(frame)[0], world[frame], atol=1e-4)
        np.testing.assert_allclose(bvh.globals_at(frame)[1:], world[frame] @ joints[frame], atol=1e-3)


def test_bvh_of_uneven_times_is_resampled_evenly() -> None:
    skeleton, time_s = chain(2), np.array([0.0, 0.1, 0.2, 0.5])  # two frames were lost
    joints = np.tile(skeleton.rest, (4, 1, 1, 1))
    joints[:, 1, 0, 3] += time_s  # steady speed
    bvh = Bvh(textfiles.write_bvh(skeleton, joints, np.tile(np.eye(4), (4, 1, 1)), time_s))
    assert len(bvh.values) == 6 and bvh.frame_time_s == pytest.approx(0.1)
    moved = [bvh.globals_at(f)[2, 0, 3] for f in range(6)]
    np.testing.assert_allclose(np.diff(moved), 0.1, atol=1e-4)


def test_bvh_of_one_frame() -> None:
    skeleton = chain(2)
    bvh = Bvh(textfiles.write_bvh(skeleton, skeleton.rest[None], np.eye(4)[None], np.array([3.0])))
    assert len(bvh.values) == 1 and bvh.frame_time_s > 0


# --------------------------------------------------------------------------------------------- COLMAP


def test_colmap_text_is_read_by_colmap(tmp_path: object) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    poses = motion(chain(1), 4)[:, 0]
    k = np.array([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]])
    files = textfiles.write_colmap([("clip 1", k, 320, 240, poses[:3]), ("b", k, 320, 240, poses[3:])])
    for name, text in files.items():
        (tmp_path / name).write_text(text)  # type: ignore[operator]
    model = pycolmap.Reconstruction(str(tmp_path))
    assert len(model.cameras) == 2 and len(model.images) == 4
    found = {image.name: image for image in model.images.values()}
    for i in range(3):
        image = found[f"clip_1/{i:05d}.png"]
        transform = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        np.testing.assert_allclose(transform.matrix(), poses[i, :3], atol=1e-6)
    camera = model.cameras[found["b/00000.png"].camera_id]
    np.testing.assert_allclose(camera.calibration_matrix(), k)
    assert (camera.width, camera.height) == (320, 240)


# --------------------------------------------------------------------------------------------- USDZ


def skinned(texture: bool) -> RiggedMesh:
    """A ball bound to two joints."""
    mesh = ball(cells=16)
    count = len(mesh.vertices)
    index = np.tile([0, 1], (count, 1))
    share = np.clip(mesh.vertices[:, :1] / 2 + 0.5, 0, 1)
    uv = mesh.vertices[:, :2] / 4 + 0.5 if texture else None
    weights = np.concatenate([1 - share, share], axis=1)
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    picture = b"\x89PNG not really" if texture else None
    return RiggedMesh("m", mesh.vertices, normals, mesh.faces, np.full((count, 3), 0.5), index, weights, uv, picture)


def test_usdz_members_are_stored_and_aligned() -> None:
    mesh, skeleton = skinned(True), chain(2)
    data = usdz.write_usdz(mesh, skeleton, [usdz.Motion("a", np.arange(3.0), motion(skeleton, 3))])
    assert data == usdz.write_usdz(mesh, skeleton, [usdz.Motion("a", np.arange(3.0), motion(skeleton, 3))])
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.namelist() == ["model.usda", "texture.png"]
        for info in archive.infolist():
            assert info.compress_type == zipfile.ZIP_STORED
            begin = (
                info.header_offset
                + 30
                + len(info.filename)
                + int.from_bytes(data[info.header_offset + 28 : info.header_offset + 30], "little")
            )
            assert begin % 64 == 0
            assert data[begin : begin + 8] == archive.read(info.filename)[:8]


@pytest.mark.parametrize("texture", [True, False])
def test_usd_reads_the_skin_and_every_clip(texture: bool, tmp_path: object) -> None:
    pytest.importorskip("pxr", reason="needs usd-core")
    from pxr import Usd, UsdGeom, UsdSkel

    mesh, skeleton = skinned(texture), chain(2)
    clips = {"clip-0": motion(skeleton, 3), "clip 0": motion(skeleton, 3, 5)}
    time_s = np.array([1.0, 1.5, 2.0])
    path = tmp_path / "m.usdz"  # type: ignore[operator]
    path.write_bytes(usdz.write_usdz(mesh, skeleton, [usdz.Motion(n, time_s, j) for n, j in clips.items()]))
    stage = Usd.Stage.Open(str(path))
    root = stage.GetDefaultPrim()
    variants = root.GetVariantSets().GetVariantSet("clip")
    assert sorted(variants.GetVariantNames()) == ["clip_0", "clip_0_2"]
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/model/surface")).GetPointsAttr().Get()
    np.testing.assert_allclose(np.array(points), mesh.vertices, atol=1e-5)
    for (_, joints), variant in zip(clips.items(), ["clip_0", "clip_0_2"], strict=True):
        variants.SetVariantSelection(variant)
        cache = UsdSkel.Cache()
        cache.Populate(UsdSkel.Root(root), Usd.TraverseInstanceProxies())
        query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/model/rig")))
        found = np.array(query.ComputeJointSkelTransforms(Usd.TimeCode(0.5 * 24)))
        np.testing.assert_allclose(found.swapaxes(1, 2), joints[1], atol=1e-4)
        binding = UsdSkel.BindingAPI(stage.GetPrimAtPath("/model/surface"))
        assert binding.GetJointWeightsPrimvar().GetElementSize() == 2


# --------------------------------------------------------------------------------------------- coarse meshes


def test_a_coarse_mesh_lies_on_vertices_of_the_fine_one() -> None:
    mesh = ball()
    coarse = coarse_subset(mesh, 600)
    assert len(coarse.faces) <= 600
    assert len(np.unique(coarse.vertex)) == len(coarse.vertex) and coarse.vertex.max() < len(mesh.vertices)
    points = mesh.vertices[coarse.vertex]
    corners = points[coarse.faces]
    volume = np.einsum("fc,fc->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.04)  # outward, whole


def test_a_mesh_within_the_budget_stays_whole() -> None:
    mesh = ball(cells=12)
    coarse = coarse_subset(mesh, len(mesh.faces))
    np.testing.assert_array_equal(coarse.faces, mesh.faces)
    np.testing.assert_array_equal(coarse.vertex, np.arange(len(mesh.vertices)))


# --------------------------------------------------------------------------------------------- names


def body(parts: dict[str, tuple[str | None, tuple[float, float, float]]]) -> tuple[Skeleton, np.ndarray, np.ndarray]:
    """A skeleton of points with a little surface about each: name -> parent and place."""
    names = list(parts)
    centre = np.array([place for _, place in parts.values()], float)
    parent = np.array([-1 if p is None else names.index(p) for p, _ in parts.values()])
    rest = np.tile(np.eye(4), (len(names), 1, 1))
    rest[:, :3, 3] = centre
    offsets = np.random.default_rng(0).normal(size=(20, 3)) * 0.01
    vertices = (centre[:, None] + offsets).reshape(-1, 3)
    weights = np.repeat(np.eye(len(names)), 20, axis=0)
    return (
        Skeleton([f"bone_{i:02d}" for i in range(len(names))], np.arange(len(names)), parent, rest, centre),
        (vertices),
        weights,
    )


QUADRUPED = {
    "hips": (None, (0, 0.6, -0.4)),
    "chest": ("hips", (0, 0.6, 0.4)),
    "neck": ("chest", (0, 0.8, 0.7)),
    "skull": ("neck", (0, 1.0, 1.0)),
    "tail": ("hips", (0, 0.6, -1.0)),
    "upper fl": ("chest", (0.2, 0.3, 0.4)),
    "lower fl": ("upper fl", (0.2, 0.0, 0.4)),
    "fr": ("chest", (-0.2, 0.0, 0.4)),
    "bl": ("hips", (0.2, 0.0, -0.4)),
    "br": ("hips", (-0.2, 0.0, -0.4)),
}
HUMAN = {
    "hips": (None, (0, 0, 0)),
    "chest": ("hips", (0, 0.4, 0)),
    "skull": ("chest", (0, 0.8, 0)),
    "left arm": ("chest", (0.3, 0.2, 0)),
    "left hand": ("left arm", (0.4, -0.1, 0)),
    "right arm": ("chest", (-0.4, 0.4, 0)),
    "left leg": ("hips", (0.1, -0.8, 0)),
    "right leg": ("hips", (-0.1, -0.8, 0)),
}


def test_joints_of_a_quadruped_have_names_of_places() -> None:
    named = name_by_place(*body(QUADRUPED)[:1], "cat", *body(QUADRUPED)[1:])
    found = dict(zip(QUADRUPED, named.names, strict=True))
    assert found["hips"] == "spine_1" and found["chest"] == "spine_2"
    assert (found["neck"], found["skull"]) == ("head_1", "head_2")
    assert found["tail"] == "tail_1"
    assert (found["upper fl"], found["lower fl"]) == ("leg_front_left_1", "leg_front_left_2")
    assert (found["fr"], found["bl"], found["br"]) == ("leg_front_right_1", "leg_back_left_1", "leg_back_right_1")


def test_joints_of_a_human_have_names_of_places() -> None:
    named = name_by_place(*body(HUMAN)[:1], "human", *body(HUMAN)[1:])
    found = dict(zip(HUMAN, named.names, strict=True))
    assert (found["hips"], found["chest"], found["skull"]) == ("spine_1", "spine_2", "head_1")
    assert (found["left arm"], found["left hand"], found["right arm"]) == ("arm_left_1", "arm_left_2", "arm_right_1")
    assert (found["left leg"], found["right leg"]) == ("leg_left_1", "leg_right_1")


@pytest.mark.parametrize("category", ["", "other", "teapot"])
def test_without_a_known_body_joints_keep_their_numbers(category: str) -> None:
    skeleton, vertices, weights = body(QUADRUPED)
    assert kind_of_body(category) is None
    assert name_by_place(skeleton, category, vertices, weights).names == skeleton.names


def test_names_are_unique_whatever_the_tree() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        count = int(rng.integers(3, 30))
        parts = {
            str(i): (None if i == 0 else str(int(rng.integers(0, i))), tuple(rng.normal(size=3))) for i in range(count)
        }
        for category in ("quadruped", "human"):
            skeleton, vertices, weights = body(parts)  # type: ignore[arg-type]
            names = name_by_place(skeleton, category, vertices, weights).names
            assert len(set(names)) == count
