"""What the flags of the viewer's verb were called in the release before; they are read in this one."""

from __future__ import annotations

FLAGS = {
    "view": {"--photographs": "--images", "--pictures": "--num-frames", "--until-final": "--exit-when-final"},
}
