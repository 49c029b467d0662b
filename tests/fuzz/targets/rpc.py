"""Requests as ``Node.serve`` takes them, and replies as ``Bus.call`` does; the first byte chooses the class."""

from __future__ import annotations

import inspect
import json
import random
from typing import Any

from pydantic import ValidationError

from schemas import rpc
from schemas.base import Strict
from schemas.codec import describe
from schemas.rpc import Failure
from tests.fuzz.targets import check_line
from tests.fuzz.trees import changed_json

CLASSES = [
    cls
    for _, cls in sorted(inspect.getmembers(rpc, inspect.isclass))
    if issubclass(cls, Strict) and cls.__module__ == rpc.__name__
]


def seeds() -> list[bytes]:
    documents = [json.dumps(example(cls.model_json_schema())).encode() for cls in CLASSES]
    return [bytes([number]) + document for number, document in enumerate(documents)]


def example(schema: dict[str, Any]) -> Any:
    """Make the plainest value that a JSON Schema allows, with every field present and every list filled."""
    match schema:
        case {"enum": [first, *_]}:
            return first
        case {"anyOf": [first, *_]}:
            return example(first)
        case {"properties": fields}:
            return {name: example(field) for name, field in fields.items()}
        case {"additionalProperties": dict(values)}:
            return {"a": example(values)}
        case {"prefixItems": items}:
            return [example(item) for item in items]
        case {"items": item}:
            return [example(item)]
    plain = {"string": "drive-1", "integer": max(1, schema.get("minimum", 1)), "number": 0.5, "boolean": True}
    return plain.get(schema.get("type", "object"), {})


def run(data: bytes) -> bool:
    cls = CLASSES[data[0] % len(CLASSES)] if data else CLASSES[0]
    try:
        message: Strict = cls.model_validate_json(data[1:])
        accepted = True
    except ValidationError as error:
        check_line(describe(error))
        message, accepted = Failure(error=describe(error)), False
    # What was understood, and the reason why not, can be sent.
    assert type(message).model_validate_json(message.model_dump_json().encode()) == message
    return accepted


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    document = changed_json(data[1:], rng)
    return None if document is None else data[:1] + document
