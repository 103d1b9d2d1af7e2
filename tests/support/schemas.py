"""Messages as splatnodes of before a field knew them."""

from __future__ import annotations

from typing import Any

import msgspec

from splatnode.capture.messaging.messages import Header


def without(schema: type[Header], field: str) -> Any:
    """The schema that lacks this one field, and is the same otherwise; who reads the field finds its default."""
    fields = {each.name: each for each in msgspec.structs.fields(schema)}
    rows = [
        (name, each.type) if each.default is msgspec.NODEFAULT else (name, each.type, each.default)
        for name, each in fields.items()
        if name not in (field, *Header.__struct_fields__)
    ]
    return msgspec.defstruct(
        schema.__name__,
        rows,
        bases=(Header,),
        namespace={field: fields[field].default},
        tag=schema.__struct_config__.tag,
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )
