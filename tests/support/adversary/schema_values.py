"""Values of a msgspec schema, drawn from its own description: obedient ones, at its bounds, and hostile ones."""

from __future__ import annotations

import functools
import random
from typing import Any

import msgspec.inspect as inspect

from tests.support.adversary import edges

_LETTERS = "0123456789abcdef"
_USUAL_SHARE = 0.97  # of fields that must go together, and have these values then
_IDENTITY = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
_USUAL: dict[str, tuple[Any, ...]] = {
    "T_world_camera": (_IDENTITY,),
    "T_world_map": (_IDENTITY,),
    "T_frame_first_camera": (_IDENTITY,),
    "T_base_camera": (_IDENTITY,),
    "T_previous_current": (_IDENTITY,),
    "T_start_current": (_IDENTITY,),
    "T_camera_depth": (_IDENTITY,),
    **dict.fromkeys(("a_m", "b_per_m", "scale_sigma"), (0.01,)),
    "chain": ("a.png",),
    "K": ([20.0, 0.0, 8.0, 0.0, 20.0, 6.0, 0.0, 0.0, 1.0],),
    **dict.fromkeys(("sigma_m", "sigma_deg", "time_s"), (0.01,)),
    "iso": (100.0,),
    "f_number": (2.0, None),
    **dict.fromkeys(("fx", "fy"), (20.0,)),
    **dict.fromkeys(("cx", "cy"), (8.0, 6.0)),
    "width": (16,),
    "height": (12,),
    "distortion": ([], [0.1], [0.1, 0.0, 0.0, 0.0]),
    "model": ("opencv", "opencv", "fisheye"),
    "skew": (0.0,),
    "source": ("given", "calibration", "exif"),
    "metres": (0.1,),
    "down": ([0.0, 1.0, 0.0],),
}
_ODD = 0.08  # chance of a value that is not obedient, at each node


@functools.lru_cache(maxsize=64)
def described(schema: Any) -> inspect.Type:
    return inspect.type_info(schema)


def value(rng: random.Random, schema: Any, odd: float = _ODD) -> Any:
    """Plain data (dicts, lists, numbers, text) that is a `schema`, but for some nodes."""
    return _value(rng, described(schema), odd)


def _value(rng: random.Random, kind: inspect.Type, odd: float) -> Any:
    if rng.random() < odd:
        return _beside(rng, kind)
    match kind:
        case inspect.StructType():
            return _struct(rng, kind, odd)
        case inspect.UnionType():
            return _value(rng, rng.choice(kind.types), odd)
        case inspect.IntType():
            return _integer(rng, kind)
        case inspect.FloatType():
            low = -1e3 if kind.ge is None else kind.ge
            high = 1e3 if kind.le is None else kind.le
            return rng.choice((low, high, rng.uniform(low, high), 1.0 if low <= 1.0 <= high else low))
        case inspect.StrType():
            return _text(rng, kind)
        case inspect.ListType() | inspect.VarTupleType() | inspect.SetType() | inspect.FrozenSetType():
            return [_value(rng, kind.item_type, odd) for _ in range(_length(rng, kind.min_length, kind.max_length))]
        case inspect.TupleType():
            return [_value(rng, each, odd) for each in kind.item_types]
        case inspect.DictType():
            count = _length(rng, kind.min_length, kind.max_length)
            return {_key(rng, kind.key_type): _value(rng, kind.value_type, odd) for _ in range(count)}
        case inspect.DataclassType():
            return {field.name: _field(rng, field.name, field.type, odd) for field in kind.fields}
        case inspect.EnumType():
            return rng.choice([member.value for member in kind.cls])
        case inspect.LiteralType():
            return rng.choice(kind.values)
        case inspect.BoolType():
            return rng.random() < 0.5
        case inspect.NoneType():
            return None
        case inspect.BytesType():
            return rng.randbytes(rng.choice((0, 1, 32)))
    return edges.hostile(rng)


def _key(rng: random.Random, kind: inspect.Type) -> Any:
    return edges.text(rng) if isinstance(kind, inspect.AnyType) else _value(rng, kind, 0.0)


def _field(rng: random.Random, name: str, kind: inspect.Type, odd: float) -> Any:
    """A value that goes with those of the other fields where there is one, so that what is sound comes far."""
    known = _USUAL.get(name)
    if known is None or rng.random() < odd or rng.random() >= _USUAL_SHARE:
        return _value(rng, kind, odd)
    return rng.choice(known)


def _struct(rng: random.Random, kind: inspect.StructType, odd: float) -> Any:
    fields = {field.encode_name: _field(rng, field.encode_name, field.type, odd) for field in kind.fields}
    if rng.random() < odd / 4:
        fields[edges.text(rng)] = edges.hostile(rng)
    if fields and rng.random() < odd / 4:
        del fields[rng.choice(list(fields))]
    if kind.array_like:
        return list(fields.values())
    return fields if kind.tag_field is None else {kind.tag_field: kind.tag, **fields}


def _integer(rng: random.Random, kind: inspect.IntType) -> int:
    low = 0 if kind.ge is None else kind.ge
    high = 2**62 if kind.le is None else kind.le
    return rng.choice((low, high, min(high, low + 1), rng.randint(low, min(high, low + 1000))))


def _text(rng: random.Random, kind: inspect.StrType) -> str:
    if kind.pattern is not None and "0-9a-f" in kind.pattern:
        return "".join(rng.choice(_LETTERS) for _ in range(32))
    shortest, longest = kind.min_length or 0, kind.max_length if kind.max_length is not None else 300
    return "name_" * 1000 if rng.random() < 0.003 else "a" * rng.choice((max(1, shortest), min(12, longest), longest))


def _length(rng: random.Random, least: int | None, most: int | None) -> int:
    low = least or 0
    high = low + 3 if most is None else most
    return rng.choice((low, min(high, low + 1), min(high, low + 3), high if high <= 64 else low))


def _beside(rng: random.Random, kind: inspect.Type) -> Any:
    """Just outside of the bounds, at an edge of the type, or of another type."""
    if isinstance(kind, inspect.IntType):
        bounds = [bound + step for bound, step in ((kind.ge, -1), (kind.le, 1)) if bound is not None]
        return rng.choice((*bounds, edges.integer(rng)))
    if isinstance(kind, inspect.FloatType):
        return edges.number(rng)
    if isinstance(kind, inspect.StrType):
        return edges.text(rng)
    if isinstance(kind, inspect.TupleType) and rng.random() < 0.7:
        return [edges.number(rng) for _ in kind.item_types]
    if isinstance(kind, inspect.VarTupleType) and kind.min_length and rng.random() < 0.7:
        return [edges.number(rng) for _ in range(kind.min_length)]
    return edges.hostile(rng)
