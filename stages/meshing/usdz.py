"""USDZ: the skinned, textured model with its clips, for phones and for programs that read USD.

A USDZ file is a zip without compression whose members start at multiples of 64 bytes; the first one is the scene,
here in USD's text form, so nothing beyond the standard library is needed to write it. Every video is a variant of the
variant set ``clip``, with the motion in place (root motion off); the first one is chosen.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stages.meshing.conversions import linear_from_srgb, translation_rotation
from stages.meshing.gltf import RiggedMesh
from stages.meshing.skeleton import Skeleton

_CODES_PER_SECOND = 24.0
_ALIGNMENT = 64


@dataclass(frozen=True)
class Motion:
    """A clip: its name, times (T,) in seconds, object_from_joint (T, B, 4, 4)."""

    name: str
    time_s: np.ndarray
    joints: np.ndarray


def identifier(text: str, taken: set[str]) -> str:
    """A name that USD accepts, different from those `taken`, to which it is added."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", text) or "_"
    plain = f"_{plain}" if plain[0].isdigit() else plain
    name, count = plain, 1
    while name in taken:
        count += 1
        name = f"{plain}_{count}"
    taken.add(name)
    return name


def write_usdz(mesh: RiggedMesh, skeleton: Skeleton, motions: Sequence[Motion]) -> bytes:
    """The whole file; the same input gives the same bytes."""
    members = [("model.usda", _scene(mesh, skeleton, motions).encode("utf-8"))]
    if mesh.texture_png is not None:
        members.append(("texture.png", mesh.texture_png))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members:
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            start = buffer.tell() + 30 + len(name)  # where the data would begin without padding
            padding = (-(start + 4)) % _ALIGNMENT
            info.extra = b"\x86\x19" + padding.to_bytes(2, "little") + b"\0" * padding
            archive.writestr(info, data)
    return buffer.getvalue()


def _scene(mesh: RiggedMesh, skeleton: Skeleton, motions: Sequence[Motion]) -> str:
    taken: set[str] = set()
    clips = [identifier(m.name, taken) for m in motions]
    longest = max((float(m.time_s[-1] - m.time_s[0]) for m in motions), default=0.0)
    lines = [
        "#usda 1.0",
        "(",
        '    defaultPrim = "model"',
        "    metersPerUnit = 1",
        '    upAxis = "Y"',
        "    startTimeCode = 0",
        f"    endTimeCode = {longest * _CODES_PER_SECOND:.6g}",
        f"    timeCodesPerSecond = {_CODES_PER_SECOND:g}",
        ")",
        "",
        'def SkelRoot "model" (',
        '    prepend apiSchemas = ["SkelBindingAPI"]',
    ]
    if clips:
        lines += [f'    variants = {{ string clip = "{clips[0]}" }}', '    prepend variantSets = "clip"']
    lines += [")", "{", *_skeleton(skeleton), *_surface(mesh), *_material(mesh.texture_png is not None)]
    if clips:
        lines.append('    variantSet "clip" = {')
        for name, motion in zip(clips, motions, strict=True):
            lines += [f'        "{name}" {{', *_motion(skeleton, motion), "        }"]
        lines.append("    }")
    return "\n".join([*lines, "}"]) + "\n"


def _skeleton(skeleton: Skeleton) -> list[str]:
    taken: set[str] = set()
    own = [identifier(name, taken) for name in skeleton.names]
    paths: list[str] = []
    for name, parent in zip(own, skeleton.parent.tolist(), strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    return [
        '    def Skeleton "rig" (',
        '        prepend apiSchemas = ["SkelBindingAPI"]',
        "    )",
        "    {",
        f"        uniform token[] joints = [{', '.join(chr(34) + p + chr(34) for p in paths)}]",
        f"        uniform matrix4d[] bindTransforms = {_matrices(skeleton.rest)}",
        f"        uniform matrix4d[] restTransforms = {_matrices(skeleton.local(skeleton.rest))}",
        "    }",
    ]


def _surface(mesh: RiggedMesh) -> list[str]:
    kept = mesh.weight.shape[1]
    lines = [
        '    def Mesh "surface" (',
        '        prepend apiSchemas = ["SkelBindingAPI", "MaterialBindingAPI"]',
        "    )",
        "    {",
        "        uniform bool doubleSided = 0",
        '        uniform token subdivisionScheme = "none"',
        f"        float3[] extent = {_tuples(np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]))}",
        f"        int[] faceVertexCounts = [{', '.join(['3'] * len(mesh.faces))}]",
        f"        int[] faceVertexIndices = {_list(mesh.faces.ravel().tolist())}",
        f"        point3f[] points = {_tuples(mesh.vertices)}",
        f'        normal3f[] normals = {_tuples(mesh.normals, 4)} (\n            interpolation = "vertex"\n        )',
        f"        int[] primvars:skel:jointIndices = {_list(mesh.joint_idx.ravel().tolist())} (",
        f'            elementSize = {kept}\n            interpolation = "vertex"\n        )',
        f"        float[] primvars:skel:jointWeights = {_list(mesh.weight.ravel().tolist(), 5)} (",
        f'            elementSize = {kept}\n            interpolation = "vertex"\n        )',
        "        matrix4d primvars:skel:geomBindTransform = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))",
        "        rel skel:skeleton = </model/rig>",
        "        rel material:binding = </model/material>",
    ]
    if mesh.uv is not None:
        upward = mesh.uv * [1, -1] + [0, 1]
        lines.append(
            f'        texCoord2f[] primvars:st = {_tuples(upward)} (\n            interpolation = "vertex"\n        )'
        )
    colour = _tuples(linear_from_srgb(mesh.colour), 4)
    lines.append(
        f'        color3f[] primvars:displayColor = {colour} (\n            interpolation = "vertex"\n        )'
    )
    return [*lines, "    }"]


def _material(textured: bool) -> list[str]:
    lines = [
        '    def Material "material"',
        "    {",
        "        token outputs:surface.connect = </model/material/preview.outputs:surface>",
        '        def Shader "preview"',
        "        {",
        '            uniform token info:id = "UsdPreviewSurface"',
        "            float inputs:metallic = 0",
        "            float inputs:roughness = 1",
        "            token outputs:surface",
    ]
    if not textured:
        lines += [
            "            color3f inputs:diffuseColor.connect = </model/material/colour.outputs:result>",
            "        }",
            '        def Shader "colour"',
            "        {",
            '            uniform token info:id = "UsdPrimvarReader_float3"',
            '            string inputs:varname = "displayColor"',
            "            float3 outputs:result",
        ]
    else:
        lines += [
            "            color3f inputs:diffuseColor.connect = </model/material/picture.outputs:rgb>",
            "        }",
            '        def Shader "coordinates"',
            "        {",
            '            uniform token info:id = "UsdPrimvarReader_float2"',
            '            string inputs:varname = "st"',
            "            float2 outputs:result",
            "        }",
            '        def Shader "picture"',
            "        {",
            '            uniform token info:id = "UsdUVTexture"',
            "            asset inputs:file = @texture.png@",
            "            float2 inputs:st.connect = </model/material/coordinates.outputs:result>",
            '            token inputs:sourceColorSpace = "sRGB"',
            '            token inputs:wrapS = "clamp"',
            '            token inputs:wrapT = "clamp"',
            "            float3 outputs:rgb",
        ]
    return [*lines, "        }", "    }"]


def _motion(skeleton: Skeleton, motion: Motion) -> list[str]:
    taken: set[str] = set()
    own = [identifier(name, taken) for name in skeleton.names]
    paths: list[str] = []
    for name, parent in zip(own, skeleton.parent.tolist(), strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    local = skeleton.local(motion.joints)
    parts = [translation_rotation(local[:, j]) for j in range(len(skeleton))]
    translation = np.stack([t for t, _ in parts], axis=1)
    rotation = np.stack([q[:, [3, 0, 1, 2]] for _, q in parts], axis=1)
    codes = (motion.time_s - motion.time_s[0]) * _CODES_PER_SECOND
    indent = " " * 12
    lines = [
        f'{indent}def SkelAnimation "motion"',
        f"{indent}{{",
        f"{indent}    uniform token[] joints = [{', '.join(chr(34) + p + chr(34) for p in paths)}]",
        f"{indent}    half3[] scales = [{', '.join(['(1, 1, 1)'] * len(skeleton))}]",
    ]
    for kind, values in (("float3[] translations", translation), ("quatf[] rotations", rotation)):
        lines.append(f"{indent}    {kind}.timeSamples = {{")
        lines += [f"{indent}        {c:.6g}: {_tuples(v)}," for c, v in zip(codes.tolist(), values, strict=True)]
        lines.append(f"{indent}    }}")
    over = [f'{indent}over "rig"', f"{indent}{{", f"{indent}    rel skel:animationSource = </model/motion>"]
    return [*lines, f"{indent}}}", *over, f"{indent}}}"]


def _matrices(transforms: np.ndarray) -> str:
    """Matrices (N, 4, 4) for row vectors, as USD has them."""
    return "[" + ", ".join(f"({', '.join(_row(r) for r in m)})" for m in transforms.swapaxes(1, 2).tolist()) + "]"


def _row(values: Iterable[float]) -> str:
    return f"({', '.join(f'{v:.9g}' for v in values)})"


def _tuples(rows: np.ndarray, digits: int = 6) -> str:
    text = ", ".join([f"%.{digits}g"] * rows.shape[1])
    return "[" + ", ".join(f"({text % tuple(row)})" for row in rows.tolist()) + "]"


def _list(values: Sequence[float], digits: int = 0) -> str:
    return "[" + ", ".join([f"%.{digits}g" % v for v in values] if digits else [str(v) for v in values]) + "]"
