#!/usr/bin/env bash
# Problems of OMPL.app, from their authors at a fixed commit or from a folder that has them; checksums are compared.
#
#   scripts/data/fetch.sh [FOLDER]
set -euo pipefail

from=https://raw.githubusercontent.com/ompl/omplapp/9c67afbb6354699f92dac6aeb637a63677597375/resources/3D
[[ $# -eq 0 ]] || from=file://$(realpath "$1")
cd "$(dirname "${BASH_SOURCE[0]}")"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
mkdir "$scratch/planning"
grep -v Slit SHA256SUMS | grep planning/ >"$scratch/sums"
while read -r _ file; do
    curl --fail --silent --location --output "$scratch/$file" "$from/${file#planning/}" || {
        printf 'error: no %s (name a folder that has it: scripts/data/fetch.sh FOLDER)\n' "$from/${file#planning/}" >&2
        exit 2
    }
done <"$scratch/sums"
(cd "$scratch" && sha256sum --check --quiet sums)
cp "$scratch"/planning/* planning/
