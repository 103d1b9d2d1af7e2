"""Foxglove's CompressedImage, RawImage and CameraCalibration, in JSON and in protobuf.

Source: Foxglove's schemas (foxglove-sdk), whose field numbers are those below.
"""

from __future__ import annotations

from typing import TypeVar

import msgspec

from splatnode.capture.logged.message import Calibration, Layout, Picture, UnusableMessage
from splatnode.capture.logged.protobuf import Fields
from splatnode.capture.process.records import record_in

_NS = 10**9
_Message = TypeVar("_Message", bound=msgspec.Struct)


class _Time(msgspec.Struct, frozen=True):
    sec: int = 0
    nsec: int = 0

    @property
    def ns(self) -> int:
        return max(0, self.sec * _NS + self.nsec)


class _Compressed(msgspec.Struct, frozen=True):
    data: bytes  # base64 in JSON
    timestamp: _Time = _Time()
    frame_id: str = ""


class _Raw(msgspec.Struct, frozen=True):
    width: int
    height: int
    encoding: str
    step: int
    data: bytes
    timestamp: _Time = _Time()
    frame_id: str = ""


class _Calibration(msgspec.Struct, frozen=True):
    width: int
    height: int
    K: tuple[float, ...]
    distortion_model: str = ""
    D: tuple[float, ...] = ()
    P: tuple[float, ...] = ()
    frame_id: str = ""


def parse_compressed_json(data: bytes) -> Picture:
    found = _parse_json(data, _Compressed)
    return Picture(found.frame_id, found.timestamp.ns, found.data, None)


def parse_raw_json(data: bytes) -> Picture:
    found = _parse_json(data, _Raw)
    layout = Layout(found.width, found.height, found.encoding, found.step)
    return Picture(found.frame_id, found.timestamp.ns, found.data, layout)


def parse_calibration_json(data: bytes) -> Calibration:
    found = _parse_json(data, _Calibration)
    return Calibration(found.frame_id, found.width, found.height, found.distortion_model, found.D, found.K, found.P)


def parse_compressed_protobuf(data: bytes) -> Picture:
    fields = Fields(data)
    return Picture(fields.text(4), _time_ns(fields.message(1)), fields.bytes(2), None)


def parse_raw_protobuf(data: bytes) -> Picture:
    fields = Fields(data)
    layout = Layout(fields.integer(2), fields.integer(3), fields.text(4), fields.integer(5))
    return Picture(fields.text(7), _time_ns(fields.message(1)), fields.bytes(6), layout)


def parse_calibration_protobuf(data: bytes) -> Calibration:
    fields = Fields(data)
    size = fields.integer(2), fields.integer(3)
    return Calibration(fields.text(9), *size, fields.text(4), fields.doubles(5), fields.doubles(6), fields.doubles(8))


def _time_ns(stamp: Fields) -> int:
    """google.protobuf.Timestamp."""
    return stamp.integer(1) * _NS + stamp.integer(2)


def _parse_json(data: bytes, kind: type[_Message]) -> _Message:
    try:
        return record_in(data, kind)
    except msgspec.DecodeError as error:
        raise UnusableMessage(f"the message must be JSON of Foxglove's schema: {error}") from error
