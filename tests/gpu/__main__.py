"""`python -m tests.gpu [--out FILE]`: does a GPU give what the processor gives, and how fast? For people who have one.

Prints each difference with its bound, seconds and milliseconds, and a verdict; ends with 0 if all bounds are kept, 1 if
not, 69 without a GPU that can be used. It was run on NVIDIA H200s: what it prints on another GPU is worth
sending to the project.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

import torch

from splatnode.extras.jobs import usable_cores
from splatnode.recon.rasterize import DeviceUnavailable, choose_device, format_device
from tests.gpu.agreement import Figure, figures, whole_figures
from tests.gpu.speed import milliseconds, refinement_ms


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.gpu", description=__doc__)
    parser.add_argument("--out", type=Path, metavar="FILE", help="where to write the figures as JSON")
    arguments = parser.parse_args()
    try:
        device = choose_device("cuda")
    except DeviceUnavailable as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(format_device("cuda", device), flush=True)
    found: list[Figure] = []
    for figure in figures(device):
        found.append(figure)
        _tell(figure)
    with tempfile.TemporaryDirectory() as folder:
        whole, seconds = whole_figures("cuda", Path(folder))
    for figure in whole:
        _tell(figure)
    times = _told(seconds) | _told(refinement_ms(device)) | _told(milliseconds(device))
    broken = [figure.name for figure in (*found, *whole) if not figure.kept]
    print(f"differs from the CPU: {', '.join(broken)}" if broken else "agrees with the CPU within all bounds")
    if arguments.out:
        machine = {
            "gpu": torch.cuda.get_device_name(device),
            "cores": len(usable_cores()),
            "torch": torch.__version__,
            "gsplat": import_module("gsplat").__version__,
        }
        record = {
            "command": "python -m tests.gpu",
            "machine": machine,
            "figures": [asdict(each) for each in (*found, *whole)],
            "times": times,
        }
        arguments.out.write_text(json.dumps(record, indent=1) + "\n")
    return 1 if broken else 0


def _told(times: dict[str, float]) -> dict[str, float]:
    for name, value in times.items():
        print(f"{name:80s} {value:10.4g}", flush=True)
    return times


def _tell(figure: Figure) -> None:
    verdict = "ok" if figure.kept else "TOO MUCH"
    print(f"{figure.name:80s} {figure.value:10.2g}  (bound {figure.bound:.2g}) {verdict}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
