#!/usr/bin/env bash
# Sets up the project and runs every check: style, types, complexity, import rules, tests.
# Options are pytest's; with `-m ""` it also runs the long tests, in half an hour.
set -euo pipefail
cd "$(dirname "$0")/.."
bash deploy/setup.sh --tests
export PATH="$PWD/.venv/bin:$PATH"
ruff check .
ruff format --check .
mypy
complexipy
lint-imports
# Three processes on two cores: many tests wait for a robot, a browser or a deadline; four cost more time.
status=0
# A test that hangs outside of Python takes no signal: its process ends, and another one goes on.
python -m pytest -rsf -n 3 --timeout-method=thread -m "not long" "$@" || status=$?
if [ "$status" = 1 ]; then
  echo "running the failed tests again, one at a time: the machine may have been too busy; the errors are above"
  python -m pytest -rsf --last-failed --last-failed-no-failures none "$@"
else
  exit "$status"
fi
