"""``smal`` as processes that are copies of one which has loaded all commands already.

To a user they are what `smal` is, arguments, environment, output and exit status; only that Python's start and the
loading of modules, a second of processor time each, happen once for all.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Final, Self

_PROGRAM: Final = """
import json, os, sys
from services.cli import main
for name in main.COMMANDS:
    main._load(name)
for line in sys.stdin:
    order = json.loads(line)
    child = os.fork()
    if child == 0:
        for number, name in enumerate((os.devnull, order["out"], order["err"])):
            os.dup2(os.open(name, os.O_RDWR), number)
        os.environ.clear()
        os.environ.update(order["environment"])
        sys.argv = ["smal", *order["arguments"]]
        main.main()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Forked:
    """Runs ``smal``, one at a time.

    Parameters
    ----------
    folder
        For what commands print.
    """

    def __init__(self, folder: Path) -> None:
        self._out, self._err = folder / "out", folder / "err"
        self._server = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run one command."""
        for file in (self._out, self._err):
            file.write_text("")
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        texts = [str(one) for one in arguments]
        order = {"arguments": texts, "environment": dict(os.environ | environment)}
        self._server.stdin.write(json.dumps(order | {"out": str(self._out), "err": str(self._err)}) + "\n")
        self._server.stdin.flush()
        status = int(self._server.stdout.readline())
        return subprocess.CompletedProcess(texts, status, self._out.read_text(), self._err.read_text())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._server.communicate()
