"""What crosses the wire, one message a file: read ``base``, any message, then ``codec`` and ``topics``."""
