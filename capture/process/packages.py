"""Which package brings a module that cannot be imported, and which extra of splatnode's brings that package."""

from __future__ import annotations

# Import name -> distribution. An installation brings them all.
REQUIRED = {
    "av": "av",
    "cv2": "opencv-contrib-python-headless",
    "msgspec": "msgspec",
    "numpy": "numpy",
    "scipy": "scipy",
    "torch": "torch",
    "yaml": "pyyaml",
    "zmq": "pyzmq",
}
# Import name -> the extra that brings the package of that name.
EXTRAS = {
    "PIL": "heic",
    "depthai": "oak",
    "gsplat": "cuda",
    "matplotlib": "bench",
    "mcap": "mcap",
    "onnxruntime": "xfeat",
    "open3d": "viewer",
    "pi_heif": "heic",
    "pyarrow": "batch",
    "pycolmap": "bench",
    "ray": "ray",
    "rerun": "rerun",
    "safetensors": "learned",
    "viser": "viser",
}


def remedy(module: str) -> str:
    """Says what to run where `module`, or a part of it, is missing."""
    name = module.split(".")[0]
    if name in EXTRAS:
        return f"Run: pip install 'splatnode[{EXTRAS[name]}]'"
    lacking = f"Run: pip install {REQUIRED[name]}. Or write" if name in REQUIRED else "Write"
    return f"The installation is not complete. {lacking} ./run in place of splatnode, which installs what it needs"
