"""The verb merge."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from splatnode.capture.process.terminal import say, show_waiting
from splatnode.recon.merging.merge import MergedScene, Submap, Submaps, load_submaps, merge_submaps, scale_and_up
from splatnode.recon.result.export import write_result
from splatnode.recon.result.export.formats.ply import compute_max_gaussians, encode_ply
from splatnode.recon.result.export.prepare import sanitize_gaussians, select_gaussians
from splatnode.recon.result.export.staged import json_bytes
from splatnode.recon.result.folder import hold_result_folder
from splatnode.recon.result.levels_of_detail import LEVELS_FILE, DetailLevel, make_detail_levels, make_levels_record
from splatnode.recon.result.npz_files import DEPTHS, encode_depths
from splatnode.recon.result.report import build_report, estimate_result_bytes, make_contact_sheet, peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.stored_snapshot import SHELL_PIECE, make_merged_path, make_piece_name
from splatnode.recon.result.submap_index import JoinedMap, MapSet, read_map_set
from splatnode.recon.result.verdict import Code, Scale, Up, Verdict
from splatnode.recon.scene.background import SHELL

EXIT_GOOD, EXIT_REFUSED = 0, 65
Reports = dict[str, dict[str, object]]
_LEVELS_BYTES = 0.5  # of a result, for its coarser levels


def merge(args: argparse.Namespace) -> int:
    """Writes map-NAME for each map of the node's results; what cannot be merged is told."""
    reports = write_maps(args.folder, args.out or args.folder, partial(compute_gaussian_limit, args), quiet=args.json)
    if args.json:
        print(json.dumps(reports))
    return EXIT_GOOD if reports else EXIT_REFUSED


def write_maps(
    folder: Path, out: Path, most: Callable[[Sequence[Submap]], int | None], quiet: bool, least: int = 1
) -> Reports:
    """Writes the merged result of each map of the scenes in `folder` into `out`; their reports by their folders.

    `most` says how many Gaussians the map of these submaps may have; maps of fewer than `least` scenes are left out.
    Raises FileNotFoundError, SceneFileError,
    ResultWriteError.
    """
    whole = read_map_set(folder)
    reports = {}
    for each in whole.maps:
        if len(each.placements) < least:
            continue
        with show_waiting(f"reading the scenes of {each.name}"):
            found = load_submaps(whole, each)
        if not found.used:
            reasons = "; ".join(f"{scene_id}: {why}" for scene_id, why in found.left_out.items())
            if not quiet:
                say(f"{each.name}: nothing to merge ({reasons})")
            continue
        merged_into = make_merged_path(out, each)
        with show_waiting(f"merging {len(found.used)} scenes into {merged_into.name}"):
            reports[merged_into.name] = write_map(whole, each, found, merged_into, most(found.used))
        if not quiet:
            _print_report(reports[merged_into.name], merged_into)
    return reports


def write_map(whole: MapSet, of: JoinedMap, found: Submaps, folder: Path, most: int | None) -> dict[str, object]:
    """Writes the merged result of one map, whole or not at all; returns its report. Raises ResultWriteError."""
    given = sum(len(each.gaussians) for each in found.used)
    with hold_result_folder(
        folder, round((1 + _LEVELS_BYTES) * estimate_result_bytes(given if most is None else min(given, most)))
    ):
        one = merge_submaps(found.used, most)
        snapshot = _snapshot(one, found, *scale_and_up(whole, of, [each.scene_id for each in found.used]))
        coarse = make_detail_levels(one.gaussians)
        report = _report(snapshot, one, found, coarse, given)
        write_result(
            snapshot,
            folder,
            report,
            preview=make_contact_sheet(snapshot),
            further=_encode_extra_files(snapshot, one, coarse),
        )
    return report


def compute_gaussian_limit(args: argparse.Namespace, submaps: Sequence[Submap]) -> int | None:
    """How many Gaussians a merged scene may have by both limits; None: there is none."""
    bases = max(each.gaussians.sh.shape[1] for each in submaps)
    by_size = None if args.max_mb is None else compute_max_gaussians(round(args.max_mb * 1e6), bases)
    return min((limit for limit in (args.max_gaussians, by_size) if limit is not None), default=None)


def _snapshot(one: MergedScene, found: Submaps, scale: Scale, up: Up | None) -> Snapshot:
    rough = [each.verdict for each in found.used if each.verdict != Code.OK.value]
    names = ", ".join(each.scene_id for each in found.used)
    message = f"One scene of {len(found.used)}: {names}."
    if rough:
        message += f" {len(rough)} of them known less well: {', '.join(sorted(set(rough)))}."
    verdict = Verdict(Code.OK_ROUGH if rough else Code.OK, message, "", publishable=True)
    seconds = dict(one.seconds)
    return Snapshot(0, verdict, one.cameras, one.gaussians, {}, (), 0, seconds, final=True, scale=scale, up=up)


def _report(
    snapshot: Snapshot, one: MergedScene, found: Submaps, coarse: Sequence[DetailLevel], given: int
) -> dict[str, object]:
    report = build_report(snapshot, seed=0, preset="merge", peak_rss_mb=peak_rss_mb())
    return report | {
        "scenes": [share.record() for share in one.shares],
        "scenes_left_out": [{"scene": scene_id, "reason": why} for scene_id, why in found.left_out.items()],
        "gaussians_given": given,
        "far_shell": one.shell,
        **make_levels_record(coarse, snapshot.cameras),
    }


def _encode_extra_files(snapshot: Snapshot, one: MergedScene, coarse: Sequence[DetailLevel]) -> dict[str, bytes]:
    """levels/1.ply and so on, levels.json (from how far away each suffices), each submap's piece, and depth.npz."""
    parts = {f"levels/{number}.ply": sanitize_gaussians(each.gaussians) for number, each in enumerate(coarse, 1)}
    source = one.gaussians.source_frame
    numbers = {each.scene_id: number for number, each in enumerate(one.shares)} | {SHELL_PIECE: SHELL}
    parts |= {
        make_piece_name(each): select_gaussians(one.gaussians, source == number) for each, number in numbers.items()
    }
    levels_file = json_bytes(snapshot.scale.record() | make_levels_record(coarse, snapshot.cameras))
    depths = {DEPTHS: encode_depths(one.depths)} if one.depths else {}
    return (
        {name: encode_ply(part, snapshot.scale) for name, part in parts.items()} | {LEVELS_FILE: levels_file} | depths
    )


def _print_report(report: dict[str, object], folder: Path) -> None:
    verdict, scenes = report["verdict"], report["scenes"]
    assert isinstance(verdict, dict) and isinstance(scenes, list)
    say(f"{verdict['code']}: {verdict['message']}")
    for each in scenes:
        say(f"{each['scene']}: {each['kept']} of {each['gaussians']} Gaussians kept")
    left_out = report["scenes_left_out"]
    assert isinstance(left_out, list)
    for each in left_out:
        say(f"left out: {each['scene']}: {each['reason']}")
    shell = f"{report['far_shell']} of them the far shell"
    say(f"{report['num_gaussians']} of {report['gaussians_given']} Gaussians ({shell})")
    say(f"results: {folder}/ (scene.ply, levels/, cameras.json, preview.png, report.json)")
