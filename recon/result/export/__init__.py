"""Scenes and cameras as files. NumPy only: a result can be read, converted and written where there is no torch."""

from splatnode.recon.result.export.format import export_scene
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.export.prepare import sanitize_gaussians
from splatnode.recon.result.export.result import remove_result, write_beside, write_result
from splatnode.recon.result.export.staged import ResultWriteError, write_file, write_files
from splatnode.recon.result.export.stored import read_cameras, read_gaussians

__all__ = [
    "ResultWriteError",
    "SceneFileError",
    "export_scene",
    "read_cameras",
    "read_gaussians",
    "remove_result",
    "sanitize_gaussians",
    "write_beside",
    "write_file",
    "write_files",
    "write_result",
]
