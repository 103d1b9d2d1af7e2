"""What of a result two runs of the same reconstruction have in common to the bit."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

_REPORT, _MANIFEST = "report.json", "manifest.json"
_LOG = "replay.log"  # which a batch keeps beside the result's own files
_OF_A_RUN = ("seconds", "peak_rss_mb")  # in the report


def as_replayed(result: Path) -> dict[str, str]:
    """The digest of each file, by its name; of the report without the seconds and the memory of its run.

    Raises OSError and ValueError where the result is not whole.
    """
    found = {str(path.relative_to(result)): path.read_bytes() for path in sorted(result.rglob("*")) if path.is_file()}
    found.pop(_LOG, None)
    report, manifest = json.loads(found[_REPORT]), json.loads(found[_MANIFEST])
    for name in _OF_A_RUN:
        del report[name]
    del manifest["files"][_REPORT]
    found |= {_REPORT: json.dumps(report).encode(), _MANIFEST: json.dumps(manifest).encode()}
    return {name: hashlib.sha256(content).hexdigest() for name, content in found.items()}
