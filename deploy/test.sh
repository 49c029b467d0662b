#!/usr/bin/env bash
# Sets everything up and runs every check of the project: style, types, import rules, tests.
set -euo pipefail
cd "$(dirname "$0")/.."
bash deploy/setup.sh --tests
export PATH="$PWD/.venv/bin:$PATH"
ruff check .
ruff format --check .
mypy
lint-imports
# In three processes on two cores, since many tests wait; whoever is done takes from what is left to the others.
python -m pytest -rs -n 3 --dist worksteal "$@"
