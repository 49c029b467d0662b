#!/usr/bin/env bash
# Runs the whole job on this machine: set up, demonstrate, learn, run. Ends with a page of results.
#   bash deploy/demo.sh          camera image of 320x240 and 5 runs: some minutes on two cores without a GPU
#   bash deploy/demo.sh --full   camera image of 1024x768 and 20 runs
set -euo pipefail
cd "$(dirname "$0")/.."

case "${1:-}" in
  "") runs=5 camera=320x240 ;;
  --full) runs=20 camera=1024x768 ;;
  *) sed -n '2,4s/^# *//p' "$0" >&2; exit 2 ;;
esac
drives=1
seed=${SMAL_DEMO_SEED:-1}
world=${SMAL_DEMO_WORLD:-campus}
out=${SMAL_DEMO_OUT:-out/demo-$(date +%Y%m%d-%H%M%S)}

bash deploy/setup.sh
smal=.venv/bin/smal
echo
echo "This demo teaches with $drives drive(s) at $camera. The robot then searches $runs times."
[ "${1:-}" = --full ] || echo "The camera image is smaller than the robot's 1024x768 to save time; --full uses the full size."
echo
echo "1/3 The expert demonstrates; the recorder writes $out/drives"
"$smal" demonstrate --world "$world" --episodes "$drives" --seed "$seed" --camera "$camera" --out "$out/drives"
echo
echo "2/3 Learning a map of views from the recordings"
"$smal" learn "$out/drives" --out "$out/model.smal"
echo
echo "3/3 The robot searches by itself, from other starts than the taught start"
"$smal" run --model "$out/model.smal" --world "$world" --episodes "$runs" --seed "$seed" --camera "$camera" --json "$out/runs.json" --report "$out/report"
echo
echo "Open this page: $(realpath "$out")/report/index.html"
