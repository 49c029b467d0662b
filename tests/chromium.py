"""Debian's Chromium, which deploy/setup.sh --tests installs."""

import shutil
from typing import Final

CHROMIUM: Final = shutil.which("chromium")
NO_CHROMIUM: Final = "no chromium on this machine (apt-get install chromium)"
#: Debian's Chromium needs it when run as root; it opens only pages of this repository.
FLAGS: Final = ("--no-sandbox",)
