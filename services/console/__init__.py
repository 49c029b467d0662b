"""Web console: watch the robot, drive it, teach it, and start runs.

``service`` connects an operator to the bus and ``web`` to browsers. ``who_drives`` assigns the
driver, ``newest_content`` holds the latest content for watchers. ``library``, ``learned`` and
``jobs`` handle recordings and models.
"""
