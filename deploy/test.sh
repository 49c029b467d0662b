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
# In two processes, for the two cores that it must do with; whoever is done takes from what is left to the other.
python -m pytest -rs -n 2 --dist worksteal "$@"
