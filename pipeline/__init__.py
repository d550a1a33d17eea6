"""The engine: folders, keys, processes. It knows nothing of vision.

These are the public names, all that a stage needs. See :mod:`pipeline.contract`.
"""

from pipeline.contract import Folder, Given, InputFile, Resources, Scene, Source, Stage, Video, stage
from pipeline.errors import BadInput, Interrupted
from pipeline.running import Run

__all__ = [
    "BadInput",
    "Folder",
    "Given",
    "InputFile",
    "Interrupted",
    "Resources",
    "Run",
    "Scene",
    "Source",
    "Stage",
    "Video",
    "stage",
]
