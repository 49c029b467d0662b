#!/usr/bin/env bash
# Sets everything up and runs every check of the project: style, types, import rules, tests.
set -euo pipefail
cd "$(dirname "$0")/.."
bash deploy/setup.sh --tests
export PATH="$PWD/.venv/bin:$PATH"
ruff check .
ruff format --check .
mypy
complexipy
lint-imports
# In three processes on two cores: one in three waits for a robot, a browser or a deadline. `tests/sharing.py` shares out.
status=0
python -m pytest -rsf -n 3 "$@" || status=$?
if [ "$status" = 1 ]; then
  echo "once more, alone: what failed beside others, on a machine that may have been too busy; above is why"
  python -m pytest -rsf --last-failed --last-failed-no-failures none "$@"
else
  exit "$status"
fi
