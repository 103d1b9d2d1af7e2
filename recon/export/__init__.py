"""Scenes and cameras as files. NumPy only: a result can be read, converted and written where there is no torch."""

from recon.export.convert import FORMATS, export_scene, read_cameras, read_gaussians
from recon.export.error import SceneFileError
from recon.export.prepare import viewer_safe
from recon.export.result import write_result
from recon.export.staged import ResultWriteError, write_file, write_files

__all__ = [
    "FORMATS",
    "ResultWriteError",
    "SceneFileError",
    "export_scene",
    "read_cameras",
    "read_gaussians",
    "viewer_safe",
    "write_file",
    "write_files",
    "write_result",
]
