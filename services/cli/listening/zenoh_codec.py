"""Codec ``smal`` of the ``zenoh`` command line tool (PyPI: zenoh-cli): payloads as JSON, by the schema of their topic.

::

    zenoh --mode client --connect tcp/127.0.0.1:7447 subscribe -k 'smal/**' --decoder smal --line '{key} {value}'
    zenoh --mode client --connect tcp/127.0.0.1:7447 get -s smal/rescuebot/rpc/robot/status --decoder smal

zenoh-cli gives a codec the key and the payload, never the encoding: what is received is taken for the message that
belongs on its key, whatever its encoding says; ``smal topic echo`` checks that as well. For the same reason there is no
encoder: what zenoh-cli puts has Zenoh's default encoding, which every service refuses.
"""

from __future__ import annotations

import json
import re

from schemas.codec import encoding_of, printable
from schemas.topics import ROOT, topic_of
from services.cli.listening.samples import Sample


def decode_to_json(key: str, value: bytes) -> str:
    """Return a payload as one line of JSON: the message's fields, of binary data only the length.

    Parameters
    ----------
    key
        The key that it came on; zenoh-cli passes an object that is no string but prints as one.
    value
        The payload: a message on a topic, or the JSON of a call under ``rpc/``. For what is no message of that key the
        line is an object with ``error`` and ``bytes``: zenoh-cli would log an exception with a traceback.
    """
    key = str(key)
    if re.match(f"{ROOT}/[^/]*/rpc/", key):
        try:
            return json.dumps(json.loads(value))
        except (ValueError, RecursionError) as error:
            return json.dumps({"error": f"not JSON: {printable(str(error))}", "bytes": len(value)})
    topic = topic_of(key)
    record = Sample(key, value, "" if topic is None else encoding_of(topic.message)).record()
    del record["key"]
    return json.dumps(record.get("message", record))
