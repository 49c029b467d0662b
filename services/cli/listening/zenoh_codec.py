"""Codec ``smal`` of the ``zenoh`` command line tool (PyPI: zenoh-cli): payloads as JSON, by the schema of their topic.

::

    zenoh --mode client --connect tcp/127.0.0.1:7447 subscribe -k 'smal/**' --decoder smal --line '{key} {value}'
    zenoh --mode client --connect tcp/127.0.0.1:7447 get -s smal/rescuebot/rpc/robot/status --decoder smal
    zenoh --mode client --connect tcp/127.0.0.1:7447 put -k smal/rescuebot/command/teleop --encoder smal -v \
        '{"robot": "rescuebot", "episode": "drive-1-x-1", "tick": 3, "stamp_ns": 0, "source": "teleop", "atom": "stop"}'

zenoh-cli gives a codec the key and the payload, never the encoding, and this sets two limits that no codec can lift:

- What is put carries valid bytes of the message but Zenoh's default encoding, ``zenoh/bytes``. **SMAL's services and
  recorder refuse it**, count it as bad and go on, and ``smal topic echo`` calls it not decodable: a message whose name
  and version nobody stated moves no robot. Tools that look at the bytes alone, this decoder among them, read it. To
  command a robot use ``smal teleop``, or publish with ``encoding=`` from a Zenoh session of your own.
- What is received is taken for the message that belongs on its key, whatever its encoding says; ``smal topic echo``
  checks that as well.
"""

from __future__ import annotations

import json

from pydantic import ValidationError

from schemas.codec import describe, encode, encoding_of, printable
from schemas.topics import ROOT, key_of, topic_of
from services.cli.listening.samples import Sample


def decode_to_json(key: str, value: bytes) -> str:
    """Return a payload as one line of JSON.

    Parameters
    ----------
    key
        The key that it came on; zenoh-cli passes an object that is no string but prints as one.
    value
        The payload: a message on a topic, or the JSON of a call under ``rpc/``.

    Returns
    -------
    str
        The message's fields, of binary data only the length. For what is no message of that key an object with
        ``error`` and ``bytes``; no exception, which zenoh-cli would log with a traceback.
    """
    key = str(key)
    if _is_call(key):
        try:
            return json.dumps(json.loads(value))
        except (ValueError, RecursionError) as error:
            return json.dumps({"error": f"not JSON: {printable(str(error))}", "bytes": len(value)})
    topic = topic_of(key)
    record = Sample(key, value, "" if topic is None else encoding_of(topic.message)).record()
    del record["key"]
    return json.dumps(record.get("message", record))


def encode_from_json(key: str, value: str) -> bytes:
    """Return the payload for a message given as JSON.

    Parameters
    ----------
    key
        The key that it is for.
    value
        All fields of the message that have no default; binary data as base64. Under ``rpc/`` any JSON.

    Raises
    ------
    ValueError
        When the key is no topic, or this is no message for it; the text says why in one line.
    """
    key = str(key)
    if _is_call(key):
        return json.dumps(json.loads(value)).encode()
    topic = topic_of(key)
    if topic is None:
        raise ValueError(f"{printable(key)} is no topic of SMAL; see: smal topic list")
    try:
        message = topic.message.model_validate_json(value)
    except ValidationError as error:
        raise ValueError(f"{topic.message.schema_name()}: {describe(error)}") from None
    if key_of(message) != key:
        raise ValueError(f"a message of {message.robot}/{message.topic_name} does not belong on {key}")
    payload = encode(message)
    if len(payload) > message.max_bytes:
        raise ValueError(f"{message.schema_name()}: {len(payload)} bytes, at most {message.max_bytes} allowed")
    return payload


def _is_call(key: str) -> bool:
    root, _, rest = key.partition("/")
    return root == ROOT and rest.partition("/")[2].startswith("rpc/")
