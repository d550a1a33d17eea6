"""Videos in, animated model out: the stages in the order of the data. Start reading here.

videos -> frames -> masks, flow, features -> poses -> fit -> correct -> refine -> export -> report

Each entry is ``module:function``; the engine imports them by name, so that editing one stage never touches the
code fingerprint of another.
"""

PIPELINE = (
    "stages.frames:frames",
    "stages.masks:masks",
    "stages.flow:flow",
    "stages.features:features",
    "stages.poses:poses",
    "stages.optimise:fit",
    "stages.optimise:correct",
    "stages.optimise:refine",
    "stages.export:export",
    "stages.report:report",
)
"""The pipeline, in data order."""

GROUPS = {"optimise": ("fit", "correct", "refine")}
"""Names that stand for several stages on the command line."""

PRESETS = "presets.toml"
"""Settings by purpose, beside this file; the first table is the default preset."""

EXPORTS = ("export", "report")
"""Stages whose files are copied to ``exports/``."""

NAMED_FILES = "stages.registry:find"
"""Where a setting that takes a file finds a network by name."""

VERBS = {
    "animate": "stages.verbs.animate",
    "evaluate": "stages.verbs.evaluate",
    "extend": "stages.verbs.extend",
    "render": "stages.verbs.render",
    "retarget": "stages.verbs.retarget",
    "view": "stages.verbs.view",
    "weights": "stages.verbs.weights",
}
"""Commands of the pipeline's own: name -> module; see ``pipeline/verbs.py``."""
