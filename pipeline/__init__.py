"""The engine: folders, keys, processes. It knows nothing of vision.

These are the public names, all that a stage or a verb needs. See :mod:`pipeline.contract` and :mod:`pipeline.verbs`.
"""

from pipeline.contract import Folder, Given, InputFile, Resources, Scene, Source, Stage, Video, stage
from pipeline.errors import BadInput, Interrupted
from pipeline.results import Ran, Results
from pipeline.running import Run

__all__ = [
    "BadInput",
    "Folder",
    "Given",
    "InputFile",
    "Interrupted",
    "Ran",
    "Resources",
    "Results",
    "Run",
    "Scene",
    "Source",
    "Stage",
    "Video",
    "stage",
]
