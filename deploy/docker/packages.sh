#!/bin/sh
# Installs a pinned list of packages into /opt/smal, without what only a developer needs.
set -eu
pip --python /opt/smal/bin/python install -q --disable-pip-version-check --no-deps --require-hashes --no-compile -r "$1"
cd /opt/smal/lib
# The packages' own tests and symbols are a fifth of all.
find . -type d -name tests -prune -exec rm -rf {} +
find . \( -name '*.pyi' -o -name '*.pyx' -o -name '*.pxd' -o -name '*.a' \) -delete
find . -name '*.so*' -type f -exec strip --strip-unneeded {} +
# A read-only root cannot take bytecode later.
/opt/smal/bin/python -m compileall -q .
