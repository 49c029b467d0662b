"""What crosses the wire: one message a file, the codec, and the one table of topics.

Read ``base`` first, then any message, then ``codec`` and ``topics``.
"""
