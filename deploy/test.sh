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
# In three processes on two cores: one in three waits for a robot, a browser or a deadline. `tests/sharing.py` shares out.
python -m pytest -rs -n 3 "$@"
