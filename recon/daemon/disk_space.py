"""Says that a disk is nearly full while the daemon can still write: before a keyframe or a result is refused."""

from __future__ import annotations

import logging

from splatnode.capture.process.files import shortage
from splatnode.capture.process.logs import event
from splatnode.capture.process.system import is_shortage
from splatnode.recon.daemon.checkpoint.store import Store
from splatnode.recon.daemon.config import DaemonConfig
from splatnode.recon.result.report import estimate_result_bytes

log = logging.getLogger(__name__)

# In the checkpoint. Keyframe of 1280 x 720: photograph 2.8 MB, point map 1.2 MB, features and pairs 1 to 2 MB.
BYTES_A_KEYFRAME = 6_000_000
BYTES_A_GAUSSIAN = 56  # 14 numbers of 4 bytes


class DiskSpace:
    """The free space where the daemon writes, against what it may still write."""

    def __init__(self, config: DaemonConfig, store: Store) -> None:
        self._config, self._store = config, store
        self._told = ""

    def describe_problem(self) -> str:
        """Describes what may not fit and where; empty where there is room for all. A change is logged."""
        further_keyframes = max(0, self._config.max_views - len(self._store.names))
        most_gaussians = self._config.max_gaussians
        checkpoint_bytes = further_keyframes * BYTES_A_KEYFRAME + most_gaussians * BYTES_A_GAUSSIAN
        try:
            problem = shortage(self._store.directory, checkpoint_bytes, "the checkpoint") or shortage(
                self._config.out, estimate_result_bytes(most_gaussians, self._config.max_views), "the result"
            )
        except OSError as error:
            if is_shortage(error):  # this time it is not known
                return self._told and f"{self._told}: make room on the disk"
            problem = f"the disk does not tell how much is free ({error.strerror or error})"
        if bool(problem) != bool(self._told):
            event(log, logging.WARNING if problem else logging.INFO, "disk_space", problem=problem or "none")
        self._told = problem
        return problem and f"{problem}: make room on the disk"
