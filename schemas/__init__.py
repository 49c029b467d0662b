"""Messages on the wire. Read ``base`` and any message first, then ``codec`` and ``topics``."""
