"""The text of docs/configuration.md."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from splatnode.capture.config import CaptureConfig
from splatnode.capture.process.config import Plugin, has_fields
from splatnode.recon.config import PRESETS
from splatnode.recon.config import ReconstructionConfig as Reconstruction
from splatnode.recon.daemon.config import DaemonConfig as Daemon
from splatnode.recon.keyframes import REFERENCE_SIDE
from tests.reference.options import REQUIRED, Option, Section, sections

_INTRODUCTION = f"""# Configuration

A configuration is a YAML file that holds only what differs from the defaults. A key that does not exist is refused; the
message lists the keys that do, and the nearest one. A key of the release before is read in this release, and told. The
dots in a name stand for levels of the file: `selection.coverage` is

```yaml
selection:
  coverage: 0.4
```

`splatnode config` lists the configurations that come with the package, and `splatnode config --write configs` writes
them into a new folder. `splatnode capture` also takes changes, such as `--set selection.coverage=0.4`. The viewer has
no options of its own: from the node's file, `splatnode view FILE` takes how to reach it (`network`).

The options that are changed most often:

- `camera`: which camera, or which folder or video in its place
- `selection.every_frame`, `selection.coverage`, `selection.max_fps`: how many keyframes are taken
- `max_views`, `idle_finalize_s`, `new_submap_after`: when the node goes on with a next submap, finalizes it, begins
  another
- `reconstruction.size`, `reconstruction.max_gaussians`: how fine and how large a scene is

In the tables, `None` stands for `null` in a file. An option whose unit is – is a count, a factor, a choice or a text.
Pixels at `REFERENCE_SIDE` are those of an image resized to {REFERENCE_SIDE} on its longer side. Lengths in a scene have
no unit: the median depth of its points is 1.

This page is made from the code and its comments by `python -m tests.reference`; change it there.
"""
_CAPTURE = "The camera's process: `splatnode capture FILE` and `splatnode record FILE`."
_DAEMON = (
    "The node's process that makes scenes: `splatnode recon FILE`. It also has all options of the next part, "
    "with `reconstruction.` before their names: `reconstruction.size`, `reconstruction.metric.marker_size_m` (which "
    "`--marker 100mm` sets, too). Poses come with the keyframes (`given_pose`, [Metres](metres.md#live))."
)
_RECONSTRUCTION = (
    "One reconstruction: `splatnode replay PHOTOGRAPHS --config FILE`, and the part `reconstruction` of the node's "
    "file. A preset (`--preset`) changes defaults, the file changes the preset, and flags of the command line change "
    "the file. What each preset changes:"
)
_SUFFIXES = {"_s": "s", "_us": "µs", "_px": "px", "_pixels": "px", "_deg": "°", "_mb": "MB", "_percent": "%"}
_PER_SECOND = "1/s"
_UNITS = {"pixels": "px", "grey levels": "grey levels", "iterations": "iterations", "radians": "rad", "seconds": "s"}


def page() -> str:
    """The whole page, as Markdown."""
    daemon = [each for each in sections(Daemon) if each.name.partition(".")[0] != "reconstruction"]
    parts = (
        ("capture", _CAPTURE, sections(CaptureConfig)),
        ("recon", _DAEMON, daemon),
        ("reconstruction", f"{_RECONSTRUCTION}\n\n{_presets()}", sections(Reconstruction)),
    )
    return "\n".join([_INTRODUCTION, *(line for part in parts for line in _part(*part))])


def unit(option: Option) -> str:
    """By the end of the option's name, else by what stands between two commas or colons of the description."""
    name = option.name.rpartition(".")[2]
    if name.endswith("fps"):
        return _PER_SECOND
    if suffix := next((suffix for suffix in _SUFFIXES if name.endswith(suffix)), None):
        return _SUFFIXES[suffix]
    clauses = re.split(r"[,;:.]\s*", option.text.replace(" at REFERENCE_SIDE", "").lower())
    if found := next((_UNITS[clause] for clause in clauses if clause in _UNITS), None):
        return found
    return "share" if re.search(r"\bshares? of\b", option.text) else "–"


def _part(title: str, text: str, found: Iterable[Section]) -> Iterator[str]:
    yield f"## {title}\n\n{text}\n"
    written = set()
    for section in found:
        key = (section.name, section.kind, section.options)
        if section.options and str(key) not in written:  # what several kinds have alike is written once
            written.add(str(key))
            yield from _section(section)


def _section(section: Section) -> Iterator[str]:
    if section.name:
        kind = f", `kind: {section.kind}`" if section.kind else ""
        yield f"### `{section.name}`{kind}\n\n{_sentence(section.text)}\n"
    yield "| option | default | unit | values | what it does |\n|---|---|---|---|---|"
    for option in section.options:
        cells = (f"`{option.name}`", _default(option.default), unit(option), option.values, _sentence(option.text))
        yield f"| {' | '.join(map(_cell, cells))} |"
    yield ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


def _sentence(text: str) -> str:
    """`text` with a full stop, and a capital letter unless it begins with a value of the option or with code."""
    begun = text[:1].upper() + text[1:] if re.match(r"[a-z][a-z0-9-]*[ ,;]", text) else text
    return begun if begun.endswith((".", "?")) else f"{begun}."


def _default(value: Any) -> str:
    return "required" if value is REQUIRED else f"`{_as_in_files(value)}`"


def _as_in_files(value: Any) -> str:
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_as_in_files, value))}]"
    if isinstance(value, Plugin):
        return f"{{kind: {value.kind}}}"
    if has_fields(type(value)):
        return "{...}"
    if isinstance(value, float):
        return f"{value:g}"
    return str(value) if isinstance(value, (str, Path)) and str(value) else json.dumps(value)


def _presets() -> str:
    """What each preset changes of the keys that are listed, as a list; that it sets constants, too, is only said."""
    documented, usual = _values_of(Reconstruction()), _values_of(Reconstruction(), internal=True)
    lines = []
    for name, preset in PRESETS.items():
        changed = {
            key: f"`{key[1]}: {_as_in_files(value)}`"
            for key, value in _values_of(preset, internal=True).items()
            if value != usual[key] and _as_in_files(value) != _as_in_files(usual[key])
        }
        shown = [text for key, text in changed.items() if key in documented]
        shown += ["constants that no file sets"] if len(shown) < len(changed) else []
        lines.append(f"- `{name}`: {', '.join(shown) or 'the defaults'}")
    return "\n".join(lines)


def _values_of(config: Reconstruction, internal: bool = False) -> dict[tuple[str, str], Any]:
    """By the kind of plug-in and the name of an option."""
    found = sections(Reconstruction, config, internal=internal)
    return {(each.kind, option.name): option.default for each in found for option in each.options}
