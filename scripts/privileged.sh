#!/usr/bin/env bash
# Runs a command with the right to make network namespaces: as root, or else as root of a user namespace of its own.
#
#   scripts/privileged.sh COMMAND [ARGUMENT...]
#   scripts/privileged.sh --check          only reports, by its exit code, whether that is possible
set -euo pipefail

apart=(unshare --user --map-root-user --net --mount)

if [[ $(id -u) -eq 0 ]]; then
    [[ "$1" == "--check" ]] && exit 0
    exec "$@"
fi
if ! refusal=$("${apart[@]}" true 2>&1); then
    printf 'Unprivileged user namespaces are not allowed on this machine (%s).\n' "$refusal" >&2
    printf 'Run the same with sudo, or have root allow them (sysctl kernel.unprivileged_userns_clone=1,\n' >&2
    printf 'user.max_user_namespaces, or on Ubuntu kernel.apparmor_restrict_unprivileged_userns=0).\n' >&2
    exit 1
fi
[[ "$1" == "--check" ]] && exit 0
exec "${apart[@]}" "$@"
