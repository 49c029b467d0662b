#!/usr/bin/env bash
# Builds the images from a clean clone and checks a running stack of docker-compose.yml.
#   bash deploy/test-docker.sh                 the last commit
#   bash deploy/test-docker.sh --working-tree  the working tree with uncommitted files
#   bash deploy/test-docker.sh --tests         also every test of the project in its container
# Needs permission to use a Docker engine, and Compose 2.20 or newer. Prints one line with a figure per check.
# Exits with status 1 if a check failed. Stops all containers; images and the build cache stay.
set -euo pipefail
cd "$(dirname "$0")/.."
checkout=$PWD
working_tree= with_tests=
for option in "$@"; do
  case $option in
    --working-tree) working_tree=1 ;;
    --tests) with_tests=1 ;;
    *) sed -n '2,5s/^# *//p' "$0" >&2; exit 2 ;;
  esac
done

fail() { printf 'test-docker: %s\n' "$*" >&2; exit 1; }
docker info >/dev/null 2>&1 || fail "Docker engine not found or permission denied; start it, or add this user to its group"
docker compose version >/dev/null 2>&1 || fail "docker compose not found; install Compose 2.20 or newer"

failures=0
check() { # check TEXT FIGURE COMMAND...: prints one line, ok or FAILED
  local text=$1 figure=$2
  shift 2
  if "$@"; then printf 'ok      %-52s %s\n' "$text" "$figure"; else
    printf 'FAILED  %-52s %s\n' "$text" "$figure"
    failures=$((failures + 1))
  fi
}
timed() { # timed COMMAND...: sets `took`; prints the output of a command that fails
  local began=$SECONDS
  if ! "$@" >"$work/log" 2>&1; then
    tail -n 40 "$work/log" >&2
    fail "failed: $*"
  fi
  took=$((SECONDS - began))
}

work=$(mktemp -d)
# A separate project and free ports keep a running stack of this machine untouched.
export COMPOSE_PROJECT_NAME=smal-test COMPOSE_PROFILES=demo SMAL_OUT=$work/out SMAL_UID SMAL_GID
SMAL_UID=$(id -u) SMAL_GID=$(id -g)
# The containers never run as root.
[ "$SMAL_UID" != 0 ] || SMAL_UID=4321 SMAL_GID=4321
export SMAL_ROUTER_PORT=0 SMAL_CONSOLE_PORT=0
# The smallest complete job.
export SMAL_WORLD=yard SMAL_CAMERA_WIDTH=160 SMAL_CAMERA_HEIGHT=120
export SMAL_DEMO_DRIVES=1 SMAL_DEMO_RUNS=2
SERVICES=(router robot tracker features recognition policy recorder console)
clean_up() {
  status=$?
  if [ -d "$work/clone" ]; then
    cd "$work/clone"
    [ "$status" = 0 ] || docker compose logs --tail 20 >&2 2>/dev/null || true
    docker compose down -v --remove-orphans >/dev/null 2>&1 || true
  fi
  cd /
  rm -rf "$work"
}
trap clean_up EXIT

# -- a clean clone

git clone -q "$checkout" "$work/clone"
if [ -n "$working_tree" ]; then
  git ls-files -z --deleted | (cd "$work/clone" && xargs -0r rm -f --)
  git ls-files -z --cached --others --exclude-standard --deduplicate |
    while IFS= read -r -d '' file; do if [ -e "$file" ]; then printf '%s\0' "$file"; fi; done |
    tar --null -T - -c | tar -C "$work/clone" -x
fi
cd "$work/clone"

# -- checks without a running stack

for profile in demo gpu zenohd zenohd-gpu; do
  # Each profile has one router and one simulator.
  check "profile $profile is valid" "$(docker compose --profile "$profile" config --services | wc -l) services" \
    test "$(docker compose --profile "$profile" config --services | grep -cE '^(router|zenohd|robot|robot-gpu)$')" = 2
done
# Compare without environment markers, which are wider in longer lists.
pins() { grep -o '^[a-z0-9._-]*==[^ ;]*' "$1" | sort; }
for list in services recognition robot simulator; do
  # The tests must run with every pin of the small lists.
  check "requirements/$list.txt agrees with dev.txt" "$(grep -c '==' "deploy/requirements/$list.txt") packages" \
    test -z "$(comm -23 <(pins "deploy/requirements/$list.txt") <(pins deploy/requirements/dev.txt))"
done

# -- build

timed docker compose build
check "docker compose build" "$took s" true
for service in prepare "${SERVICES[@]}" demo; do
  bytes=$(docker image inspect -f '{{.Size}}' "$COMPOSE_PROJECT_NAME-$service")
  case $service in
    robot | console | demo) check "image of $service" "$((bytes / 1000000)) MB" true ;;
    *) check "image of $service is under 500 MB" "$((bytes / 1000000)) MB" test "$bytes" -lt 500000000 ;;
  esac
done

# -- up

timed docker compose up -d --wait "${SERVICES[@]}"
check "docker compose up: all healthy" "$took s" true
container() { docker compose ps -aq "$1"; }
inspect() { docker inspect -f "$2" "$(container "$1")"; }
health() { inspect "$1" '{{.State.Health.Status}}'; }
becomes() { # becomes SERVICE HEALTH SECONDS: waits for the health; sets `took`
  local began=$SECONDS
  while [ "$(health "$1")" != "$2" ]; do
    took=$((SECONDS - began))
    [ "$took" -lt "$3" ] || return 1
    sleep 0.5
  done
  took=$((SECONDS - began))
}

want="user=$SMAL_UID:$SMAL_GID init=true read-only=true cap-drop=[ALL] cap-add=[] security=[no-new-privileges:true] privileged=false"
for service in "${SERVICES[@]}"; do
  got=$(inspect "$service" 'user={{.Config.User}} init={{.HostConfig.Init}} read-only={{.HostConfig.ReadonlyRootfs}} cap-drop={{.HostConfig.CapDrop}} cap-add={{or .HostConfig.CapAdd "[]"}} security={{.HostConfig.SecurityOpt}} privileged={{.HostConfig.Privileged}}')
  check "$service is hardened" "$([ "$got" = "$want" ] || echo "$got")" test "$got" = "$want"
  limits=$(inspect "$service" '{{.HostConfig.Memory}} {{.HostConfig.PidsLimit}} {{index .HostConfig.LogConfig.Config "max-size"}} {{index .HostConfig.LogConfig.Config "max-file"}}')
  read -r memory pids size files <<<"$limits"
  check "$service has limits" "$((memory / 1048576)) MiB, $pids processes, log $files x $size" \
    test "$memory" -gt 0 -a "$pids" -gt 0 -a "$size" = 10m -a "$files" = 3
  check "$service: its processes have no capability" "" \
    docker compose exec -T "$service" grep -q '^CapEff:\s*0*$' /proc/1/status
  check "$service: its root cannot be written to" "" \
    sh -c "! docker compose exec -T $service sh -c 'touch /app/x' 2>/dev/null"
done
check "policy cannot reach the internet" "" \
  sh -c "! docker compose exec -T policy python -c 'import socket; socket.create_connection((\"1.1.1.1\", 53), 2)' 2>/dev/null"
port=$(docker compose port router 7447)
check "only this machine reaches the router" "$port" \
  bash -c "[[ $port = 127.0.0.1:* ]] && exec 3<>/dev/tcp/127.0.0.1/${port##*:}"
page=$(docker compose port console 8080)
check "only this machine reaches the page" "$page" \
  bash -c "[[ $page = 127.0.0.1:* ]] && python3 -c \"import urllib.request as u; assert b'<title>' in u.urlopen('http://$page').read()\""

# -- the main job

timed docker compose up --no-log-prefix --exit-code-from demo demo
check "the demo ends with exit status 0" "$took s" true
folder=$(find "$SMAL_OUT" -maxdepth 1 -name 'demo-*')
for file in model.smal runs.json report/index.html; do
  check "the demo leaves out/demo-*/$file" "$(stat -c '%s bytes, user %u' "$folder/$file")" \
    test -s "$folder/$file" -a "$(stat -c %u "$folder/$file")" = "$SMAL_UID"
done
drives=$(find "$folder/drives" -name '*.mcap' -size +0 -user "$SMAL_UID" | wc -l)
check "the demo leaves recordings" "$drives drives" test "$drives" = "$SMAL_DEMO_DRIVES"
found=$(grep -c '"outcome": "found"' "$folder/runs.json" || true)
check "the robot found the victim" "$found of $SMAL_DEMO_RUNS runs" test "$found" -gt 0
for service in "${SERVICES[@]}"; do
  check "$service has not been restarted and is healthy" "$(health "$service")" \
    test "$(inspect "$service" '{{.RestartCount}}') $(health "$service")" = "0 healthy"
done

# -- several instances of a service

# Without --no-recreate, Compose restarts services whose --scale is not repeated.
scaled() { timed docker compose up -d --wait --no-recreate --scale features="$1" --scale recognition="$2" "${SERVICES[@]}"; }
scaled 2 3
check "2 instances of features and 3 of recognition are healthy" "$took s" \
  test "$(docker compose ps --format '{{.Health}}' features recognition | xargs)" = "healthy healthy healthy healthy healthy"
docker compose run --rm --no-deps -T demo smal run --connect tcp/router:7447 --model "/out/${folder##*/}/model.smal" \
  --world "$SMAL_WORLD" --episodes 2 --seed 1 --json /out/scaled.json >"$work/scaled.log" 2>&1 &
runs=$!
# The last instance that logs "serves" has the robot. It is killed while the robot drives, and stays down.
begun() { docker compose logs --no-log-prefix robot | grep -c 'frame 0: started' || true; }
before=$(begun) began=$SECONDS
while [ "$(begun)" = "$before" ] && [ $((SECONDS - began)) -lt 60 ]; do sleep 0.2; done
served() { for instance in $(container recognition); do docker logs -t "$instance" 2>&1 | sed -n "/ serves /s/ .*/ $instance/p"; done | sort | tail -n 1; }
killed=$(served | cut -d ' ' -f 2)
docker kill "$killed" >/dev/null
status=0
wait "$runs" || status=$?
found=$(grep -c '"outcome": "found"' "$SMAL_OUT/scaled.json" || true)
check "runs continue after a kill of recognition" "exit status $status, $found of 2 found" \
  test "$status $found" = "0 2" -a "$(served | cut -d ' ' -f 2)" != "$killed"
scaled 1 1

# -- failures

# The service is the only child of init; processes of `exec` have no parent in the container.
signal() { docker compose exec -T "$1" sh -c "kill -$2 \$(cat /proc/1/task/1/children)"; }
reached=true
signal features STOP
becomes features unhealthy 60 || reached=false
check "a frozen service becomes unhealthy" "after $took s" $reached
signal features CONT
becomes features healthy 30 || reached=false
check "and healthy again" "after $took s" $reached
before=$(inspect recognition '{{.State.StartedAt}}')
signal recognition KILL || true
began=$SECONDS
while [ "$(inspect recognition '{{.State.StartedAt}}')" = "$before" ] && [ $((SECONDS - began)) -lt 30 ]; do sleep 0.2; done
reached=true
becomes recognition healthy 90 || reached=false
check "a killed service is started again and healthy" "after $((SECONDS - began)) s, $(inspect recognition '{{.RestartCount}}') restart" \
  test $reached = true -a "$(inspect recognition '{{.RestartCount}}')" = 1
timed docker compose restart router
began=$SECONDS
for service in "${SERVICES[@]}"; do becomes "$service" healthy 90 || reached=false; done
check "all are healthy after a restart of the router" "after $((SECONDS - began)) s" $reached

# -- down

timed docker compose stop
for service in "${SERVICES[@]}"; do
  status=$(inspect "$service" '{{.State.ExitCode}}')
  check "$service stopped gracefully" "exit status $status" test "$status" = 0 -o "$status" = 143
done
# Each service has 15 s, and the router stops last.
check "all stopped" "$took s" test "$took" -lt 30
check "all recordings are complete" "" test -z "$(find "$SMAL_OUT" -name '*.partial')"

# -- with certificates

began=$SECONDS
timed docker compose run --rm --no-deps -T demo smal secure init /out/keys
export COMPOSE_FILE=docker-compose.yml:deploy/secure.yml SMAL_SECURE=$SMAL_OUT/keys
timed docker compose up -d --wait "${SERVICES[@]}"
check "with certificates: all healthy" "$took s" true
timed docker compose up --no-log-prefix --exit-code-from demo demo
check "and the demo ends with exit status 0" "$took s" true
listens() { docker compose run --rm --no-deps -T demo env "$@" smal topic hz --seconds 1; }
check "a client with a certificate can subscribe" "" sh -c "$(declare -f listens); listens >/dev/null 2>&1"
message=$(listens -u SMAL_TLS_CA -u SMAL_TLS_CERT -u SMAL_TLS_KEY SMAL_ROUTER=tcp/router:7447 2>&1) && status=0 || status=$?
check "a client without a certificate is rejected in one line" "exit status $status" \
  test "$status" != 0 -a "$(grep -c 'requires a certificate' <<<"$message")" = 1
seen=$(docker compose exec -T policy ls /run/secrets | xargs)
check "a container sees only its own key" "$seen" test "$seen" = "ca.pem cert.pem key.pem"
timed docker compose stop
unset COMPOSE_FILE

# The folder of another user keeps its owner.
message=$(SMAL_UID=$((SMAL_UID + 1)) docker compose run --rm --no-deps -T prepare 2>&1) && status=0 || status=$?
check "another user's folder is rejected in one line" "exit status $status" \
  test "$status" = 1 -a "$(grep -c 'start with SMAL_UID=' <<<"$message")" = 1

if [ -n "$with_tests" ]; then
  began=$SECONDS
  if docker compose run --rm -T tests; then status=0; else status=$?; fi
  check "docker compose run --rm tests" "exit status $status, $((SECONDS - began)) s" test "$status" = 0
fi

[ "$failures" = 0 ] || fail "$failures checks failed"
echo "all checks passed"
