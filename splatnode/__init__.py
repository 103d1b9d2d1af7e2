"""Photographs in, camera poses and a 3D Gaussian scene out, on a CPU.

The names below are for your own program. Each is loaded when it is first used: `import splatnode` alone takes no time.
"""

from importlib import import_module

TYPE_CHECKING = False  # to a type checker it is true; `typing` would take time

if TYPE_CHECKING:
    from splatnode.api.node import LiveLocation, Node, NodeMap, NodeUpdate, connect
    from splatnode.api.publisher import Published, Publisher, RefusedImage
    from splatnode.api.reconstruct import Marker, Session, Stereo, Update, reconstruct
    from splatnode.api.result import Camera, Result, View, load
    from splatnode.capture.depth_image import DepthImage, DepthNoise, make_depth_image
    from splatnode.capture.frame import Intrinsics
    from splatnode.capture.process.terminal import InputWarning
    from splatnode.recon.locating import Located, NotLocated
    from splatnode.recon.occupancy import OccupancyMap
    from splatnode.recon.result.verdict import Verdict

__all__ = [
    "Camera",
    "DepthImage",
    "DepthNoise",
    "InputWarning",
    "Intrinsics",
    "LiveLocation",
    "Located",
    "Marker",
    "Node",
    "NodeMap",
    "NodeUpdate",
    "NotLocated",
    "OccupancyMap",
    "Published",
    "Publisher",
    "RefusedImage",
    "Result",
    "Session",
    "Stereo",
    "Update",
    "Verdict",
    "View",
    "connect",
    "load",
    "make_depth_image",
    "reconstruct",
]

_MODULES = {
    "Camera": "splatnode.api.result",
    "DepthImage": "splatnode.capture.depth_image",
    "DepthNoise": "splatnode.capture.depth_image",
    "InputWarning": "splatnode.capture.process.terminal",
    "Intrinsics": "splatnode.capture.frame",
    "LiveLocation": "splatnode.api.node",
    "Located": "splatnode.recon.locating",
    "Marker": "splatnode.api.reconstruct",
    "Node": "splatnode.api.node",
    "NodeMap": "splatnode.api.node",
    "NodeUpdate": "splatnode.api.node",
    "NotLocated": "splatnode.recon.locating",
    "OccupancyMap": "splatnode.recon.occupancy",
    "Published": "splatnode.api.publisher",
    "Publisher": "splatnode.api.publisher",
    "RefusedImage": "splatnode.api.publisher",
    "Result": "splatnode.api.result",
    "Session": "splatnode.api.reconstruct",
    "Stereo": "splatnode.api.reconstruct",
    "Update": "splatnode.api.reconstruct",
    "Verdict": "splatnode.recon.result.verdict",
    "View": "splatnode.api.result",
    "connect": "splatnode.api.node",
    "load": "splatnode.api.result",
    "make_depth_image": "splatnode.capture.depth_image",
    "reconstruct": "splatnode.api.reconstruct",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'splatnode' has no attribute {name!r}; it has: {', '.join(__all__)}")
    found = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
