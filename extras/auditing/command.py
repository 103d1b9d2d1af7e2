"""The verb audit: which camera of a station moved, when and by how much."""

from __future__ import annotations

import argparse

from splatnode.capture.lens_file import read_lens
from splatnode.capture.process.terminal import say, show_progress
from splatnode.extras.auditing.audit import audit as audited
from splatnode.extras.auditing.report import draw_audit, format_heading, format_lines, format_summary, make_values
from splatnode.extras.auditing.stations import find_recordings, load_first_frames
from splatnode.recon.locating.localize import check_lens
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.npz_files import read_landmarks

EXIT_GOOD, EXIT_NOTHING = 0, 65


def audit(args: argparse.Namespace) -> int:
    """Prints what moved, then what stood still; EXIT_NOTHING where no camera could be compared."""
    landmarks = read_landmarks(args.result)
    given = None if args.intrinsics is None else read_lens(args.intrinsics)
    visits = find_recordings(args.recordings)
    if given is not None:
        check_lens(given, load_first_frames(visits))
    say(format_heading(visits))
    with show_progress() as tell:
        found = audited(landmarks, visits, given, args.fov, tell)
    for line in format_lines(found):
        say(line)
    say(format_summary(found))
    for path, content in ((args.json, json_bytes(make_values(found))), (args.picture, draw_audit(found))):
        if path is not None:
            write_file(path, content)
            say(f"results: {path}")
    return EXIT_GOOD if found.comparable_cameras else EXIT_NOTHING
