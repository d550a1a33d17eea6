"""A pipeline of five small stages, for the engine's tests.

text files called videos -> words -> upper, measure -> merge -> final
"""

PIPELINE = (
    "toy.words:words",
    "toy.upper:upper",
    "toy.measure:measure",
    "toy.merge:merge",
    "toy.final:final",
)
GROUPS = {"ends": ("merge", "final")}
PRESETS = "presets.toml"
