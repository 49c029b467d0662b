"""The processes around the method: each is configuration and wiring around a pure object.

``bus`` is the only file that imports zenoh, ``process`` gives every service its signals, logging, health and loop,
and ``cli`` is the ``smal`` command.
"""
