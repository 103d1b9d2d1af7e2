"""The tests that CI may skip, each with its reason. `pytest --check-skips` fails on every other skip.

`./run test --check-skips=open3d,shared` says what this machine cannot have: a row whose `lacking` names one of these
holds too. `.ci/run` tries to install each of them and names those that it could not.
"""

from __future__ import annotations

from fnmatch import fnmatch
from typing import NamedTuple


class AllowedSkip(NamedTuple):
    test: str  # pattern of test ids, from tests/ on
    said: str  # pattern of what the skip says
    why: str
    lacking: str = ""  # holds only where this is lacking; always if empty


ALLOWED = (
    AllowedSkip("gpu/test_gpu.py*", "needs a CUDA device", "no machine of CI has a GPU"),
    AllowedSkip("gpu/test_gpu.py*", "needs the extra cuda*", "gsplat's kernels need CUDA's compiler"),
    AllowedSkip("recon/rasterize/test_gsplat.py*", "has a GPU", "what is refused there is not refused"),
    AllowedSkip("recon/priors/test_priors.py*", "*splatnode weights*", "weights of gigabytes, which no registry has"),
    AllowedSkip("*lpips*", "needs*LPIPS*weights*", "the shared test data has one network's weights at most"),
    AllowedSkip("*/formats/test_tum_with_evo.py*", "needs evo*", "half a gigabyte; test_tum.py has the format's rules"),
    AllowedSkip("extras/viewers/test_rrd.py*", "needs rerun", "half a gigabyte; ./run test runs it where it is"),
    AllowedSkip("extras/viewers/test_rerun_stream.py*", "needs rerun", "likewise"),
    AllowedSkip("api/test_window.py*", "needs rerun", "likewise"),
    AllowedSkip("api/test_window.py*", "needs viser", "its wheels could not be installed", "viser"),
    AllowedSkip("extras/viewers/test_viser.py*", "needs viser", "its wheels could not be installed", "viser"),
    AllowedSkip("extras/viewers/test_viser.py*", "needs a browser*", "its package could not be installed", "browser"),
    AllowedSkip("extras/logged/test_messages.py*", "needs *-*", "the schemas' own writers could not be installed"),
    AllowedSkip("extras/batch/test_ray.py*", "needs ray", "300 MB; test_remote.py has what a worker does"),
    AllowedSkip("extras/evaluate/test_ray.py*", "needs ray", "likewise; test_calls.py has what runs without a cluster"),
    AllowedSkip("vm/test_network.py*", "needs the kernel's netem*", "the machine's kernel decides"),
    AllowedSkip("vm/test_network.py*", "needs virtual cables*", "the machine's kernel decides"),
    AllowedSkip("vm/test_network.py*", "needs the right to make network namespaces", "containers rarely have it"),
    AllowedSkip("*", "needs root, which can be two users", "most people and machines run tests as one user"),
    AllowedSkip("*", "needs the shared test data*", "real photographs are not published here", "shared"),
    AllowedSkip("viewer/test_window.py*", "needs Open3D*", "its wheel could not be installed", "open3d"),
    AllowedSkip("viewer/test_window.py*", "needs Xvfb*", "its package could not be installed", "display"),
    AllowedSkip("viewer/test_window.py*", "needs a window*", "software Vulkan could not be installed", "display"),
    AllowedSkip("viewer/test_window.py*", "*tkinter*", "some Pythons come without it"),
    AllowedSkip("viewer/web/test_browser.py*", "needs a browser*", "its package could not be installed", "browser"),
    AllowedSkip("capture/cameras/test_depthai.py*", "*", "its wheel could not be installed", "depthai"),
    AllowedSkip("vm/test_calibrate.py*", "takes five minutes*", "test_command.py has it with a camera of Python"),
    AllowedSkip("vm/test_v4l2.py*", "needs a virtual machine*", "qemu or a kernel could not be had", "camera_driver"),
    AllowedSkip("recon/core/test_native_core.py*", "needs an aarch64 *", "no cross compiler could be had", "aarch64"),
)  # fmt: skip


def is_allowed(test: str, said: str, lacking: frozenset[str]) -> bool:
    """Whether the test may skip with these words, on a machine that lacks what is named."""
    return any(
        fnmatch(test, row.test) and fnmatch(said, row.said) and (not row.lacking or row.lacking in lacking)
        for row in ALLOWED
    )


def unknown_names(lacking: frozenset[str]) -> frozenset[str]:
    return lacking - {row.lacking for row in ALLOWED}
