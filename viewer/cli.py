"""`splatnode view`: a result, a scene file or a running node, in a window, in a browser or as pictures."""

from __future__ import annotations

import argparse
import contextlib
import os
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import cv2

from splatnode.capture.messaging.network import Network
from splatnode.capture.process.config import parse_config, read_yaml
from splatnode.capture.process.terminal import say, show_progress, show_waiting
from splatnode.recon.result.rendering import use_threads
from splatnode.recon.result.stored_snapshot import load_images
from splatnode.recon.result.submap_index import is_map_set
from splatnode.viewer.pictures import update_picture, write_movie, write_series
from splatnode.viewer.probe import open3d_installed, probe_window
from splatnode.viewer.session import Session
from splatnode.viewer.sources import BUDGET, FixedSource, LiveSource, Maps, MapSource, Source, load_result, map_moment
from splatnode.viewer.splash import splash
from splatnode.viewer.state import Moment, ViewerState
from splatnode.viewer.verbs import find_chosen, load_viewers
from splatnode.viewer.web import server as web

EXIT_GOOD, EXIT_UNAVAILABLE = 0, 69

_NICENESS = 5  # the reconstruction is more important than the picture of it
_NO_OPEN3D = (
    "splatnode: the window needs Open3D, which is not installed. Run: pip install 'splatnode[viewer]'. "
    "A browser needs nothing more: splatnode view ... --web; nor do pictures: --headless, or --export turntable.mp4"
)

_PICTURE = 960, 720  # pixels, where no window is opened


def view(args: argparse.Namespace) -> int:
    """Shows what `args.what` names. Raises what opening it raises."""
    _check_web(args)
    further = find_chosen(args)
    if not (args.web or further or args.headless or args.export is not None):
        return _show_in_window(args)
    with show_waiting("reading the scene"):
        finished, network = _load_finished_source(args), _network(args)
    if args.web:
        where = web.resolve_address(args.listen, web.PORT if args.port is None else args.port, args.key)
        web.show(_source(finished, network), where, _lower_priority, say)
    if further is not None:
        _lower_priority()
        further.show(_source(finished, network), args)
        return EXIT_GOOD
    if args.export is None:
        return _write_pictures(args, finished, network)
    if finished is None or args.export.suffix.lower() != ".mp4":
        raise ValueError("--export needs a finished result and a file that ends with .mp4")
    width, height = args.size or _PICTURE
    with show_progress() as tell:
        say(write_movie(_moment(finished), args.export, width, height, args.num_frames, of=args.what, tell=tell))
    return EXIT_GOOD


def _show_in_window(args: argparse.Namespace) -> int:
    """Shows it in a window, or as pictures where there can be none."""
    installed = open3d_installed()
    with splash() if installed else contextlib.nullcontext(_do_nothing) as ready, ThreadPoolExecutor(1) as beside:
        finished, network = _load_finished_source(args), _network(args)
        if not installed:
            say(_NO_OPEN3D, error=True)
            return EXIT_UNAVAILABLE
        probing = beside.submit(probe_window)
        with contextlib.suppress(ImportError):  # the probe tells of it
            import_module("splatnode.viewer.window")  # brings Open3D, which takes as long as the probe
        probe = probing.result()
        if not probe.window:
            say(f"splatnode: no window: {probe.detail}. Writing pictures instead, as with --headless", error=True)
            ready()
            return _write_pictures(args, finished, network)
        source = _source(finished, network)
        from splatnode.viewer.window import show

        def on_open() -> None:
            ready()
            if finished is None:
                _lower_priority()

        session, size = Session(source, ViewerState()), args.size or probe.size
        show(session, software=probe.software, screenshots=_folder(args, finished), opened=on_open, size=size)
    return EXIT_GOOD


def _write_pictures(args: argparse.Namespace, finished: Moment | Maps | None, network: Network) -> int:
    width, height = args.size or _PICTURE
    folder = _folder(args, finished)
    if finished is not None:
        with show_progress() as tell:
            say(write_series(_moment(finished), folder, width, height, args.num_frames, of=args.what, tell=tell))
        return EXIT_GOOD
    source = _source(finished, network)
    _lower_priority()
    with contextlib.closing(source):
        update_picture(source, folder, width, height, until_final=args.exit_when_final, say=say)
    return EXIT_GOOD


def _folder(args: argparse.Namespace, finished: Moment | Maps | None) -> Path:
    """Returns the folder for pictures and edited scenes."""
    return args.out or (_default_folder(args.what) if finished is not None else Path("view"))


def _check_web(args: argparse.Namespace) -> None:
    """Raises ValueError for options that do not go together."""
    if args.key is not None and not args.web:
        raise ValueError("--key needs --web")
    alone = [name for name in ("port", "listen") if getattr(args, name) is not None]
    viewers = load_viewers()
    further = find_chosen(args)
    servers = [viewer.name for viewer in viewers if viewer.is_server]
    if alone and not args.web and (further is None or not further.is_server):
        raise ValueError(f"--{alone[0]} needs --{' or --'.join(['web', *servers])}")
    for viewer in viewers:
        viewer.check(args)
    if further is not None and (args.web or args.headless or args.export is not None):
        raise ValueError(f"--{further.name} {further.shows}; leave out --web, --headless and --export")
    if args.web and (args.headless or args.export is not None):
        raise ValueError("--web shows it in a browser; --headless and --export write pictures: one of them at a time")


def _load_finished_source(args: argparse.Namespace) -> Moment | Maps | None:
    """The result, or the folder of many, that is named; None where it is a running node."""
    if args.images is not None and not args.images.is_dir():
        raise FileNotFoundError(f"--images must be the folder of a result's photographs; {args.images} is none")
    if args.what is None or _is_configuration(args.what):
        return None
    if is_map_set(args.what):
        folder = args.images or args.what / "images"
        return Maps(args.what, lambda cameras: load_images(cameras, [folder]), args.max_gaussians or BUDGET)
    return load_result(args.what, args.images)


def _moment(finished: Moment | Maps) -> Moment:
    return finished if isinstance(finished, Moment) else map_moment(finished)


def _network(args: argparse.Namespace) -> Network:
    """Returns the network of the running node: that of its configuration, if one is named."""
    raw = read_yaml(args.what) if args.what is not None and _is_configuration(args.what) else {}
    return parse_config(raw.get("network", {}), Network, "network")


def _is_configuration(what: Path) -> bool:
    return what.suffix.lower() in (".yaml", ".yml")


def _source(finished: Moment | Maps | None, network: Network) -> Source:
    if finished is None:
        return LiveSource(network)
    return FixedSource(finished) if isinstance(finished, Moment) else MapSource(finished)


def _do_nothing() -> None:
    """Closes the splash that there is none of."""


def _lower_priority() -> None:
    """Beside a running node the viewer takes one thread, and steps back where the node wants the processors.

    Not before it is open: starting costs the node little, and the person should not wait for it.
    """
    use_threads(1)
    cv2.setNumThreads(1)
    os.nice(_NICENESS)


def _default_folder(what: Path) -> Path:
    return (what if what.is_dir() else what.parent) / "view"
