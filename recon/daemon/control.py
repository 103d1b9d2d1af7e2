"""Commands to the running daemon, and the verb `retract` that sends one."""

from __future__ import annotations

import argparse

import msgspec

from splatnode.capture.messaging.commands import Answer, MarkProblemsSeen, ask
from splatnode.capture.messaging.services import RECON_CONTROL
from splatnode.capture.messaging.values import Name
from splatnode.capture.process.config import load_config
from splatnode.capture.process.terminal import say
from splatnode.recon.daemon.config import DaemonConfig

EXIT_GOOD, EXIT_UNKNOWN_NAME = 0, 2


class RemoveKeyframe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="retract"):
    """Remove the keyframe with this name."""

    name: Name


Command = RemoveKeyframe | MarkProblemsSeen


def remove_keyframe(args: argparse.Namespace) -> int:
    """Asks the daemon to remove a keyframe; returns 2 where there is none of that name."""
    config = load_config(args.config, DaemonConfig) if args.config else DaemonConfig()
    answer = ask(RECON_CONTROL, config.network, RemoveKeyframe(args.name), Answer)
    say(answer.message)
    return EXIT_GOOD if answer.done else EXIT_UNKNOWN_NAME
