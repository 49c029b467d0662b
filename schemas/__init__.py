"""What crosses the wire, messages by what they are about: read ``base``, any message, then ``codec`` and ``topics``."""
