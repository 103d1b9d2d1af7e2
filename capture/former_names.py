"""What capture's configuration keys, verbs and flags were called in the release before; they are read in this one.

The tables go with the next release. A key stands as "section.former" or, of one kind of camera alone, as
"section[kind].former", and its present name stands in the same section (capture/process/config.py).
"""

from __future__ import annotations

KEYS = {
    "camera.frames_per_second": "fps",
    "camera.lock": "lock_exposure",
    "camera.settle_s": "warmup_s",
    "camera.silence_s": "frame_timeout_s",
    "camera[v4l2].pixels": "fourcc",
    "camera[video].every": "stride",
    "camera[video].from_s": "start_s",
    "camera[video].to_s": "end_s",
    "camera[watched].existing": "include_existing",
    "camera[watched].settle_s": "stable_s",
    "camera[watched].give_up_s": "file_timeout_s",
    "quality.blur_px": "max_blur_px",
    "quality.exposed": "min_exposed_share",
    "quality.novelty": "min_novelty",
    "selection.per_second": "max_fps",
    "reader.silence_s": "frame_timeout_s",
    "reader.give_up_s": "reconnect_timeout_s",
    "preview.per_second": "fps",
}
VERBS = {
    "find": "list-cameras",
    "keys": "keygen",
}
FLAGS = {
    "status": {"--seen": "--acknowledge"},
}
