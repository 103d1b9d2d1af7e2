"""The verb audit: which camera of a station moved, when and by how much."""

from __future__ import annotations

import argparse

from splatnode.capture.lens_file import read_lens
from splatnode.capture.process.progress import telling
from splatnode.capture.process.terminal import say
from splatnode.recon.auditing.audit import audit as audited
from splatnode.recon.auditing.picture import picture
from splatnode.recon.auditing.stations import recordings
from splatnode.recon.auditing.table import heading, lines, summary, values
from splatnode.recon.auditing.taken import one_each
from splatnode.recon.locating.photographs import check_lens
from splatnode.recon.result.export.staged import json_bytes, write_file
from splatnode.recon.result.landmarks_file import read_landmarks

EXIT_GOOD, EXIT_NOTHING = 0, 65


def audit(args: argparse.Namespace) -> int:
    """What moved, then what stood still; EXIT_NOTHING where no camera could be compared."""
    landmarks = read_landmarks(args.result)
    given = None if args.calibration is None else read_lens(args.calibration)
    visits = recordings(args.recordings)
    if given is not None:
        check_lens(given, one_each(visits))
    say(heading(visits))
    with telling() as tell:
        found = audited(landmarks, visits, given, args.fov, tell)
    for line in lines(found):
        say(line)
    say(summary(found))
    for path, content in ((args.json, json_bytes(values(found))), (args.picture, picture(found))):
        if path is not None:
            write_file(path, content)
            say(f"results: {path}")
    return EXIT_GOOD if found.compared else EXIT_NOTHING
