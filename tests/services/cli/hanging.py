"""A service that never comes to anything."""

import sys
import threading

sys.stderr.write("waiting for ever\n")
threading.Event().wait()
