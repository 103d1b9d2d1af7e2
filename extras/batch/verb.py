"""`splatnode batch` on the command line: its arguments, what of them each replay gets, and what runs it."""

from __future__ import annotations

import argparse
from pathlib import Path

from splatnode.capture.process.arguments import Verb, add_json, import_lazily, positive, seconds
from splatnode.extras.jobs.arguments import add_max_memory, add_ray
from splatnode.recon.replay_verb import add_reconstruction_options, add_selection_options


def replay_options(args: argparse.Namespace) -> list[str]:
    """The options of `args` that say how each recording is reconstructed, as the command line of a replay has them."""
    parser = argparse.ArgumentParser()
    options = []
    for action in _options_of_replay(parser):
        given = getattr(args, action.dest)
        if given == action.default:
            continue
        options += action.option_strings if action.nargs == 0 else [action.option_strings[0], str(given)]
    return options


def _options_of_replay(parser: argparse.ArgumentParser) -> tuple[argparse.Action, ...]:
    return *add_reconstruction_options(parser), *add_selection_options(parser.add_mutually_exclusive_group())


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sources",
        type=Path,
        nargs="+",
        metavar="SOURCE",
        help="a folder of photographs, a video, an MCAP file, or a LeRobot data set, or a folder that holds such, or a "
        "text file that names them, one a line",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder for all results")
    parser.add_argument(
        "--resume", action="store_true", help="go on with what is in --out: recordings that came to an end stay"
    )
    parser.add_argument("--retry", action="store_true", help="and run those again that failed")
    parser.add_argument(
        "--cores", type=positive, metavar="N", help="recordings at a time, each on one core (default: all cores)"
    )
    add_max_memory(parser, "a recording")
    parser.add_argument("--timeout-s", type=seconds, metavar="S", help="end a recording that takes longer")
    add_ray(parser)
    parser.add_argument(
        "--results",
        metavar="WHERE",
        help="where the workers of a cluster write: a folder that they share, or an object store (s3://bucket/run); "
        "the tables stay in --out (default: --out)",
    )
    parser.add_argument(
        "--write-back",
        action="store_true",
        help="at the end, write the cameras beside the LeRobot data sets and MCAP files that they are of",
    )
    parser.add_argument(
        "--in-place",
        action="store_true",
        help="into them: columns of a LeRobot data set's own tables in meta/episodes, topics of an MCAP file",
    )
    add_json(parser)
    _options_of_replay(parser)


BATCH = Verb(
    "batch",
    "reconstruct many folders of photographs, videos, logs and data sets",
    _arguments,
    import_lazily("splatnode.extras.batch.command", "batch"),
)
