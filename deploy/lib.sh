# shellcheck shell=bash disable=SC2034 # used where it is sourced
# What the scripts of this folder share. Sourced, never run; it also makes the workspace root the current folder.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

export PATH="${CARGO_HOME:-$HOME/.cargo}/bin:$PATH"
target=${CARGO_TARGET_DIR:-target}

# The Rust version of the lock file and the lints. A machine that cannot download it may have the very same version under
# a moving name such as `stable`; then that is used.
channel=$(sed -n 's/^channel *= *"\(.*\)"/\1/p' rust-toolchain.toml)
if command -v rustup >/dev/null && ! grep -q "^$channel\b" <<<"$(rustup toolchain list)"; then
  for name in $(rustup toolchain list | cut -d ' ' -f 1); do
    if grep -q "^rustc ${channel//./\\.} " <<<"$(rustc "+$name" --version 2>/dev/null)"; then
      export RUSTUP_TOOLCHAIN=$name
      break
    fi
  done
fi

say() { printf '%s\n' "$@"; }

# die MESSAGE [EXIT-CODE]: exit codes as those of the binaries, 1 a fault at run time, 2 wrong usage.
die() {
  printf 'error: %s\n' "$1" >&2
  exit "${2:-1}"
}

# Prints the comment at the head of the script that was called.
usage() {
  sed -n '2,/^[^#]/{/^#/!d;s/^# \{0,1\}//;p}' "$0"
  exit 0
}

have() { command -v "$1" >/dev/null 2>&1; }

as_root() {
  if [ "$(id -u)" = 0 ]; then
    "$@"
  elif have sudo; then
    sudo "$@"
  else
    die "'$*' needs root, and there is no sudo: run it as root"
  fi
}

# free_port: a TCP port of 127.0.0.1 that nothing listens on.
free_port() { python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'; }

# wait_for SECONDS COMMAND...: tries the command ten times a second until it succeeds.
wait_for() {
  local deadline=$((SECONDS + $1))
  shift
  until "$@" >/dev/null 2>&1; do
    [ "$SECONDS" -lt "$deadline" ] || return 1
    sleep 0.1
  done
}

# listening PORT: whether a TCP port of 127.0.0.1 accepts connections.
listening() { (exec 3<>"/dev/tcp/127.0.0.1/$1") 2>/dev/null; }

# compose ARGUMENT...: Docker Compose, as the plugin or as the older stand-alone tool.
compose() {
  if docker compose version >/dev/null 2>&1; then
    docker compose "$@"
  else
    docker-compose "$@"
  fi
}
