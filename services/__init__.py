"""The processes around the method: each is configuration and wiring around a pure object.

``kit.bus`` carries messages, ``kit.node`` gives every service its signals, logging, health and loop, and ``cli`` is the
``smal`` command.
"""

import os
import sys
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, mmap

# Less is not enough for any of our programs, and numpy's OpenBLAS then tries for ever to get it.
_LEAST_MB = 150
try:
    mmap(-1, _LEAST_MB << 20, flags=MAP_PRIVATE | MAP_ANONYMOUS).close()
except OSError:
    sys.exit(
        f"out of memory: less than {_LEAST_MB} MB can be used; allow more (ulimit -d and -v, or the container's)"
    )
# OpenCV reads this once, when it is loaded: 100 million pixels are 300 MB; a few bytes of a file can claim any number.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(10**8))
# So does OpenBLAS, with numpy. Products are small, or threads of our own share them out: others beside these wait in
# loops for a core. 10,000 by 10,000 frames take `smal match` half as long again with them.
if "OMP_NUM_THREADS" not in os.environ:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
