#!/usr/bin/env bash
# Installs this package and its requirements into .venv; an up-to-date .venv takes well under a second.
#
#   scripts/setup.sh          to run
#   scripts/setup.sh --ros2   to run where no ROS 2 is installed: with a real one from the package index
#   scripts/setup.sh --dev    to test as well, with all that tests use: ROS 2, Cyclone DDS, SkyPilot, ROS 1 from Debian
#   scripts/setup.sh --quiet  for scripts: says nothing where .venv is up to date
#
# Needs: python3 >= 3.10; PYTHON=/usr/bin/python3 chooses one, such as the distribution's next to a ROS. System
# packages are installed only where something is missing, and only as root. Python packages are those of requirements/,
# by version and hash: pip refuses anything else.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
venv=$root/.venv
dev="[dev,bench,cluster,dds,ros2,aws,skypilot,experiments,pkcs11]"
# what to install, its list in requirements/, how long that takes; the environments that have all of it
extras="" lock=run duration="about a minute" enough=("" "[ros2]" "$dev")
is_quiet=false

say() { printf 'setup: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }

for option in "$@"; do
    case "$option" in
        --dev) extras=$dev lock=dev duration="five minutes or more" enough=("$dev") ;;
        --ros2) [[ $lock == dev ]] || extras="[ros2]" lock=ros2 duration="a few minutes" enough=("[ros2]" "$dev") ;;
        --quiet) is_quiet=true ;;
        *) say "unknown option $option; there are --ros2, --dev and --quiet"; exit 2 ;;
    esac
done

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11 python3.10}; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    fail "python3 of version 3.10 or later is needed; found: $("${PYTHON:-python3}" --version 2>&1 || true)"
}

# package <name> <why>: installs one Debian package
package() {
    command -v apt-get >/dev/null || fail "$1 is missing ($2), and there is no apt-get here: install it with your own tool"
    [[ $(id -u) -eq 0 ]] || fail "$1 is missing ($2): run 'sudo apt-get install $1', or this script with sudo"
    say "installing $1 ($2)"
    local log
    log=$(mktemp)
    local install=(env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$1")
    if ! "${install[@]}" >"$log" 2>&1 && ! { apt-get update >"$log" 2>&1 && "${install[@]}" >"$log" 2>&1; }; then
        tail -n 20 "$log" >&2
        rm -f "$log"
        fail "apt-get could not install $1"
    fi
    rm -f "$log"
}

# package_without_service <name> <why>: as package, but the system does not start its service: tests start their own
package_without_service() {
    local mask=/etc/systemd/system/$1.service
    if [[ -d /run/systemd/system && ! -e "$mask" ]]; then ln -s /dev/null "$mask"; fi
    RUNLEVEL=1 package "$1" "$2"
}

# hand_over <path>...: under sudo, new files belong to the calling user, not to root
hand_over() {
    if [[ $(id -u) -eq 0 && -n "${SUDO_UID:-}" && "${SUDO_UID}" != 0 ]]; then
        chown -R --no-dereference "$SUDO_UID:${SUDO_GID:-$SUDO_UID}" "$@"
    fi
}

# link_scripts: lets every Python of the environment import what no wheel contains: packages of scripts/ and the example
link_scripts() {
    local folder
    folder=$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    printf '%s\n' "$root/scripts" "$root/examples/grasp" >"$folder/gdp_scripts.pth"
}

# compile_own: builds the burst core where possible, and byte-compiles our packages: root leaves no caches of its own
compile_own() {
    "$venv/bin/python" -m compileall -q gdp proxy fog gdp_extensions scripts/ring scripts/fog_demo scripts/lab scripts/internet_demo scripts/memory_demo scripts/fleet_demo.py examples/grasp/grasp || fail "the source does not compile"
    make --silent -C gdp/burst "PYTHON=$venv/bin/python" 2>/dev/null || true
    if [[ $(id -u) -eq 0 && -n "${SUDO_UID:-}" ]]; then
        find gdp proxy fog gdp_extensions scripts examples \( -name __pycache__ -o -name core.abi3.so \) -user 0 -exec chown -R "$SUDO_UID:${SUDO_GID:-$SUDO_UID}" {} +
    fi
}

python=$(find_python)
wanted=$({ cat pyproject.toml requirements/*.lock; "$python" --version; echo "$root"; } | sha256sum | cut -d' ' -f1)
for each in "${enough[@]}"; do
    stamp=$venv/.installed$each
    if [[ -f "$stamp" && $(<"$stamp") == "$wanted" ]] && "$venv/bin/python" -c '' 2>/dev/null; then
        link_scripts
        compile_own
        $is_quiet || say "up to date"
        exit 0
    fi
done

command -v ip >/dev/null || [[ -x /usr/sbin/ip ]] || package iproute2 "ip netns: to look into the namespaces of a ring"
for tool in nsenter setpriv unshare; do
    command -v "$tool" >/dev/null || package util-linux "$tool: to start processes inside namespaces"
done
"$python" -c 'import ensurepip, venv; ensurepip.version()' 2>/dev/null ||
    package "$(basename "$python")-venv" "python3 cannot make virtual environments without it"
if [[ "$extras" == "$dev" ]]; then
    if [[ $(id -u) -eq 0 ]] && command -v apt-get >/dev/null; then
        scripts/setup_ros1.sh || say "tests of ROS 1 will be skipped"
    fi
    command -v redis-server >/dev/null || command -v valkey-server >/dev/null ||
        package_without_service redis-server "tests of RIBs that share a cluster start it"
    command -v softhsm2-util >/dev/null || package softhsm2 "tests keep keys in its tokens"
    command -v wireguard-go >/dev/null || package wireguard-go "tests make tunnels with it; no kernel module is needed"
    command -v nft >/dev/null || [[ -x /usr/sbin/nft ]] || package nftables "tests of NAT make it with nft"
    command -v conntrack >/dev/null || [[ -x /usr/sbin/conntrack ]] || package conntrack "tests let a NAT forget with it"
    command -v wg >/dev/null || package wireguard-tools "the bench of uplinks starts a peer with it"
    command -v mmdebstrap >/dev/null || package mmdebstrap "tests boot a cloud machine from a minimal Debian"
    command -v dh >/dev/null || package debhelper "a test builds the Debian package"
    command -v lintian >/dev/null || package lintian "a test checks the Debian package with it"
    command -v buildah >/dev/null || package buildah "a test builds the image with it"
    command -v openssl >/dev/null || package openssl "tests read our certificates with it"
    command -v chromium >/dev/null || package chromium "tests open the page of the live view in it"
    command -v chromedriver >/dev/null || package chromium-driver "tests drive chromium with it"
    command -v mandoc >/dev/null || package mandoc "a test checks the manual pages with it"
    command -v zsh >/dev/null || package zsh "tests complete words in it"
    command -v fish >/dev/null || package fish "tests complete words in it"
    command -v promtool >/dev/null || package_without_service prometheus "tests check alert rules with its promtool"
    command -v tshark >/dev/null || package tshark "tests compare our Wireshark dissector with Scapy"
    command -v mkfs.xfs >/dev/null || [[ -x /usr/sbin/mkfs.xfs ]] || package xfsprogs "a test cuts the power of a disk that it clones"
    command -v cmake >/dev/null || package cmake "a test builds interfaces of ROS 2 that have no wheels"
fi

if ! "$venv/bin/python" -c 'import pip' 2>/dev/null; then
    say "making .venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
fi
count=$(grep -oE '^[A-Za-z0-9._-]+' "requirements/$lock.lock" | sort -u | wc -l)
say "installing this package and the $count packages of requirements/$lock.lock (once; $duration)"
log=$(mktemp)
trap 'rm -f "$log"' EXIT
pip() { "$venv/bin/python" -m pip install --disable-pip-version-check --no-input --no-deps "$@" >"$log" 2>&1; }
# The build requirements are pinned too, so they are installed first, not fetched into a build environment.
if ! pip --require-hashes -r requirements/build.lock || ! pip --require-hashes -r "requirements/$lock.lock" ||
    ! pip --no-build-isolation -e .; then
    tail -n 25 "$log" >&2
    fail "pip could not install the package; the lines above say why"
fi
if [[ "$extras" == "$dev" ]] && command -v apt-get >/dev/null; then
    scripts/setup_cloud_schema.sh || say "the test of user data against cloud-init's schema will be skipped"
fi
rm -f "$venv"/.installed*
printf '%s\n' "$wanted" >"$venv/.installed$extras"
link_scripts
compile_own
say "burst core: $([[ -e gdp/burst/core.abi3.so ]] && echo compiled || echo "Python, without make, cc, or headers of Python or OpenSSL")"
hand_over "$venv" ./*.egg-info
say "done"
