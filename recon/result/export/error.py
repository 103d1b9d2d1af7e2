"""SceneFileError: a file that cannot be read as the scene it should hold."""

from __future__ import annotations


class SceneFileError(ValueError):
    """The message names the file, what was expected in it and what was found."""
