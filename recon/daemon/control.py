"""Small commands to the running daemon."""

from __future__ import annotations

import argparse

import msgspec

from splatnode.capture.messaging.commands import ask
from splatnode.capture.messaging.services import RECON_CONTROL
from splatnode.capture.process.config import load_config
from splatnode.recon.daemon.config import Config


class Retract(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="retract"):
    """Forget the keyframe with this name."""

    name: str


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="answer"):
    done: bool
    message: str


def retract(args: argparse.Namespace) -> int:
    """Takes a keyframe back; 2 where there is none of that name."""
    config = load_config(args.config, Config) if args.config else Config()
    answer = ask(RECON_CONTROL, config.network, Retract(args.name), Answer)
    print(answer.message)
    return 0 if answer.done else 2
