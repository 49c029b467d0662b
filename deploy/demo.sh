#!/usr/bin/env bash
# Sets up the project and runs its demo: teach, learn, run. Options are those of `smal demo`.
#   bash deploy/demo.sh              some minutes on two cores without a GPU; ends with a page of results
#   bash deploy/demo.sh --browser    a page in the browser, where you drive
set -euo pipefail
cd "$(dirname "$0")/.."
bash deploy/setup.sh
exec .venv/bin/smal demo "$@"
