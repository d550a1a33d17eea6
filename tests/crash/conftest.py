"""The engine's laboratory, for breaking things."""

from tests.engine.conftest import lab

__all__ = ["lab"]
