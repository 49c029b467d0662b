#!/usr/bin/env bash
# Installs the requirements of SMAL: a Vulkan driver, Python, and .venv in the checkout.
# With --tests also Chromium, for the tests of the page.
# Safe to run again: skips finished steps. Needs root only if a system package is missing.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"; else
    fail "needs root for: $*; run this as root once, or install it yourself"
  fi
}

apt_install() {
  say "installing $*"
  as_root apt-get update -q >/dev/null || say "warning: the package lists could not be updated"
  as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@" >/dev/null
}

# SAPIEN needs Mesa's software renderer 24.3 or newer.
mesa_version() { dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null || echo 0; }
mesa_ok() { dpkg --compare-versions "$(mesa_version)" ge 24.3; }

add_backports() {
  local codename=$1 mirror
  [ "$codename" = bookworm ] || return 0
  grep -rqs bookworm-backports /etc/apt/sources.list /etc/apt/sources.list.d && return 0
  # Use the configured mirror, because another mirror can be unreachable.
  mirror=$(sed -n 's/^URIs: *//p' /etc/apt/sources.list.d/*.sources 2>/dev/null | grep -v security | head -n 1 || true)
  [ -n "$mirror" ] || mirror=$(awk '$1 == "deb" {for (i = 2; i <= NF; i++) if ($i ~ /^https?:/) {print $i; exit}}' /etc/apt/sources.list 2>/dev/null || true)
  [ -n "$mirror" ] || fail "no Debian mirror found in the apt sources; add bookworm-backports yourself"
  echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] ${mirror%% *} bookworm-backports main" |
    as_root tee /etc/apt/sources.list.d/smal-backports.list >/dev/null
}

# /sbin is not on every PATH. `grep -q` would end ldconfig early, which pipefail reports as an error.
have_vulkan() { [ -n "$(/sbin/ldconfig -p | grep -F libvulkan.so.1 || true)" ]; }

install_vulkan() {
  if [ -e /dev/nvidiactl ] && have_vulkan; then return; fi
  if mesa_ok && have_vulkan; then return; fi
  command -v apt-get >/dev/null || fail "no Vulkan driver; install Mesa 24.3 or newer (this script supports apt only)"
  local codename
  codename=$(. /etc/os-release && echo "${VERSION_CODENAME:-}")
  add_backports "$codename"
  if [ "$codename" = bookworm ]; then
    apt_install -t bookworm-backports mesa-vulkan-drivers libvulkan1
  else
    apt_install mesa-vulkan-drivers libvulkan1
  fi
  mesa_ok || fail "Mesa $(mesa_version) is too old; rendering needs 24.3 or newer (Debian 13, Ubuntu 25.04)"
}

find_python() {
  local candidate
  for candidate in python3.13 python3.12 python3.11 python3; do
    if "$candidate" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
  return 1
}

install_chromium() {
  command -v chromium >/dev/null && return
  command -v apt-get >/dev/null || fail "chromium not found; install it on the PATH for the tests of the page (this script supports apt only)"
  apt_install chromium
  command -v chromium >/dev/null || fail "the package chromium has no command chromium; install Chromium yourself"
}

install_python() {
  python=$(find_python) && return
  apt_install python3 python3-venv
  python=$(find_python) || fail "Python 3.11 to 3.13 not found; install it"
}

install_packages() {
  local wanted stamp=.venv/smal-requirements
  wanted=$(cat deploy/requirements/dev.txt pyproject.toml | sha256sum)
  if [ -x .venv/bin/smal ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ] && .venv/bin/python -c '' 2>/dev/null; then return; fi
  say "installing the Python packages into .venv"
  [ -x .venv/bin/python ] && .venv/bin/python -c '' 2>/dev/null || "$python" -m venv --clear .venv
  # --no-deps: the list is complete, and sapien's requirement opencv-python conflicts with opencv-python-headless.
  .venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r deploy/requirements/dev.txt
  .venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
  printf '%s' "$wanted" >"$stamp"
}

case "${1:-}" in '' | --tests) ;; *) fail "unknown option $1; use --tests" ;; esac
install_vulkan
install_python
install_packages
[ "${1:-}" != --tests ] || install_chromium
say "done; next: source .venv/bin/activate"
