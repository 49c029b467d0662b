#!/usr/bin/env bash
# Makes everything that SMAL needs on this machine: a Vulkan driver, Python, and .venv in the checkout.
# With --tests also Chromium, in which the tests try the page.
# Safe to run again; does nothing that is already done. Needs root only where a system package is missing.
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

# Mesa's software renderer can run SAPIEN from version 24.3 on.
mesa_version() { dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null || echo 0; }
mesa_ok() { dpkg --compare-versions "$(mesa_version)" ge 24.3; }

add_backports() {
  local codename=$1 mirror
  [ "$codename" = bookworm ] || return 0
  grep -rqs bookworm-backports /etc/apt/sources.list /etc/apt/sources.list.d && return 0
  # The mirror that this machine already uses: another one may not be reachable.
  mirror=$(sed -n 's/^URIs: *//p' /etc/apt/sources.list.d/*.sources 2>/dev/null | grep -v security | head -n 1 || true)
  [ -n "$mirror" ] || mirror=$(awk '$1 == "deb" {for (i = 2; i <= NF; i++) if ($i ~ /^https?:/) {print $i; exit}}' /etc/apt/sources.list 2>/dev/null || true)
  [ -n "$mirror" ] || fail "no Debian mirror found in the apt sources; add bookworm-backports yourself"
  echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] ${mirror%% *} bookworm-backports main" |
    as_root tee /etc/apt/sources.list.d/smal-backports.list >/dev/null
}

# By its path, since /sbin is not on everybody's PATH; read to the end, since `grep -q` would kill ldconfig (pipefail).
have_vulkan() { [ -n "$(/sbin/ldconfig -p | grep -F libvulkan.so.1 || true)" ]; }

install_vulkan() {
  if [ -e /dev/nvidiactl ] && have_vulkan; then return; fi
  if mesa_ok && have_vulkan; then return; fi
  command -v apt-get >/dev/null || fail "install a Vulkan driver (Mesa 24.3 or newer); this script knows apt only"
  local codename
  codename=$(. /etc/os-release && echo "${VERSION_CODENAME:-}")
  add_backports "$codename"
  if [ "$codename" = bookworm ]; then
    apt_install -t bookworm-backports mesa-vulkan-drivers libvulkan1
  else
    apt_install mesa-vulkan-drivers libvulkan1
  fi
  mesa_ok || fail "this system offers Mesa $(mesa_version); rendering needs 24.3 or newer (Debian 13, Ubuntu 25.04)"
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
  command -v apt-get >/dev/null || fail "the tests of the page need chromium on the PATH; this script knows apt only"
  apt_install chromium
  command -v chromium >/dev/null || fail "this system's package chromium brings no command of that name; install it yourself"
}

install_python() {
  python=$(find_python) && return
  apt_install python3 python3-venv
  python=$(find_python) || fail "needs Python 3.11 to 3.13"
}

install_packages() {
  local wanted stamp=.venv/smal-requirements
  wanted=$(cat deploy/requirements/dev.txt pyproject.toml | sha256sum)
  if [ -x .venv/bin/smal ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ] && .venv/bin/python -c '' 2>/dev/null; then return; fi
  say "installing the Python packages into .venv"
  [ -x .venv/bin/python ] && .venv/bin/python -c '' 2>/dev/null || "$python" -m venv --clear .venv
  # --no-deps: the list is complete, and sapien's own wish for opencv-python would break opencv-python-headless.
  .venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r deploy/requirements/dev.txt
  .venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
  printf '%s' "$wanted" >"$stamp"
}

case "${1:-}" in '' | --tests) ;; *) fail "unknown option $1; there is --tests" ;; esac
install_vulkan
install_python
install_packages
[ "${1:-}" != --tests ] || install_chromium
say "done: .venv/bin/smal"
