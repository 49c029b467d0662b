"""The page in a browser: watch the robot, drive it, teach it, send it to a goal.

``newest_content`` holds the newest of everything for those who watch, ``who_drives`` says who drives, ``service`` joins
both to the bus, and ``web`` to browsers. ``library``, ``learned`` and ``jobs`` are about what was recorded and learned.
"""
