"""Photographs that come one at a time, reconstructed in the process that has them: no sockets, no daemon."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

import numpy.typing as npt

from splatnode.api.entrance import enter_api
from splatnode.api.image_arguments import (
    DepthOf,
    Mounts,
    append_motion,
    check_camera_id,
    find_mount,
    make_gravity,
    make_intrinsics,
    make_pose,
    parse_mounts,
    parse_single_depth,
)
from splatnode.api.photographs import Lens, Picture, lenses, make_frame
from splatnode.api.reconstruct import (
    Changes,
    Scale,
    build_config,
    check_counts,
    frame_changes,
    is_stereo,
    merge_former_argument,
    parse_matrix,
)
from splatnode.api.result import Result, result_of
from splatnode.capture.frame import Baseline, Frame, RightImage, Stamp, grey
from splatnode.capture.keyframe_selection import Config as Selection
from splatnode.capture.keyframe_selection import Selector
from splatnode.capture.lens_file import assign_lens, check_fits
from splatnode.capture.odometry import Motion
from splatnode.capture.process.terminal import Tell, ignore_progress
from splatnode.capture.quality import Limits
from splatnode.recon import threads as limits
from splatnode.recon.config import apply_changes
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.metric.metres import NOTHING, apply_metric_scale, gather_evidence
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.pipeline import OfflineResult, rebuild_from_scratch
from splatnode.recon.replay_source import Source
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import FrameChoice

_EACH = 1e9  # frames a second: each is examined


@dataclass(frozen=True, eq=False)
class Update:
    """The outcome for one photograph of a session, and the result after it."""

    name: str  # of the photograph
    taken: bool  # whether it counts; otherwise `reason` says why it does not
    reason: str  # why it was taken, or not: what it adds, or that it is blurred, a copy, ...
    result: Result  # of all photographs so far; coarse until `Session.finish`


class Session:
    """A reconstruction of one submap, up to some 30 keyframes, that grows as a node's does.

    Most frames of a camera's loop add too little and are not taken. Thread-safe. As a context manager it closes itself.
    """

    @enter_api()
    def __init__(
        self,
        *,
        intrinsics: Lens | None = None,
        poses_sigma: tuple[float, float] | None = None,
        check_poses: bool = False,
        scale: Scale | None = None,
        frame: FrameChoice | None = None,
        T_base_camera: Mounts | None = None,
        preset: str = "balanced",
        config: Changes | None = None,
        every_frame: bool = False,
        seed: int | None = None,
        threads: int | None = None,
        tell: Tell | None = None,
        poses_only_check: bool | None = None,
    ) -> None:
        """The arguments are those of `reconstruct`, without `budget_s`.

        `poses_sigma` is of poses that `add` gets without their own. Poses with sigmas are priors of cameras with a
        known lens, unless `check_poses`. While `frame` is not known the verdict is `FRAME_UNKNOWN`. Images without
        a name are called 0000.png, 0001.png, ...
        """
        check_counts(threads=threads)
        if is_stereo(scale):
            raise TypeError("a session gets stereo pairs with add(image, right=..., baseline_m=...), not as its scale")
        flags = {"seed": seed, "metric": frame_changes(frame, None, poses_sigma)}
        self._mounts = parse_mounts(T_base_camera)
        self._config = build_config(preset, config, flags, scale, of_pictures=True)
        former = "poses_only_check", poses_only_check
        self._only_checks = merge_former_argument(*former, "check_poses", check_poses)
        if self._config.budget_s is not None:
            raise ValueError("a session has no budget_s, for its photographs come one at a time; reconstruct has one")
        self._preset, self._lens, self._threads, self._tell = preset, intrinsics, threads, tell or ignore_progress
        self._selection = Selection(every_frame=every_frame, max_fps=_EACH, patience_s=0.0)
        self._selectors: dict[str, Selector] = {}  # by camera id
        self._work: IncrementalReconstruction | None = IncrementalReconstruction(self._config)
        self._trust_poses(poses_sigma)
        self._frames: dict[str, Frame] = {}  # that were taken
        self._given: set[str] = set()
        self._sizes: list[tuple[int, int]] = []  # (width, height) of those that were given, each once
        self._motion: Motion | None = None  # up to the photograph that was given last
        self._evidence = NOTHING  # of metres, in these frames
        self._snapshot: Snapshot | None = None
        self._lock = threading.RLock()

    @enter_api()
    def add(
        self,
        image: Picture,
        *,
        name: str | None = None,
        captured_at: Stamp | None = None,
        intrinsics: Lens | None = None,
        camera: str | None = None,
        pose: npt.ArrayLike | None = None,
        pose_sigma: tuple[float, float] | None = None,
        motion: npt.ArrayLike | None = None,
        motion_sigma: tuple[float, float] | None = None,
        gravity: npt.ArrayLike | None = None,
        gravity_sigma: float | None = None,
        right: Picture | None = None,
        baseline_m: float | None = None,
        depth: DepthOf = None,
    ) -> Update:
        """Offers the session an image: an array (H, W, 3) uint8 RGB, or a PIL image.

        - `intrinsics`: this image's lens, instead of the session's. `camera`: the id of its camera, of several: they
          share no lens.
        - `pose`, `pose_sigma`: T_world_camera (4, 4) in metres from odometry or a tracker, all in one world; metres and
          degrees (default: the session's). Two or more give metres and axes, and with sigmas and a known lens they are
          priors of the cameras.
        - `motion`, `motion_sigma`: T_previous_current (4, 4) in metres from wheels or an IMU, since the image given
          before, taken or not; metres and degrees of this motion alone. One or more give metres.
        - `gravity`, `gravity_sigma`: down (3,) in the camera's frame; degrees. It gives `Result.map` its up.
        - `right`, `baseline_m`: the rectified right image of a stereo pair, of the image's size, and the distance of
          its camera, metres. Pairs give metres.
        - `depth`: a depth image, as for `reconstruct`. It gives metres, and depth where images have no texture.

        Returns the outcome once the scene has grown: after seconds if the image is taken, else milliseconds. Raises
        TypeError and ValueError for wrong arguments, a repeated name, or a session lens with the aspect ratio of no
        image so far, and RuntimeError after `finish` or `close`.
        """
        with self._lock, limits.apply_thread_limit(self._threads):
            work = self._open()
            number = len(self._given)
            frame = self._make_frame(image, number, name or f"{number:04d}.png", captured_at, intrinsics, camera)
            if frame.name in self._given:
                raise ValueError(f"name must be new for each photograph; {frame.name!r} was given before")
            metric = self._config.metric
            given = make_pose(None if pose is None else parse_matrix(pose), pose_sigma, metric.poses_sigmas)
            self._trust_poses(pose_sigma)
            usual = metric.odometry_drift, metric.odometry_sigma_deg
            moved = append_motion(self._motion, frame.name, motion, motion_sigma, *usual)
            came = {"given_pose": given, "motion": moved, "gravity": make_gravity(gravity, gravity_sigma)}
            came["T_base_camera"] = find_mount(self._mounts, frame.camera_id)
            beside = {"right": _make_right_image(right, baseline_m), "depth": parse_single_depth(depth)}
            frame = replace(frame, **came, **beside)
            self._motion = moved
            self._given.add(frame.name)
            self._sizes += {(frame.width, frame.height)}.difference(self._sizes)
            selector = self._selectors.setdefault(frame.camera_id, Selector(self._selection, Limits()))
            decision = selector.decide(frame)
            if decision.take:
                self._frames[frame.name] = frame
                self._evidence = self._evidence.merge(gather_evidence((frame,), self._config.metric))
                work.add_frame(frame)
                work.update()
                made = work.snapshot()  # stereo pairs and depth images are measured by landmarks
                by_points = bool(self._evidence.pairs or self._evidence.depths)
                self._snapshot = add_landmarks(made, work.find_reconstruction()) if by_points else made
            taken = frame.name in work.names
            left_out = {each.name: each.reason for each in work.dropped}
            return Update(frame.name, taken, left_out.get(frame.name, decision.reason), self.result)

    @enter_api()
    def finish(self) -> Result:
        """Judges all photographs with all evidence, and makes their scene anew; the session is closed then.

        Raises RuntimeError after `finish` or `close`.
        """
        with self._lock, limits.apply_thread_limit(self._threads):
            *_, self._snapshot = rebuild_from_scratch(self._open(), self._tell)
            self.close()
            return self.result

    @property
    def result(self) -> Result:
        """Returns the result of all photographs so far."""
        with self._lock:
            snapshot = self._snapshot or self._nothing_yet()
            snapshot = apply_metric_scale(snapshot, self._config.metric, self._evidence)
            frames = tuple(self._frames.values())
            made = OfflineResult(snapshot, Source(frames, None, None), self._config.seed, self._preset)
            return result_of(snapshot, made, lenses(frames))

    def close(self) -> None:
        """Gives back what the session holds beside its last result."""
        with self._lock:
            self._work = None

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> IncrementalReconstruction:
        if self._work is None:
            raise RuntimeError("the session is closed: begin another one")
        return self._work

    def _trust_poses(self, sigma: tuple[float, float] | None) -> None:
        """Lets poses hold cameras from now on, where their standard deviations are told."""
        if sigma is None or self._only_checks:
            return
        work = self._open()
        work.config = self._config = apply_changes(self._config, {"registration": {"trust_poses": True}})

    def _nothing_yet(self) -> Snapshot:
        work = self._open()
        work.estimate_soon()
        return work.snapshot()

    def _make_frame(
        self, image: Picture, number: int, name: str, captured_at: Stamp | None, lens: Lens | None, camera: str | None
    ) -> Frame:
        made = make_frame(image, number, name, time.monotonic_ns(), captured_at)
        made = made if camera is None else replace(made, camera_id=check_camera_id(camera, "camera"))
        if lens is not None:
            known = make_intrinsics(lens, made.width, made.height)
            check_fits(known, [(made.width, made.height)])
            return assign_lens(made, known)
        if self._lens is None:
            return made
        sizes = [*self._sizes, (made.width, made.height)]
        known = make_intrinsics(self._lens, *sizes[0])
        check_fits(known, sizes)
        return assign_lens(made, known)


def _make_right_image(picture: Picture | None, baseline_m: float | None) -> RightImage | None:
    if picture is None and baseline_m is None:
        return None
    if picture is None or baseline_m is None:
        raise TypeError("right and baseline_m belong together: what the right camera saw, and how far away it stands")
    return RightImage(grey(make_frame(picture, 0, "right", 0).image), Baseline(float(baseline_m)))
