#!/usr/bin/env bash
# Fetches cloud-init's own schema of user data into .venv, for the tests. It does not install cloud-init, which would act
# on this machine at its next boot. Does nothing if the schema is there already.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
schema=${1:-$root/.venv/share/cloud-init/schema.json}
[[ -s "$schema" ]] && exit 0

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cd "$scratch"
# The user of apt may not write here; apt would warn about that at length.
fetch=(apt-get download -o APT::Sandbox::User=root cloud-init)
if ! "${fetch[@]}" >log 2>&1 && ! { apt-get update >log 2>&1 && "${fetch[@]}" >log 2>&1; }; then
    tail -n 5 log >&2
    exit 1
fi
dpkg -x cloud-init_*.deb .
mkdir -p "$(dirname "$schema")"
cp usr/lib/python3/dist-packages/cloudinit/config/schemas/schema-cloud-config-v1.json "$schema"
