"""Run by an interpreter that has ``bpy``: import a GLB, tell what Blender made of it, and where the vertices go.

``python posed_in_blender.py model.glb out.npz moments.json`` writes armature, bone parents, actions with their lengths
in seconds, and the world positions of the mesh's vertices, in glTF's axes, at the moments (seconds) that the JSON file
lists for each clip.
"""

import json
import sys
from typing import Any

import bpy
import numpy as np

FPS = 1000  # a frame is a millisecond, so that any key time is met to half a millisecond


def main(glb: str, out: str, moments: str) -> None:
    """Import `glb`, write `out`."""
    with open(moments, encoding="utf-8") as file:  # noqa: PTH123 (Blender's own Python)
        wanted = json.load(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = FPS
    bpy.ops.import_scene.gltf(filepath=glb)
    armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
    skinned = next(o for o in bpy.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers))
    facts: dict[str, Any] = {
        "bones": {b.name: b.parent.name if b.parent else None for b in armature.data.bones},
        "cameras": sorted(o.name for o in bpy.data.objects if o.type == "CAMERA"),
        "groups": len(skinned.vertex_groups),
        "images": [i.size[:] for i in bpy.data.images if i.size[0]],
        "attributes": sorted(a.name for a in skinned.data.attributes),
        "clips": {},
    }
    # The importer lays every clip on a muted track of each object that it moves.
    movers = [o for o in bpy.data.objects if o.animation_data and o.animation_data.nla_tracks]
    names = sorted({t.name for o in movers for t in o.animation_data.nla_tracks})
    arrays = {}
    for name in names:
        end = 0.0
        for mover in movers:
            data = mover.animation_data
            data.action = None
            for track in data.nla_tracks:
                track.mute = True
                for strip in track.strips if track.name == name else ():
                    end = max(end, strip.action.frame_range[1])
                    data.action = strip.action  # itself, not the strip: strips round their length to whole frames
                    if hasattr(data, "action_slot"):
                        data.action_slot = strip.action_slot
        facts["clips"][name] = end / FPS
        posed = []
        for frame in np.array(wanted[name]) * FPS:
            bpy.context.scene.frame_set(int(frame), subframe=float(frame - int(frame)))
            graph = bpy.context.evaluated_depsgraph_get()
            evaluated = skinned.evaluated_get(graph)
            mesh = evaluated.to_mesh()
            points = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", points)
            world = np.array(evaluated.matrix_world)
            points = points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]
            posed.append(np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1))
            evaluated.to_mesh_clear()
        arrays[name] = np.stack(posed)
    facts["order"] = names
    np.savez(out, facts=json.dumps(facts), **{f"clip_{k}": arrays[n] for k, n in enumerate(names)})  # type: ignore[arg-type]


if __name__ == "__main__":
    main(*sys.argv[-3:])
