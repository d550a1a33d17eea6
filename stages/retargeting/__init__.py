"""Retargeting as a pipeline of its own: one clip in, the motion of a known model out (``banmo retarget``).

clip -> frames -> masks, flow, features -> poses -> posture (limbs) -> onto (on the known model) -> track (codes)
     -> motion (files)

It runs in a workspace of its own, so that it is kept, resumed and explained like everything else.
"""

PIPELINE = (
    "stages.frames:frames",
    "stages.masks:masks",
    "stages.flow:flow",
    "stages.features:features",
    "stages.poses:poses",
    "stages.retarget:known",
    "stages.retarget_posture:posture",
    "stages.retarget_onto:onto",
    "stages.retarget:track",
    "stages.retarget_motion:motion",
)

PRESETS = "presets.toml"
