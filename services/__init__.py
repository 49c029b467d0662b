"""The processes around the method: each is configuration and wiring around a pure object.

``kit.bus`` carries messages, ``kit.node`` gives every service its signals, logging, health and loop, and ``cli`` is the
``smal`` command.
"""

import os

# OpenCV reads this once, when it is loaded: 100 million pixels are 300 MB; a few bytes of a file can claim any number.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(10**8))
