"""A video file decoded by PyAV: each frame with its own number and the container's time, upright, with square pixels.

PyAV is the one decoder of video files; OpenCV reads cameras.
"""

from __future__ import annotations

import contextlib
from bisect import bisect_left, insort
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.error import FFmpegError
from av.sidedata.sidedata import Type
from av.stream import Disposition
from av.video.reformatter import VideoReformatter

TOLERANCE_NS = 500_000  # by which a frame may be before a limit and counts as at it: containers round to milliseconds
_CONTAINERS = (  # those that hold their own pictures; playlists, and lists of other files and addresses, are none
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,av1,obu,ivf,mjpeg,mpjpeg,asf,flv,"
    "live_flv,ogg,mxf,nut,dv,rm,gif,apng,wtv,yuv4mpegpipe,vc1,vvc,h263,h261,amv,nsv,swf"
)
_MAX_DISORDER_NS = 10**9  # by which a frame may be told to be before the last one; by more, the clock was set back
_SQUARE_RANGE = Fraction(1, 8), Fraction(8)  # of the shapes of pixels that are believed, widths over heights
_DEFAULT_RATE = Fraction(25)  # frames a second of a bare stream that tells neither times nor a rate, as FFmpeg has it
_MIN_FRAME_RATIO = 0.9  # of the frames, or of the seconds, that a container states: some state a few too many
_MAX_MISSING_GAPS = 2  # longest gaps between frames that may be missing at the end, where a duration alone is stated
_MATRIX_BYTES = 36  # of a display matrix: nine numbers of 32 bits


class NotReadable(ValueError):
    """The file is nothing that is read here."""


class NoPictures(ValueError):
    """The file has sound or data, and no pictures that follow each other."""


class TooLarge(ValueError):
    """Its frames have more pixels than may be decoded."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(f"{width} x {height}")
        self.width, self.height = width, height


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """One frame of a video."""

    index: int  # its place among all frames of the video, in the order of their times
    time_ns: int  # since the first frame of the video
    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB, as a player shows it
    pixel_aspect: float  # width of a stored pixel over its height; 1 where the image has the stored pixels


@dataclass
class _Timeline:
    """Gives each frame its place in the video, by the times of the packets that hold the frames.

    Packets come in the order of decoding, frames in that of their times; before a frame comes, all packets of earlier
    frames were read. So a frame that cannot be decoded leaves a gap in the numbers.
    """

    unit_s: Fraction  # seconds of a pts
    begins: int | None = None  # pts of the video's first frame; None: no packet has told one yet
    before: int = 0  # frames of the video that come before those of `waiting`
    waiting: list[int] = field(default_factory=list)  # pts of packets whose frames have not come yet, rising
    decoding_times: list[int] = field(default_factory=list)  # dts of the packets that have no pts, rising
    last_index: int = -1
    last_ns: int = 0
    end_ns: int = 0  # of the last frame
    longest_ns: int = 0  # between two frames
    shift_ns: int = 0  # by which the container set its clock back so far, as where streams are joined

    def add(self, pts: int | None, dts: int | None) -> None:
        """Notes a packet whose frame is to be shown, before it is decoded."""
        if pts is not None:
            insort(self.waiting, pts)
        elif dts is not None:
            insort(self.decoding_times, dts)

    def place(self, pts: int | None, frame_ns: int) -> tuple[int, int]:
        """Returns the index and the time in ns of the next frame: indices grow, times never fall."""
        pts = self.waiting[0] if pts is None and self.waiting else pts
        index, time_ns = self._place_after_last() if pts is None else self._place_by_time(pts)
        if time_ns < self.last_ns - _MAX_DISORDER_NS:
            self.shift_ns += self.end_ns - time_ns
            time_ns = self.end_ns
        time_ns = max(time_ns, self.last_ns)
        if self.last_index >= 0:
            self.longest_ns = max(self.longest_ns, time_ns - self.last_ns)
        self.last_index, self.last_ns, self.end_ns = max(index, self.last_index + 1), time_ns, time_ns + frame_ns
        return self.last_index, time_ns

    def _place_by_time(self, pts: int) -> tuple[int, int]:
        if self.begins is None:  # of the packets that were read before the first frame came, the earliest tells it
            self.begins = min([pts, *self.waiting[:1]])
        place = bisect_left(self.waiting, pts)
        index = self.before + place
        taken = place + (self.waiting[place : place + 1] == [pts])
        del self.waiting[:taken]
        self.before += taken
        return index, self._ns(pts - self.begins) + self.shift_ns

    def _place_after_last(self) -> tuple[int, int]:
        """A frame without a time is the next one: at the time that decoding had for it, or when the last one ends."""
        index = self.last_index + 1
        if self.begins is None and index < len(self.decoding_times):
            return index, self._ns(self.decoding_times[index] - self.decoding_times[0])
        return index, self.end_ns

    def _ns(self, units: int) -> int:
        return round(units * self.unit_s * 10**9)


class Video:
    """An open video. Close it."""

    def __init__(self, file: Path, threads: int) -> None:
        """Raises NotReadable, and NoPictures where it is read and has no pictures that follow each other."""
        self._file, self._threads = file, threads
        self._reformatter = VideoReformatter()  # one for all frames: each has threads and tables of its own
        self._turned_shape: tuple[int, int, int] | None = None
        self._matrix: npt.NDArray[np.int32] | None = None
        self.lost = 0  # packets so far that could not be decoded
        self.is_cut = False  # whether it ends before the frames that it states; known once its end was read
        self._open()

    def close(self) -> None:
        """Closes the file."""
        self._container.close()

    def frames(self, from_ns: int, to_ns: int | None, every: int, max_pixels: int) -> Iterator[DecodedFrame]:
        """Yields every `every`-th frame from one time to before another; what cannot be decoded is counted in `lost`.

        A part is read without decoding what lies before it, where the video can be sought: its frames have the numbers,
        times and pixels that they have when all is read. Raises TooLarge.
        """
        _check_size(self._stream.width, self._stream.height, max_pixels)
        from_ns, end_ns = max(0, from_ns - TOLERANCE_NS), None if to_ns is None else to_ns - TOLERANCE_NS
        timeline, packets = self._seek(from_ns) if from_ns else (_Timeline(self._unit_s), self._packets())
        first = None
        for frame in self._decode(packets, timeline):
            index, time_ns = timeline.place(self._pts(frame), self._duration_ns(frame))
            if end_ns is not None and time_ns >= end_ns:
                return
            if time_ns < from_ns:
                continue
            first = index if first is None else first
            if (index - first) % every == 0:
                yield self._convert(frame, index, time_ns, max_pixels)
        self.is_cut = self._ends_early(timeline)

    def _open(self) -> None:
        options = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
        try:
            self._container = av.open(str(self._file), options=options)
        except MemoryError:
            raise
        except (FFmpegError, OSError, ValueError) as error:
            raise NotReadable(str(error)) from error
        streams = [each for each in self._container.streams.video if not _is_cover(each)]
        if not streams:
            self.close()
            raise NoPictures("no pictures that follow each other")
        self._stream = streams[0]
        if self._stream.codec_context is None:
            self.close()
            raise NotReadable("a codec that FFmpeg does not know")
        self._stream.codec_context.thread_count = self._threads
        self._stream.codec_context.thread_type = "AUTO"
        self._num_packets, self._decoded_until = 0, 0  # of the pictures, and the dts of the last one
        self._is_avi = self._container.format.name == "avi"
        self._has_pts = not (self._is_avi and self._stream.codec_context.has_b_frames)
        self._unit_s = self._stream.time_base or Fraction(1, 10**9)
        self._frame_ns = round(10**9 / (self._stream.guessed_rate or self._stream.average_rate or _DEFAULT_RATE))

    def _packets(self) -> Iterator[av.Packet]:
        """Those of the pictures, to the end or to where the container is damaged."""
        with contextlib.suppress(FFmpegError):
            yield from (packet for packet in self._container.demux(self._stream) if packet.size)

    def _pts(self, each: av.Packet | av.VideoFrame) -> int | None:
        """When it is shown; None where the container does not tell: an AVI has the times of decoding alone."""
        return each.pts if self._has_pts else None

    def _record_packet(self, packet: av.Packet, timeline: _Timeline) -> None:
        self._num_packets += 1
        if packet.dts is not None:
            self._decoded_until = packet.dts
        if not packet.is_discard:
            timeline.add(self._pts(packet), packet.dts)

    def _decode(self, packets: Iterator[av.Packet], timeline: _Timeline) -> Iterator[av.VideoFrame]:
        for packet in chain(packets, [None]):  # None: what the decoder still holds
            if packet is not None:
                self._record_packet(packet, timeline)
            try:
                frames = self._stream.codec_context.decode(packet)
            except FFmpegError:
                self.lost += 1
                continue
            yield from frames

    def _seek(self, from_ns: int) -> tuple[_Timeline, Iterator[av.Packet]]:
        """Goes to the last key frame at `from_ns` or before; returns what is known there, and the packets from there.

        All packets before it are read and not decoded: they alone tell how many frames there are. Where a packet has no
        time, the clock is set back, or the way does not lead to that key frame, it begins at the beginning.
        """
        scan, limit = _Timeline(self._unit_s), Fraction(from_ns, 10**9) / self._unit_s
        key, num_before = None, 0
        for packet in self._packets():
            decoded_until, pts = self._decoded_until, self._pts(packet)
            self._record_packet(packet, scan)
            if pts is None or (decoded_until - self._decoded_until) * self._unit_s * 10**9 > _MAX_DISORDER_NS:
                key = None
                break
            begins = min([pts, *scan.waiting[:1]])
            if packet.is_keyframe and pts <= begins + limit:
                key, num_before = pts, self._num_packets - 1
            if packet.dts is not None and packet.dts > begins + limit:
                break
        if key is not None and scan.waiting and key > scan.waiting[0]:
            packets = self._packets_from(key)
            if packets is not None:
                self._num_packets = num_before
                return _Timeline(self._unit_s, scan.waiting[0], bisect_left(scan.waiting, key)), packets
        self.close()
        self._open()
        return _Timeline(self._unit_s), self._packets()

    def _packets_from(self, key: int) -> Iterator[av.Packet] | None:
        """The packets from the key frame with this pts on, without those shown before it; None: it is not reached."""
        try:
            self._container.seek(key, stream=self._stream)
        except FFmpegError:
            return None
        packets = self._packets()
        for packet in packets:
            if packet.pts == key:
                return (each for each in chain([packet], packets) if each.pts is None or each.pts >= key)
            if packet.pts is None or (packet.dts is not None and packet.dts > key):
                return None
        return None

    def _duration_ns(self, frame: av.VideoFrame) -> int:
        return round(frame.duration * self._unit_s * 10**9) if frame.duration else self._frame_ns

    def _convert(self, frame: av.VideoFrame, index: int, time_ns: int, max_pixels: int) -> DecodedFrame:
        aspect = self._pixel_aspect()
        width = max(1, round(frame.width * aspect))
        for each in (frame.width, width):
            _check_size(each, frame.height, max_pixels)
        size = {"width": width, "height": frame.height}
        rgb = self._reformatter.reformat(frame, **size, format="rgb24", interpolation="BICUBIC", threads=1).to_ndarray()
        image = np.ascontiguousarray(_turn_upright(rgb.astype(np.uint8, copy=False), self._display_matrix(frame)))
        return DecodedFrame(index, time_ns, image, float(aspect) if width != frame.width else 1.0)

    def _display_matrix(self, frame: av.VideoFrame) -> npt.NDArray[np.int32] | None:
        """(2, 2), by which a stored picture's right and down are turned to a player's; None: as they are stored.

        It is looked up anew where the turn or the size is another: a frame that was asked for what lies beside it stays
        in memory until Python looks for circles.
        """
        shape = frame.rotation, frame.width, frame.height
        if shape != self._turned_shape:
            beside: Any = frame.side_data  # which PyAV types as one of motion vectors alone
            data = bytes(beside.get(Type.DISPLAYMATRIX, b""))
            self._matrix = np.frombuffer(data, np.int32).reshape(3, 3)[:2, :2] if len(data) == _MATRIX_BYTES else None
            self._turned_shape = shape
        return self._matrix

    def _pixel_aspect(self) -> Fraction:
        """Width of a pixel over its height; 1 where the video tells none, or one that is not believed."""
        aspect = self._stream.sample_aspect_ratio or self._stream.codec_context.sample_aspect_ratio
        low, high = _SQUARE_RANGE
        return aspect if aspect and low <= aspect <= high else Fraction(1)

    def _ends_early(self, timeline: _Timeline) -> bool:
        """Whether fewer packets were there than it states; where it states its duration alone, much less of that."""
        if self._stream.frames:  # those of an AVI, which has no other times, may be empty
            num_there = self._decoded_until + 1 if self._is_avi else self._num_packets
            return num_there < _MIN_FRAME_RATIO * self._stream.frames
        if "matroska" not in self._container.format.name or len(self._container.streams) > 1:
            return False  # others do not state it but guess it, and sound may go on for longer
        stated_ns = 1000 * (self._container.duration or 0)
        missing_ns = stated_ns - 1000 * max(0, self._container.start_time or 0) - timeline.end_ns
        return missing_ns > max((1 - _MIN_FRAME_RATIO) * stated_ns, _MAX_MISSING_GAPS * timeline.longest_ns)


def _is_cover(stream: av.VideoStream) -> bool:
    """True for the one picture on the cover of a piece of music."""
    return bool(stream.disposition & Disposition.attached_pic)


def _check_size(width: int, height: int, max_pixels: int) -> None:
    if width * height > max_pixels:
        raise TooLarge(width, height)


def _turn_upright(image: npt.NDArray[np.uint8], matrix: npt.NDArray[np.int32] | None) -> npt.NDArray[np.uint8]:
    """The image (H, W, 3) turned by the nearest quarter turn, and mirrored where the matrix does so."""
    if matrix is None or not matrix.any():
        return image
    (right_x, right_y), (down_x, down_y) = matrix.astype(np.int64)
    if abs(right_x) + abs(down_y) < abs(right_y) + abs(down_x):  # it lies on its side
        image, right_x, down_y = image.transpose(1, 0, 2), down_x, right_y
    image = image[:, ::-1] if right_x < 0 else image
    return image[::-1] if down_y < 0 else image
