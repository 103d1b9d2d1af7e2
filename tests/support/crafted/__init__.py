"""Files that an adversary would write who has read the code: a generator a kind of file, small however large they claim
to be. What is read from each must end with the boundary's error or with a value within its bounds."""

from tests.support.crafted.configurations import changes, configurations
from tests.support.crafted.crafted import Crafted
from tests.support.crafted.images import images
from tests.support.crafted.recordings import recordings
from tests.support.crafted.scene_files import camera_files, scene_files
from tests.support.crafted.truth_files import truth_files
from tests.support.crafted.videos import videos

__all__ = [
    "Crafted",
    "camera_files",
    "changes",
    "configurations",
    "images",
    "recordings",
    "scene_files",
    "truth_files",
    "videos",
]
