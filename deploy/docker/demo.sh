#!/usr/bin/env bash
# Runs the whole job on the stack of docker-compose.yml: demonstrate, learn, run. Ends with a page of results in /out.
set -euo pipefail
router=${SMAL_ROUTER:?} world=${SMAL_WORLD:?}
drives=${SMAL_DEMO_DRIVES:-1} runs=${SMAL_DEMO_RUNS:-5} seed=${SMAL_DEMO_SEED:-1}
# A new folder for each demo keeps earlier results.
name=demo-$(date +%Y%m%d-%H%M%S)
out=/out/$name

# Progress bars return to the start of their line, which a container's log shows as one endless line.
calm() {
  local line next=0
  while IFS= read -r line; do
    case $line in
      *'|'*' ['*)
        [ "$SECONDS" -ge "$next" ] || continue
        next=$((SECONDS + 15))
        ;;
    esac
    [ -z "$line" ] || printf '%s\n' "$line"
  done
}
exec > >(stdbuf -o0 tr '\r' '\n' | calm) 2>&1
log=$!

step() {
  # In the background, because bash handles SIGTERM only after a foreground command ends.
  smal "$@" &
  child=$!
  wait "$child"
}
child=
trap '[ -z "$child" ] || { kill -TERM "$child"; wait "$child" || true; }; exit 143' TERM INT

echo "This demo teaches with $drives drive(s) in $world. The robot then searches $runs times."
[ -z "$(ls -d /out/demo-* 2>/dev/null)" ] || echo "Earlier results in out/ stay; this demo writes to out/$name."
echo "1/3 The expert demonstrates; the recorder writes out/$name/drives"
step demonstrate --connect "$router" --world "$world" --episodes "$drives" --seed "$seed" --out "$out/drives"
echo "2/3 Learning a map of views from the recordings"
step learn "$out/drives" --out "$out/model.smal"
echo "3/3 The robot searches by itself, from other starts than the taught start"
step run --connect "$router" --model "$out/model.smal" --world "$world" --episodes "$runs" --seed "$seed" --json "$out/runs.json" --report "$out/report"
echo "Open this page: out/$name/report/index.html"
# Wait for the last lines of the log.
exec >&- 2>&-
wait "$log"
