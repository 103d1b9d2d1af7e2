"""The verb `splatnode weights list | fetch | verify`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence

from splatnode.capture.process.terminal import say
from splatnode.recon.networks.weights import (
    CATALOGUE,
    Weights,
    WeightsError,
    fetch,
    find,
    find_mismatch,
    folder,
    locate_weights,
)

_UNAVAILABLE = 75  # the exit code where something is missing or could not be had: EX_TEMPFAIL


def _select_weights(names: Sequence[str]) -> list[Weights]:
    """The entries of the catalogue, all where none are named. Raises WeightsError for an unknown name."""
    known = {weights.name: weights for weights in CATALOGUE}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise WeightsError(f"no weights called {unknown[0]!r}; there are: {', '.join(known)}")
    return [known[name] for name in names] if names else list(CATALOGUE)


def _describe_weights(chosen: Sequence[Weights]) -> Iterator[dict[str, object]]:
    """Lists what `--json` prints, an entry a line."""
    for weights in chosen:
        where = locate_weights(weights.path)
        yield {
            "name": weights.name,
            "what": weights.what,
            "licence": weights.licence,
            "source": weights.url or None,
            "sha256": weights.sha256,
            "bytes": weights.num_bytes,
            "found": None if where is None else str(where),
        }


def command(args: argparse.Namespace) -> int:
    """Prints, fetches or checks what `args` name. 0; 75 where something is missing or could not be had."""
    chosen = _select_weights(args.names)
    if args.action == "list":
        for entry in _describe_weights(chosen):
            if args.json:
                print(json.dumps(entry))
            else:
                say(f"{entry['name']}: {entry['what']}")
                say(f"    {entry['licence']}; {entry['found'] or 'not here'}")
        return 0
    if args.action == "fetch" and not args.names:
        raise WeightsError(f"say which to fetch: {', '.join(weights.name for weights in CATALOGUE)}")
    failed = False
    for weights in chosen:
        try:
            if args.action == "fetch":
                say(f"{weights.name}: {weights.licence}", error=True)
                say(fetch(weights, folder(), args.source))
            else:
                wrong = find_mismatch(weights, find(weights.path))
                failed |= bool(wrong)
                unknown = "" if weights.sha256 else " (its publisher gives no digest: checked when loaded)"
                say(f"{weights.name}: {wrong or 'as published' + unknown}")
        except WeightsError as error:
            failed = True
            say(f"{weights.name}: {error}", error=True)
    return _UNAVAILABLE if failed else 0
