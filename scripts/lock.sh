#!/usr/bin/env bash
# Writes the locks of requirements/, each package with version and hashes, for every platform and Python from 3.10 on.
#
#   scripts/lock.sh                        newest versions that pyproject.toml allows
#   scripts/lock.sh --upgrade-package X    X alone; further arguments go to uv
#   scripts/lock.sh --check                fails if pyproject.toml changed since the locks were written; needs no network
#
# Needs uv (pip install uv; UV may name it) and a package index. All locks agree on versions: they are parts of dev.lock.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
# table <sed script>: lines of pyproject.toml, without blanks and order
table() {
    sed -n "$1" pyproject.toml | sed 's/^ *//; /^$/d' | LC_ALL=C sort
}

digest=$({
    table '/^requires-python = /p'
    table '/^dependencies = \[$/,/^\]$/p'
    table '/^\[project\.optional-dependencies\]$/,/^\[/{/^\[project\.o/p;/^\[/!p}'
    cat requirements/build.in
} | sha256sum)
stamp="# pyproject dependencies: sha256:${digest%% *}"
if [[ "${1-}" == --check ]]; then
    old=$(grep -LxF "$stamp" requirements/*.lock || true)
    [[ -z "$old" ]] || { printf '%s: older than pyproject.toml (run scripts/lock.sh)\n' $old >&2; exit 1; }
    exit
fi
uv=${UV:-uv}
command -v "$uv" >/dev/null || { printf 'lock: uv is needed (pip install uv)\n' >&2; exit 2; }

# compile <lock> <argument>...
compile() {
    local out=requirements/$1
    shift
    "$uv" pip compile --quiet --universal --python-version 3.10 --generate-hashes --no-annotate --no-header "$@" -o "$out"
}

[[ $# -gt 0 ]] || rm -f requirements/dev.lock
# rapidocr-onnxruntime asks for opencv-python, whose files would replace those of opencv-python-headless; only its models are used.
compile dev.lock --all-extras --no-emit-package opencv-python "$@" pyproject.toml
compile run.lock -c requirements/dev.lock --extra proxy --extra fog --extra scapy pyproject.toml
compile ros2.lock -c requirements/dev.lock --extra proxy --extra fog --extra scapy --extra ros2 pyproject.toml
compile build.lock -c requirements/dev.lock requirements/build.in
sed -i -e "1i $stamp" -e '/^# pyproject dependencies: /d' requirements/*.lock
