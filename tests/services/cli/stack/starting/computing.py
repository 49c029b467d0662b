"""A recorder that computes for a few seconds before it can be reached."""

import runpy
import sys
import time

sys.stderr.write("computing for a while\n")
while time.process_time() < 4.5:
    pass
runpy.run_module("services.recorder", run_name="__main__")
