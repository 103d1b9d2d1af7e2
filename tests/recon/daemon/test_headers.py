"""Every header that crosses a process's boundary has a bound on every number, text and sequence in it."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Iterator

import msgspec
import pytest
from msgspec import inspect

from splatnode.capture import config, status
from splatnode.capture.depth_image import DepthNoise
from splatnode.capture.frame import Baseline, ExposureSettings, GivenPose, Gravity, Intrinsics, Motion
from splatnode.capture.messaging import messages, pubsub
from splatnode.capture.messaging.messages import Header
from splatnode.capture.messaging.pubsub import Want
from splatnode.recon.daemon import ReconStatus, node
from splatnode.recon.occupancy import MapHeader
from splatnode.recon.result.message import DepthHeader, SceneHeader

SCHEMAS = [
    messages.FrameHeader, messages.DroppedHeader, messages.Delivery,
    messages.ConsumerStatus, messages.Ready, messages.Acknowledge, messages.Refuse,
    config.PreviewHeader, status.CaptureStatus, status.Heartbeat, pubsub.MarkProblemsSeen, pubsub.Answer,
    node.RemoveKeyframe,
    Want, ReconStatus, SceneHeader, MapHeader, DepthHeader,
]  # fmt: skip
# Their __post_init__ knows all their bounds.
CHECKED_BY_THEMSELVES = (Intrinsics, GivenPose, Motion, Gravity, ExposureSettings, Baseline, DepthNoise)


def unbounded(kind: inspect.Type, where: str) -> Iterator[str]:
    """The places in a type that hold anything without a bound."""
    if isinstance(kind, inspect.Metadata):
        yield from unbounded(kind.type, where)
    elif isinstance(kind, inspect.StrType):
        if kind.max_length is None:
            yield f"{where}: text of any length"
    elif isinstance(kind, (inspect.IntType, inspect.FloatType)):
        if kind.ge is None or kind.le is None:
            yield f"{where}: any number"
    elif isinstance(kind, (inspect.StructType, inspect.DataclassType)):
        if kind.cls not in CHECKED_BY_THEMSELVES:
            for field in kind.fields:
                yield from unbounded(field.type, f"{where}.{field.name}")
    elif isinstance(kind, inspect.UnionType):
        for each in kind.types:
            yield from unbounded(each, where)
    elif isinstance(kind, inspect.TupleType):
        for index, each in enumerate(kind.item_types):
            yield from unbounded(each, f"{where}[{index}]")
    elif isinstance(kind, (inspect.ListType, inspect.VarTupleType)):
        if kind.max_length is None:
            yield f"{where}: a sequence of any length"
        yield from unbounded(kind.item_type, f"{where}[]")
    elif isinstance(kind, inspect.DictType):
        if kind.max_length is None:
            yield f"{where}: a table of any length"
        yield from unbounded(kind.key_type, f"{where}, its keys")
        yield from unbounded(kind.value_type, f"{where}, its values")
    elif not isinstance(kind, (inspect.BoolType, inspect.NoneType, inspect.EnumType, inspect.AnyType)):
        yield f"{where}: {type(kind).__name__}"


@pytest.mark.parametrize("schema", SCHEMAS, ids=lambda schema: getattr(schema, "__name__", "Heartbeat"))
def test_a_header_has_no_end_nowhere(schema):
    assert list(unbounded(inspect.type_info(schema), getattr(schema, "__name__", "Heartbeat"))) == []


def test_all_headers_are_looked_at():
    for package in ("splatnode.capture", "splatnode.recon.daemon", "splatnode.recon.result"):
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            if not module.name.endswith(("depthai", ".rerun")):  # their libraries are extras
                importlib.import_module(module.name)
    headers = {each for each in Header.__subclasses__() if each.__module__.startswith("splatnode.")}
    assert headers <= set(SCHEMAS)


class Loose(msgspec.Struct):
    text: str
    number: float
    tables: dict[str, list[int]]


@dataclasses.dataclass
class Looser:
    inner: tuple[Loose, ...]
    data: bytes


def test_what_has_no_bound_is_found():
    found = list(unbounded(inspect.type_info(Looser), "it"))
    assert [where.removeprefix("it") for where in found] == [
        ".inner: a sequence of any length",
        ".inner[].text: text of any length",
        ".inner[].number: any number",
        ".inner[].tables: a table of any length",
        ".inner[].tables, its keys: text of any length",
        ".inner[].tables, its values: a sequence of any length",
        ".inner[].tables, its values[]: any number",
        ".data: BytesType",
    ]
