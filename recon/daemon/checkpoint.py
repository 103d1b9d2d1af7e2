"""The checkpoint: all that a daemon needs to continue after it was killed.

    ledger              where the active submap begins, and which frames are no longer stored
    frames/<number>     a keyframe as it came; numbers count all keyframes that ever came
    graph               features and matches
    judgement           the cameras that they lead to, the evidence and the verdict
    fallbacks           what was tried for want of matches, and gained nothing: it is not tried again
    scene               cameras and Gaussians as they are shown
    pointmaps           depth maps of its views, from which it grows
    left/<scene>/       an inactive submap whose scene is not final yet: a checkpoint of its own
    finished/<scene>/   one whose scene is final: frames, graph and judgement
    codes               in the folder of an inactive submap: it is verified, and is recognised by these

Graph, judgement, fallbacks, scene and pointmaps are computed again where they are missing. A keyframe is acknowledged
once its file is there, those of a frame set once all are: where a kill left some of a set out, the next start forgets
the others, and all come again. Every file is whole or not there, and has a checksum. A submap is what one scene shows.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, Stamp
from splatnode.capture.messaging.messages import Message, ReceivedFrame
from splatnode.capture.process.config import record_of
from splatnode.capture.process.files import (
    LockHeld,
    exclusive,
    list_own_files,
    make_owner_only_folder,
    remove_leftovers,
)
from splatnode.capture.process.system import is_shortage, raise_shortage
from splatnode.capture.process.text import LONGEST_NAME, sanitize_text
from splatnode.capture.rig import form_frame_sets
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.daemon import ledger as records
from splatnode.recon.daemon.ledger import (
    FRAME_FILE,
    MADE_ANEW,
    CheckpointError,
    Ledger,
    StoredFrame,
    ensure_identity,
    file_name,
    read_frame,
    write_frame,
    write_ledger,
)
from splatnode.recon.estimation import Reconstruction, prepare
from splatnode.recon.incremental import IncrementalReconstruction, ReconstructionCache, StreamState
from splatnode.recon.keyframes import Features, Keyframe, ScreeningState
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.modelling import prepare_scene_for_display
from splatnode.recon.priors import Pointmap
from splatnode.recon.registration.registration import RegisteredCamera, Registration, undistort_keyframe
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.scene import Gaussians, Scene, TrainingView
from splatnode.recon.scene import exposure as scene_exposure
from splatnode.recon.verification.evidence import Evidence

log = logging.getLogger(__name__)

REMEMBERED = 1000  # removed frames that are recognised if their sender missed the acknowledgement
REMEMBERED_DROPPED = 1000  # names and reasons, of a submap
_INSTEAD = "--checkpoint (or $XDG_STATE_HOME)"


class UnstorableFrame(ValueError):
    """A frame cannot be stored because of what it is."""

    def __init__(self, received: ReceivedFrame, error: Exception) -> None:
        super().__init__(f"it cannot be stored: {type(error).__name__}: {error}")
        self.received = received


class Store:
    """Reads and writes a checkpoint, from any thread. One process at a time uses a directory."""

    def __init__(self, directory: Path) -> None:
        """Raises CheckpointError where another process uses it, or where it is of another version or damaged.

        Raises NotOwnerOnly where another user could read or change it, and OSError.
        """
        self.directory = directory
        self._frames = directory / "frames"
        make_owner_only_folder(directory, _INSTEAD, ours=(directory / "ledger").is_file() or self._frames.is_dir())
        make_owner_only_folder(self._frames, _INSTEAD, ours=True)
        self._resources = contextlib.ExitStack()
        try:
            self._resources.enter_context(exclusive(directory / "lock"))
        except LockHeld as error:
            raise CheckpointError(
                f"another process uses the checkpoint in {directory}; stop it, or give another --checkpoint"
            ) from error
        remove_leftovers(directory)
        remove_leftovers(self._frames)
        self.ledger = ensure_identity(directory)
        records.remove_incomplete(directory, self.ledger.number)
        self._keys: dict[int, tuple[str, int]] = {}
        self._names: dict[str, int] = {}
        self._taken: dict[str, tuple[str, Stamp]] = {}  # camera id and time of the frames that have both
        self._next = self.ledger.next
        self._writing = threading.RLock()
        self._found = deque(self._read_frames())
        self._remove_incomplete_set()

    def close(self) -> None:
        self._resources.close()

    @property
    def scene_id(self) -> str:
        return self.ledger.scene_id

    @property
    def identity(self) -> str:
        """The identity of this checkpoint: 32 hexadecimal digits that never change."""
        return self.ledger.identity or ""

    @property
    def names(self) -> set[str]:
        """The names of the stored frames."""
        return set(self._names)

    def names_before(self, number: int) -> set[str]:
        """Returns the names of the stored frames that came before frame `number`."""
        names = self._names.copy()  # at once: another thread may store a frame meanwhile
        return {name for name, each in names.items() if each < number}

    def find_frame_set(self, name: str, tolerance_s: float) -> list[str]:
        """The names of the stored frames that several cameras took together with this one, which is among them."""
        with self._writing:
            timed = [(each, *self._taken[each]) for each in self._names if each in self._taken]
        sets = (list(each.names.values()) for each in form_frame_sets(timed, tolerance_s))
        return next((names for names in sets if name in names), [name])

    def holds(self, frame: Frame) -> bool:
        """Whether this very frame, and no other of its name, is stored."""
        return self._names.get(frame.name) == frame.frame_id

    @property
    def frames_dropped(self) -> list[DroppedFrame]:
        return [DroppedFrame(*entry) for entry in self.ledger.dropped]

    @property
    def frame_keys(self) -> list[tuple[str, int]]:
        """Session and sequence of the frames that were taken, which need not be sent again."""
        return [*self.ledger.gone, *self._keys.values()]

    def frames(self) -> Iterator[StoredFrame]:
        """The active submap's frames that an earlier process stored, oldest first; each is returned once."""
        while self._found:
            yield self._found.popleft()

    def _read_frames(self) -> Iterator[StoredFrame]:
        """The stored frames; a damaged one is renamed and logged, one that is there already left alone."""
        for path in list_own_files(self._frames, FRAME_FILE, ".frame"):
            number = int(path.stem)
            try:
                self._next = max(self._next, number + 1)
                stored = read_frame(path) if number >= self.ledger.first else None
                if stored is None or stored.key in self.ledger.gone:  # its removal did not come to its end
                    self._remove(number)
                    continue
            except (OSError, ValueError) as error:
                raise_shortage(error)
                log.error("a keyframe is lost on the disk, put aside: %s", error)
                path.rename(path.with_suffix(".damaged"))
                continue
            if stored.key in self._keys.values() or stored.frame.name in self._names:
                log.warning("left alone a copy of keyframe %s: %s", stored.frame.name, path)
                continue
            self._remember(stored)
            yield stored

    def _remove_incomplete_set(self) -> None:
        """Forgets the last frames where others that were to be stored together with them are not there.

        A kill came in between: nobody has acknowledged any of them, and all come again.
        """
        last = self._found[-1] if self._found else None
        if last is None or not last.following or self._next > last.number + 1:
            return
        if (self._frames / file_name(last.number + 1)).with_suffix(".damaged").exists():  # it was there
            return
        expected = last.following
        while self._found and self._found[-1].following == expected:
            stored = self._found.pop()
            self._remove(stored.number)
            self._forget_frame(stored.frame.name, stored.number)
            self._next, expected = stored.number, expected + 1

    def add_frame(self, received: ReceivedFrame) -> StoredFrame | None:
        """Returns when the frame is on the disk, under a name that no other has; None for one that was dropped.

        Raises OSError where the disk does not take it.
        """
        return next(iter(self.add_frames([received])), None)

    def add_frames(self, together: Sequence[ReceivedFrame]) -> list[StoredFrame]:
        """As `add_frame`, of frames that were taken together: all are stored or none is, also if the process is killed.

        Raises OSError, and UnstorableFrame, which tells the one that no disk would take.
        """
        with self._writing:
            for each in together:
                if isinstance(each.frame, DroppedFrame):
                    self._drop_frames({}, [(each.session, each.sequence)], [(each.frame.name, each.frame.reason)])
            images = [each for each in together if isinstance(each.frame, Frame)]
            found: list[StoredFrame] = []
            try:
                for following, received in zip(reversed(range(len(images))), images, strict=True):
                    found.append(self._write_frame(received, [each.frame.name for each in found], following))
            except BaseException:
                for stored in found:
                    self._remove(stored.number)
                raise
            self._next += len(found)
            for stored in found:
                self._remember(stored)
            return found

    def _write_frame(self, received: ReceivedFrame, others: Sequence[str], following: int) -> StoredFrame:
        """Writes one of frames that are stored together: the `others` before it, so many `following` it.

        Raises OSError, UnstorableFrame, and what tells a shortage of memory.
        """
        number, key, frame = self._next + len(others), (received.session, received.sequence), received.frame
        assert isinstance(frame, Frame)
        try:
            name = self._make_unique_name(frame.name, number, others)
            write_frame(self._frames / file_name(number), key, replace(frame, name=name), following)
            return StoredFrame(number, key, replace(frame, frame_id=number, name=name, encoded=None), following)
        except Exception as error:
            if isinstance(error, OSError) or is_shortage(error):
                raise
            raise UnstorableFrame(received, error) from error

    def forget(self, name: str, reason: str) -> None:
        """Removes a frame, if it is there, and records it with the reason as dropped. Raises OSError."""
        self.forget_frames([name], reason)

    def forget_frames(self, names: Iterable[str], reason: str, elsewhere: Iterable[tuple[str, str]] = ()) -> None:
        """As `forget`, of several frames at once, so that no kill leaves half of a frame set. Raises OSError.

        `elsewhere`: ids of scenes of inactive submaps, each with a name; these scenes are to lose such a frame.
        """
        with self._writing:
            here = {self._names[name]: name for name in names if name in self._names}
            retracted = tuple(dict.fromkeys((*self.ledger.retracted, *elsewhere)))
            if here or retracted != self.ledger.retracted:
                keys = [self._keys[number] for number in here]
                self._drop_frames(here, keys, [(name, reason) for name in here.values()], retracted)

    def confirm_removal(self, scene: str, name: str) -> None:
        """Records that the scene has lost the frame. Raises OSError."""
        with self._writing:
            retracted = tuple(each for each in self.ledger.retracted if each != (scene, name))
            self._write(msgspec.structs.replace(self.ledger, retracted=retracted))

    def leave_submap(self, first: int, shared: Collection[str] = ()) -> None:
        """Begins the next submap as `begin_submap` does, and keeps the present one as an inactive one. Raises OSError.

        `shared` are frames from `first` on that belong to both. A kill in between leaves the submap as it was.
        """
        with self._writing:
            own = (number for name, number in self._names.items() if number < first or name in shared)
            frames = [f"frames/{file_name(number)}" for number in own]
            made = [name for name in MADE_ANEW if (self.directory / name).exists()]
            ledger = msgspec.structs.replace(self.ledger, next=self._next, gone=(), identity=None, retracted=())
            records.link_left_checkpoint(self.directory, ledger, [*frames, *made], _INSTEAD)
            self.begin_submap(first, shared)

    def split_off(self, names: Collection[str], present: bool = False) -> str:
        """Makes a submap of its own of some of its frames, forgets them, and returns its id. Raises OSError.

        It waits among the inactive submaps. `present`: this one is the active submap, else it is inactive, too.
        """
        with self._writing:
            numbers = sorted(self._names[name] for name in names)
            began = {
                "part": numbers[0] + 1,
                "first": numbers[0],
                "gone": (),
                "dropped": (),
                "follows": "",
                "shared": (),
            }
            ledger = msgspec.structs.replace(self.ledger, next=self._next, identity=None, retracted=(), **began)
            frames = [f"frames/{file_name(number)}" for number in numbers]
            records.link_split_checkpoint(self.directory, ledger, frames, _INSTEAD, present)
            for name in names:
                self.forget(name, f"it shows another place: {ledger.scene_id}")
            return ledger.scene_id

    def begin_submap(self, first: int, shared: Collection[str] = ()) -> None:
        """Begins the next submap with frame `first`; the frames before it and their scene are removed. Raises OSError.

        It goes on from the present one where they have `shared` frames.
        """
        with self._writing:
            # First: what a kill leaves of the submap before can be made anew, of this one not.
            records.remove_rebuild_requests(self.directory, *MADE_ANEW)
            before = {number: name for name, number in self._names.items() if number < first}
            gone = (*self.ledger.gone, *(self._keys[number] for number in before))
            number = self.ledger.number + 1
            began = {"number": number, "first": first, "next": self._next, "gone": gone[-REMEMBERED:], "dropped": ()}
            chain = {"follows": self.scene_id if shared else "", "shared": tuple(sorted(shared))}
            self._write(msgspec.structs.replace(self.ledger, **began, **chain))
            self._unlink(before)

    def save(self, name: str, header: msgspec.Struct, arrays: list[Any]) -> None:
        """Writes one of the files that can be made anew. Raises OSError."""
        records.save(self.directory, name, header, arrays)

    def load(self, name: str, schema: Any) -> Message[Any] | None:
        """Loads what `save` wrote under this name; None where it is missing or damaged."""
        return records.load(self.directory, name, schema)

    def remove_scene_files(self) -> None:
        """Removes what only a scene that grows has need of. Raises OSError."""
        records.remove_rebuild_requests(self.directory, *records.SHOWN)

    def finalize(self) -> None:
        """Moves an inactive submap to the finished ones. Nothing is read or written here afterwards.

        Raises OSError.
        """
        records.move_to_finished(self.directory, _INSTEAD)

    def _drop_frames(
        self,
        frames: Mapping[int, str],
        keys: Iterable[tuple[str, int]],
        dropped: Iterable[tuple[str, str]],
        retracted: tuple[tuple[str, str], ...] | None = None,
    ) -> None:
        """Records names as `dropped`, with the reason, and removes those that are stored `frames`."""
        ledger = self.ledger
        shown = [(sanitize_text(name, LONGEST_NAME), sanitize_text(reason)) for name, reason in dropped]
        self._write(
            msgspec.structs.replace(
                ledger,
                next=self._next,
                gone=(*ledger.gone, *keys)[-REMEMBERED:],
                dropped=(*ledger.dropped, *shown)[-REMEMBERED_DROPPED:],
                retracted=ledger.retracted if retracted is None else retracted,
            )
        )
        self._unlink(frames)

    def _unlink(self, frames: Mapping[int, str]) -> None:
        for number, name in frames.items():
            self._remove(number)
            self._forget_frame(name, number)

    def _forget_frame(self, name: str, number: int) -> None:
        del self._names[name], self._keys[number]
        self._taken.pop(name, None)

    def _remove(self, number: int) -> None:
        """The ledger says already that the frame is gone: where the disk keeps the file, the next start removes it."""
        try:
            (self._frames / file_name(number)).unlink(missing_ok=True)
        except OSError as error:
            log.warning("frame %d is gone, but its file cannot be removed now: %s", number, error.strerror)

    def _remember(self, stored: StoredFrame) -> None:
        self._names[stored.frame.name] = stored.number
        self._keys[stored.number] = stored.key
        if stored.frame.camera_id and stored.frame.captured_at is not None:
            self._taken[stored.frame.name] = stored.frame.camera_id, stored.frame.captured_at

    def _make_unique_name(self, name: str, number: int, others: Collection[str] = ()) -> str:
        """The name, or one made of it that no other frame has, nor one of the `others`."""
        further = (f"{number:06d}-{copy}-{name}" for copy in itertools.count(2))
        names = (each[:LONGEST_NAME] for each in itertools.chain((name, f"{number:06d}-{name}"), further))
        # What is saved of a frame that was dropped may still be on the disk: no other gets its name.
        taken = {*self._names, *others, *(dropped for dropped, _ in self.ledger.dropped)}
        return next(each for each in names if each not in taken)

    def _write(self, ledger: Ledger) -> None:
        write_ledger(self.directory, ledger)
        self.ledger = ledger


# The view graph and the scene as messages for the checkpoint.

T = TypeVar("T")
Numbers = dict[str, bool | int | float | None]


class GraphRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: those of each keyframe's features, then those of each pair, in the order of their fields."""

    names: list[str]
    features: list[Numbers]
    pairs: list[tuple[int, int, Numbers]]
    pending: list[tuple[int, int]]  # that have not been compared


class SceneRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: Ts_world_camera (C, 4, 4), Ks (C, 3, 3), then those of the Gaussians in the order of their fields."""

    views: list[str]  # their names
    iterations: int
    final: bool
    lenses: list[Intrinsics | None] = []  # estimated, of each view; empty: of none
    gains: list[tuple[float, float, float] | None] = []  # of each view's photograph over its image; empty: of none
    falloffs: list[float] = []  # of each view's lens; empty: none dims its corners
    headroom: float = 1.0
    consistent_depth: list[float | None] = []  # share of each view's pixels; empty: not known of any
    gain_sigmas: list[tuple[float, float, float] | None] = []  # of the logarithms of `gains`; empty: not known of any


def make_graph_message(graph: ViewGraph) -> tuple[GraphRecord, list[npt.NDArray]]:
    """Header and arrays of the message that holds `graph`."""
    features = [flatten_dataclass(keyframe.features) for keyframe in graph.keyframes]
    pairs = {key: flatten_dataclass(pair) for key, pair in graph.pairs.items()}
    header = GraphRecord(
        names=[keyframe.name for keyframe in graph.keyframes],
        features=[numbers for numbers, _ in features],
        pairs=[(*key, numbers) for key, (numbers, _) in pairs.items()],
        pending=sorted(graph.pending),
    )
    return header, [array for _, arrays in (*features, *pairs.values()) for array in arrays]


@dataclass(frozen=True, eq=False)
class SavedGraph:
    """Features and pairs by the names of their keyframes."""

    features: dict[str, Features]
    pairs: dict[tuple[str, str], TwoView]
    pending: list[tuple[str, str]]


def parse_graph(message: Message[GraphRecord]) -> SavedGraph:
    """Parses the message of `make_graph_message`. Raises ValueError where another version wrote it."""
    names, arrays = message.header.names, iter(message.arrays)
    features = [unflatten_dataclass(Features, numbers, arrays) for numbers in message.header.features]
    pairs = {
        (names[i], names[j]): unflatten_dataclass(TwoView, numbers, arrays) for i, j, numbers in message.header.pairs
    }
    pending = [(names[i], names[j]) for i, j in message.header.pending]
    return SavedGraph(dict(zip(names, features, strict=True)), pairs, pending)


def make_scene_message(scene: Scene, final: bool) -> tuple[SceneRecord, list[npt.NDArray]]:
    """Header and arrays of the message that holds `scene`; `final`: it is finished."""
    views = [view.name for view in scene.views]
    cameras = [torch.stack([view.T_world_camera for view in scene.views]), torch.stack([v.K for v in scene.views])]
    gaussians = [getattr(scene.gaussians, field.name) for field in fields(Gaussians)]
    lenses = [view.lens for view in scene.views]
    gains = [view.exposure and view.exposure.gains for view in scene.views]
    falloffs = [view.exposure.falloff if view.exposure else 0.0 for view in scene.views]
    shares = [view.consistent_depth for view in scene.views]
    sigmas = [view.exposure and view.exposure.sigmas for view in scene.views]
    header = SceneRecord(views, scene.iterations, final, lenses, gains, falloffs, scene.headroom, shares, sigmas)
    return header, [tensor.numpy() for tensor in (*cameras, *gaussians)]


def parse_scene(message: Message[SceneRecord], keyframes: Mapping[str, Keyframe]) -> Scene | None:
    """The scene that was saved; None where a frame of it is gone. Raises ValueError as `parse_graph`."""
    header = message.header
    if any(name not in keyframes for name in header.views):
        return None
    if len(message.arrays) != 2 + len(fields(Gaussians)):
        raise ValueError(f"a scene of {len(message.arrays)} arrays is of another version")
    Ts_world_camera, Ks, *gaussians = (torch.from_numpy(np.array(array)) for array in message.arrays)
    lenses = header.lenses or [None] * len(header.views)
    gains = header.gains or [None] * len(header.views)
    falloffs = header.falloffs or [0.0] * len(header.views)
    sigmas = header.gain_sigmas or [None] * len(header.views)
    views = tuple(
        _make_view(
            keyframes[name] if lens is None else undistort_keyframe(keyframes[name], lens), own, T_world_camera, K
        )
        for name, lens, own, T_world_camera, K in zip(
            header.views, lenses, zip(gains, falloffs, sigmas, strict=True), Ts_world_camera, Ks, strict=True
        )
    )
    shares = header.consistent_depth or [None] * len(views)
    views = tuple(replace(view, consistent_depth=share) for view, share in zip(views, shares, strict=True))
    return Scene(views, Gaussians(*gaussians), header.iterations, headroom=header.headroom)


def _make_view(
    keyframe: Keyframe,
    told: tuple[tuple[float, float, float] | None, float, tuple[float, float, float] | None],
    T_world_camera: torch.Tensor,
    K: torch.Tensor,
) -> TrainingView:
    """`told`: the photograph's gains, its lens's falloff, and the sigmas of the gains' logarithms."""
    image, exposure = scene_exposure.compensate_image(keyframe.image, *told)
    shown = keyframe.name, keyframe.frame.frame_id, image
    return TrainingView(*shown, T_world_camera, K, mask=keyframe.mask, exposure=exposure, lens=keyframe.lens)


def flatten_dataclass(value: Any) -> tuple[Numbers, list[npt.NDArray]]:
    """A flat dataclass as its numbers and its arrays."""
    content = {field.name: getattr(value, field.name) for field in fields(value)}
    arrays = [part for part in content.values() if isinstance(part, np.ndarray)]
    return {name: _convert_number(part) for name, part in content.items() if not isinstance(part, np.ndarray)}, arrays


def _convert_number(number: Any) -> bool | int | float | None:
    return number.item() if isinstance(number, np.generic) else number


def unflatten_dataclass(kind: type[T], numbers: Numbers, arrays: Any) -> T:
    """Inverse of `flatten_dataclass`; takes from `arrays` as many as it needs.

    Raises ValueError where they do not fit.
    """
    names = [field.name for field in fields(kind)]  # pyright: ignore[reportArgumentType]
    if not set(numbers) <= set(names):
        raise ValueError(f"a {kind.__name__} with {', '.join(sorted(numbers))} is of another version")
    try:
        return kind(**numbers, **{name: next(arrays) for name in names if name not in numbers})
    except (StopIteration, RuntimeError) as error:
        raise ValueError(f"arrays of a {kind.__name__} are missing") from error


# What is known of a scene's cameras and depths, as messages for the checkpoint: a restart need not find it again.

OF_REGISTRATION = ("points", "observed_by", "observed_point", "observed_pixels")
OF_POINTMAP = ("depth", "confidence", "normal", "T_world_camera", "K", "unchecked")


class ReconstructionRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: those of each camera in the order of their fields, then OF_REGISTRATION."""

    names: list[str]  # of the keyframes, as the cameras number them
    proven: list[str]
    verdict: Verdict
    evidence: Evidence
    cameras: list[Numbers]
    inlier_ratios: list[tuple[int, int, float]]
    numbers: Numbers  # of the registration


class FallbacksRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fallbacks that gained nothing, as recon.incremental.ReconstructionCache has them."""

    fruitless: list[tuple[str, str]]


class PointmapsRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: OF_POINTMAP for each; depths as half floats, confidence and normals in 256 steps.

    `unchecked` is empty where there is none.
    """

    names: list[str]


def make_reconstruction_message(
    estimate: Reconstruction, proven: Collection[str]
) -> tuple[ReconstructionRecord, list[npt.NDArray]]:
    """Makes the message, without depth. Raises ValueError where cameras or evidence are missing."""
    registration, evidence = estimate.registration, estimate.evidence
    if registration is None or evidence is None:
        raise ValueError("only an estimate with cameras and evidence is kept")
    registration = registration.image_part  # a rig places its cameras again when all are registered anew
    cameras = [flatten_dataclass(camera) for camera in registration.cameras]
    kept = {field.name: getattr(registration, field.name) for field in fields(registration)}
    record = ReconstructionRecord(
        names=estimate.graph.names,
        proven=sorted(proven),
        verdict=estimate.verdict,
        evidence=record_of(msgspec.to_builtins(evidence, enc_hook=lambda number: number.item()), Evidence),
        cameras=[numbers for numbers, _ in cameras],
        inlier_ratios=[(int(i), int(j), float(ratio)) for (i, j), ratio in registration.inlier_ratios.items()],
        numbers={name: float(value) for name, value in kept.items() if isinstance(value, (int, float))},
    )
    arrays = [array for _, of_camera in cameras for array in of_camera]
    return record, [*arrays, *(kept[name] for name in OF_REGISTRATION)]


def parse_reconstruction(message: Message[ReconstructionRecord], graph: ViewGraph) -> Reconstruction:
    """Parses a message of `make_reconstruction_message`. Raises ValueError where another version wrote it."""
    header, arrays = message.header, iter(message.arrays)
    cameras = tuple(_parse_camera(numbers, arrays) for numbers in header.cameras)
    inlier_ratios = {(i, j): ratio for i, j, ratio in header.inlier_ratios}
    content: dict[str, Any] = {"cameras": cameras, "inlier_ratios": inlier_ratios, **header.numbers}
    try:
        registration = Registration(**content, **dict(zip(OF_REGISTRATION, arrays, strict=True)))
    except TypeError as error:
        raise ValueError("an estimate of another version") from error
    return Reconstruction(graph, registration, header.evidence, header.verdict)


def _parse_camera(numbers: Numbers, arrays: Iterator[npt.NDArray]) -> RegisteredCamera:
    """Parses a camera; up to version 6 a lens had one radial coefficient, a number."""
    camera = unflatten_dataclass(RegisteredCamera, numbers, arrays)
    if "radial" not in numbers:
        return camera
    return replace(camera, radial=np.array([numbers["radial"], 0.0], np.float64))


def make_pointmaps_message(pointmaps: Mapping[str, Pointmap]) -> tuple[PointmapsRecord, list[npt.NDArray]]:
    arrays = []
    for pointmap in pointmaps.values():
        depth = pointmap.depth.astype(np.float16).view(np.uint16)
        confidence = np.rint(255 * pointmap.confidence).astype(np.uint8)
        normal = np.rint(127 * pointmap.normal + 128).astype(np.uint8)
        unchecked = np.zeros((0, 0), np.float16) if pointmap.unchecked is None else pointmap.unchecked
        arrays += [depth, confidence, normal, pointmap.T_world_camera, pointmap.K, unchecked.view(np.uint16)]
    return PointmapsRecord(list(pointmaps)), arrays


def parse_pointmaps(message: Message[PointmapsRecord], keyframes: Mapping[str, Keyframe]) -> dict[str, Pointmap]:
    """The point maps of those keyframes that there are. Raises ValueError as `parse_reconstruction`."""
    names, arrays = message.header.names, message.arrays
    if len(arrays) != len(OF_POINTMAP) * len(names):
        raise ValueError(f"{len(names)} point maps with {len(arrays)} arrays are of another version")
    found = {}
    for index, name in enumerate(names):
        if name not in keyframes:
            continue
        depth, confidence, normal, T_world_camera, K, unchecked = arrays[len(OF_POINTMAP) * index :][: len(OF_POINTMAP)]
        found[name] = Pointmap(
            name=name,
            frame_id=keyframes[name].frame.frame_id,
            depth=np.asarray(depth.view(np.float16), np.float32),
            confidence=np.asarray(confidence / 255, np.float32),
            normal=np.asarray((normal - 128.0) / 127, np.float32),
            T_world_camera=np.array(T_world_camera),
            K=np.array(K),
            unchecked=np.array(unchecked).view(np.float16) if unchecked.size else None,
        )
    return found


# A reconstruction into the checkpoint and out of it again. What is missing there is made anew from the keyframes.


@dataclass(frozen=True, eq=False)
class RestoredReconstruction:
    work: IncrementalReconstruction
    keyframes: int
    new: list[Keyframe]  # that the reconstruction does not know yet
    final: bool  # whether its scene is as good as it gets


def save(store: Store, work: IncrementalReconstruction, final: bool) -> None:
    """Keeps what `work` knows; whether its scene is `final`. Raises OSError."""
    store.save("graph", *make_graph_message(work.graph))
    save_fallbacks(store, work)
    estimate = work.find_reconstruction()
    # Cameras that given poses hold have no evidence, and the rig of others is not kept, nor its metres: they are
    # estimated anew after a restart.
    is_kept = estimate is not None and estimate.publishable and estimate.evidence is not None
    if estimate is not None and is_kept and (estimate.registration is None or estimate.registration.rig is None):
        store.save("judgement", *make_reconstruction_message(estimate, work.publishable_names))
    if work.scene is not None:
        store.save("pointmaps", *make_pointmaps_message(work.state.pointmaps))
        store.save("scene", *make_scene_message(work.scene, final))


def save_fallbacks(store: Store, work: IncrementalReconstruction) -> None:
    """Keeps which fallbacks gained nothing. Raises OSError."""
    fruitless = work.state.memory.fruitless
    if fruitless:
        store.save("fallbacks", FallbacksRecord(list(fruitless)), [])


def restore(store: Store, config: ReconstructionConfig) -> RestoredReconstruction:
    """The reconstruction that the checkpoint holds. A frame that cannot be used is left out of it for good.

    Raises MemoryError and the like: what there is no memory for now is no fault of the files.
    """
    frames = [stored.frame for stored in store.frames()]
    try:
        return _restore_reconstruction(store, frames, config)
    except Exception as error:  # whatever the files of another version, or of a faulty disk, make fail
        if is_shortage(error):
            raise
        log.warning("the checkpoint's scene is made anew: %s: %s", type(error).__name__, error)
        keyframes = _prepare_keyframes(store, frames, config, {})
        return RestoredReconstruction(
            IncrementalReconstruction(config), len(keyframes), list(keyframes.values()), final=False
        )


def load_graph(store: Store, config: ReconstructionConfig) -> ViewGraph:
    """The view graph that the checkpoint holds; an empty one where it holds none. Raises OSError."""
    record = store.load("graph", GraphRecord)
    if record is None:
        return ViewGraph(config.matching)
    before = parse_graph(record)
    keyframes = _prepare_keyframes(store, [stored.frame for stored in store.frames()], config, before.features)
    return _make_graph(config, [keyframe for name, keyframe in keyframes.items() if name in before.features], before)


def _prepare_keyframes(
    store: Store, frames: Sequence[Frame], config: ReconstructionConfig, known: Mapping[str, Features]
) -> dict[str, Keyframe]:
    """The keyframes by their names, with the features that are known."""
    keyframes = {}
    for frame in frames:
        try:
            keyframes[frame.name] = prepare(frame, config, known.get(frame.name))
        except Exception as error:
            if is_shortage(error):
                raise
            log.error("%s cannot be used: %s", frame.name, error)
            with contextlib.suppress(OSError):  # the next start finds it again
                store.forget(frame.name, f"cannot be used: {error}")
    return keyframes


def _restore_reconstruction(
    store: Store, frames: Sequence[Frame], config: ReconstructionConfig
) -> RestoredReconstruction:
    record = store.load("graph", GraphRecord)
    before = parse_graph(record) if record is not None else SavedGraph({}, {}, [])
    keyframes = _prepare_keyframes(store, frames, config, before.features)
    record = store.load("scene", SceneRecord)
    scene = parse_scene(record, keyframes) if record is not None else None
    final = record is not None and record.header.final and scene is not None
    record = store.load("pointmaps", PointmapsRecord)
    graph = _make_graph(config, [keyframes[name] for name in keyframes if name in before.features], before)
    known = StreamState(
        graph,
        beside=ViewGraph(config.matching),
        screened=_screen_keyframes(graph),
        memory=_load_memory(store, graph),
        pointmaps=parse_pointmaps(record, keyframes) if record is not None else {},
        show=prepare_scene_for_display(scene, config),
    )
    new = [keyframe for name, keyframe in keyframes.items() if name not in before.features]
    return RestoredReconstruction(IncrementalReconstruction(config, known), len(keyframes), new, final)


def _make_graph(config: ReconstructionConfig, keyframes: Sequence[Keyframe], before: SavedGraph) -> ViewGraph:
    """The view graph of the keyframes, with what an earlier process knew of their pairs."""
    position = {keyframe.name: index for index, keyframe in enumerate(keyframes)}
    pairs = {(position[i], position[j]): pair for (i, j), pair in before.pairs.items() if {i, j} <= position.keys()}
    pending = {(position[i], position[j]) for i, j in before.pending if {i, j} <= position.keys()}
    return ViewGraph(config.matching, tuple(keyframes), pairs, frozenset(pending))


def _screen_keyframes(graph: ViewGraph) -> ScreeningState:
    screened = ScreeningState()
    for keyframe in graph.keyframes:
        screened = screened.add_known_frame(keyframe.frame)
    return screened


def _load_memory(store: Store, graph: ViewGraph) -> ReconstructionCache:
    """Loads the estimate of exactly these keyframes, if there is one, and the fruitless fallbacks."""
    record = store.load("fallbacks", FallbacksRecord)
    memory = ReconstructionCache(fruitless=() if record is None else tuple(record.header.fruitless))
    record = store.load("judgement", ReconstructionRecord)
    if record is None or record.header.names != graph.names:
        return memory
    estimate, proven = parse_reconstruction(record, graph), frozenset(record.header.proven)
    return replace(memory, recent=(((tuple(graph.names), 0), estimate),), proven=proven)
