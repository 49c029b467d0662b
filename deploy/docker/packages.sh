#!/bin/sh
# Installs a pinned list of packages into /opt/smal, without files for developers.
set -eu
pip --python /opt/smal/bin/python install -q --disable-pip-version-check --no-deps --require-hashes --no-compile -r "$1"
cd /opt/smal/lib
# Tests and symbols of the packages are a fifth of the size.
find . -type d -name tests -prune -exec rm -rf {} +
find . \( -name '*.pyi' -o -name '*.pyx' -o -name '*.pxd' -o -name '*.a' \) -delete
find . -name '*.so*' -type f -exec strip --strip-unneeded {} +
# Compile now, because the root is read-only later.
/opt/smal/bin/python -m compileall -q .
