#!/usr/bin/env bash
# Starts a Valkey or Redis Cluster for RIBs on this host: three primaries with a replica each, TLS, ACLs.
#
#   scripts/start_cluster.sh DIR [ADDRESS]     keeps everything in DIR; listens on ADDRESS (127.0.0.1), on free ports
#   scripts/start_cluster.sh --stop DIR        ends the servers that it started; the data stay in DIR
#
# Writes DIR/store.yaml, the part of a rib.yaml that uses the cluster. Another start with the same DIR continues with the
# data. Needs: redis-server and redis-cli (or valkey-server and valkey-cli) of version 7 or later, openssl, python3.
set -euo pipefail
umask 077

say() { printf 'start_cluster: %s\n' "$*" >&2; }
fail() { say "$@"; exit 1; }
usage() { sed -n '2,8s/^# \{0,1\}//p' "${BASH_SOURCE[0]}" >&2; exit 2; }

nodes=6

stop() {
    local at pid ended=()
    for ((at = 1; at <= nodes; at++)); do
        [[ -f "$dir/$at/server.pid" ]] || continue
        pid=$(<"$dir/$at/server.pid")
        # the process id may belong to another process by now: a server of this script runs in its own folder
        if [[ "$(readlink "/proc/$pid/cwd" 2>/dev/null)" == "$dir/$at" ]]; then
            kill "$pid" && ended+=("$pid")
        fi
    done
    for pid in "${ended[@]}"; do  # all at once: a primary would wait ten seconds for a replica that lags
        while kill -0 "$pid" 2>/dev/null; do sleep 0.05; done
    done
    rm -f "$dir"/*/server.pid
}

[[ $# -ge 1 ]] || usage
if [[ "$1" == --stop ]]; then
    [[ $# -eq 2 ]] || usage
    dir=$(realpath -m "$2")
    stop
    exit 0
fi
[[ "$1" != -* && $# -le 2 ]] || usage
address=${2:-127.0.0.1}
mkdir -p "$1"
dir=$(realpath "$1")

for kind in valkey redis; do
    if command -v "$kind-server" >/dev/null && command -v "$kind-cli" >/dev/null; then break; fi
done
server=$(command -v "$kind-server") || fail "neither valkey-server nor redis-server is here: apt-get install redis-server"
cli=$(command -v "$kind-cli") || fail "$kind-cli is missing"
command -v openssl >/dev/null || fail "openssl is missing"

# free_ports: two for each server, one for clients and one for the other servers
free_ports() {
    python3 - "$address" "$((2 * nodes))" <<'PYTHON'
import socket
import sys

sockets = [socket.socket() for _ in range(int(sys.argv[2]))]
for each in sockets:
    each.bind((sys.argv[1], 0))
print(*(each.getsockname()[1] for each in sockets))
PYTHON
}

make_certificates() {
    openssl ecparam -name prime256v1 -genkey -noout -out "$dir/ca.key"
    openssl req -x509 -new -key "$dir/ca.key" -days 3650 -subj "/CN=RIB store" -out "$dir/ca.pem"
    openssl ecparam -name prime256v1 -genkey -noout -out "$dir/server.key"
    openssl req -new -key "$dir/server.key" -subj "/CN=$address" -out "$dir/server.csr"
    printf 'subjectAltName=IP:%s\n' "$address" >"$dir/server.ext"
    openssl x509 -req -in "$dir/server.csr" -CA "$dir/ca.pem" -CAkey "$dir/ca.key" -CAcreateserial -days 3650 \
        -extfile "$dir/server.ext" -out "$dir/server.pem" 2>/dev/null
    rm -f "$dir/server.csr" "$dir/server.ext" "$dir/ca.srl"
}

make_users() {
    local user
    for user in rib replica admin; do openssl rand -hex 24 >"$dir/$user.password"; done
    {
        # With these rights, which no connection gets, a server reads back what functions wrote (valkey issue 3983).
        echo "user default off ~* -@all +@write"
        echo "user rib on >$(<"$dir/rib.password") ~* &* -@all +@read +@write +@pubsub +@connection +@transaction" \
            "+fcall +function|load +cluster|slots +time -@dangerous"
        echo "user replica on >$(<"$dir/replica.password") +psync +replconf +ping"
        echo "user admin on >$(<"$dir/admin.password") ~* &* +@all"
    } >"$dir/users.acl"
}

configure() {
    local at=$1 port=$2 bus=$3
    mkdir -p "$dir/$at"
    cat >"$dir/$at/server.conf" <<CONF
bind $address
port 0
tls-port $port
tls-ca-cert-file $dir/ca.pem
tls-cert-file $dir/server.pem
tls-key-file $dir/server.key
tls-auth-clients no
tls-cluster yes
tls-replication yes
aclfile $dir/users.acl
masteruser replica
masterauth $(<"$dir/replica.password")
cluster-enabled yes
cluster-config-file nodes.conf
cluster-port $bus
cluster-node-timeout 500
cluster-require-full-coverage no
cluster-replica-validity-factor 0
repl-diskless-sync-delay 0
appendonly yes
save ""
dir $dir/$at
pidfile $dir/$at/server.pid
logfile $dir/$at/server.log
daemonize yes
CONF
}

if [[ ! -f "$dir/store.yaml" ]]; then
    make_certificates
    make_users
    read -r -a ports <<<"$(free_ports)"
    for ((at = 1; at <= nodes; at++)); do configure "$at" "${ports[$((at - 1))]}" "${ports[$((nodes + at - 1))]}"; done
fi
trap 'say "failed; see $dir/*/server.log"; stop' ERR
addresses=()
for ((at = 1; at <= nodes; at++)); do
    (cd "$dir/$at" && "$server" server.conf >/dev/null)
    addresses+=("$address:$(awk '$1 == "tls-port" { print $2 }' "$dir/$at/server.conf")")
done

ask() {
    local to=$1
    shift
    REDISCLI_AUTH=$(<"$dir/admin.password") VALKEYCLI_AUTH=$(<"$dir/admin.password") "$cli" --user admin --tls \
        --cacert "$dir/ca.pem" -h "$address" -p "${to##*:}" "$@"
}

await() {
    local what=$1 tries
    shift
    for ((tries = 0; tries < 600; tries++)); do
        if "$@" 2>/dev/null; then return; fi
        sleep 0.05
    done
    fail "$what did not happen within 30 s"
}
answers() { [[ "$(ask "$1" ping)" == PONG ]]; }
is_replicated() { ask "$1" info replication | grep -q '^master_link_status:up\|^slave0:.*state=online'; }
is_whole() { ask "$1" cluster info | grep -q '^cluster_state:ok' && [[ $(ask "$1" cluster nodes | wc -l) -eq $nodes ]]; }

for each in "${addresses[@]}"; do await "an answer of $each" answers "$each"; done
if [[ ! -f "$dir/store.yaml" ]]; then
    ask "${addresses[0]}" --cluster create "${addresses[@]}" --cluster-replicas 1 --cluster-yes >"$dir/create.log"
fi
for each in "${addresses[@]}"; do await "a whole cluster at $each" is_whole "$each"; done
for each in "${addresses[@]}"; do await "a replica that has everything, at $each" is_replicated "$each"; done
{
    echo "store:"
    echo "  cluster:"
    printf '    nodes: ["%s"' "${addresses[0]}"
    printf ', "%s"' "${addresses[@]:1}"
    printf ']\n'
    echo "    username: rib"
    echo "    password_file: $dir/rib.password"
    echo "    ca: $dir/ca.pem"
} >"$dir/store.yaml"
trap - ERR
echo "$dir/store.yaml"
