"""The page in a browser: watch the robot, drive it, teach it, send it to a goal.

``board`` holds the newest of everything for those who watch, ``seat`` says who drives, ``service`` joins both to the
bus, and ``web`` to browsers. ``library``, ``learned`` and ``jobs`` are about what was recorded and learned.
"""
