#!/usr/bin/env bash
# Makes two hosts out of one Linux machine, to try runs under mpirun: two network namespaces with a cable between them.
# Each has a host name, a network address and a /dev/shm of its own; files are shared. Needs root, iproute2 and Open MPI.
#
#   scripts/two_hosts.sh up                 make them
#   scripts/two_hosts.sh run N PROGRAM ..   mpirun with N ranks, half of them on each host
#   scripts/two_hosts.sh bytes              bytes that host 1 has sent and received over the cable
#   scripts/two_hosts.sh cut | join         pull the cable, plug it in again
#   scripts/two_hosts.sh down               remove them
set -euo pipefail
shopt -s inherit_errexit

name=loomhost
address=10.93.7

# mpirun starts its helper on the other host with this script: it gets the host and a command.
if [ "${1:-}" = on ]; then
    host=$2
    shift 2
    inside='hostname "$0" && mount -t tmpfs none /dev/shm && exec sh -c "$1"'
    exec ip netns exec "$host" unshare --mount --uts sh -c "$inside" "$host" "$*"
fi

case "${1:-}" in
up)
    for host in 1 2; do
        ip netns add "$name$host"
        ip -n "$name$host" link set lo up
    done
    ip link add "${name}a" netns "${name}1" type veth peer name "${name}b" netns "${name}2"
    ip -n "${name}1" addr add "$address.1/24" dev "${name}a"
    ip -n "${name}2" addr add "$address.2/24" dev "${name}b"
    ip -n "${name}1" link set "${name}a" up
    ip -n "${name}2" link set "${name}b" up
    ;;
down)
    for host in 1 2; do ip netns delete "$name$host"; done
    ;;
cut) ip -n "${name}1" link set "${name}a" down ;;
join) ip -n "${name}1" link set "${name}a" up ;;
bytes)
    ip -n "${name}1" -s link show "${name}a" |
        awk '/RX:/ { getline; received = $1 } /TX:/ { getline; sent = $1 } END { print "sent", sent, "received", received }'
    ;;
run)
    ranks=$2
    shift 2
    export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
    export OMPI_MCA_rmaps_base_oversubscribe=1 OMPI_MCA_mpi_yield_when_idle=1 OMPI_MCA_hwloc_base_binding_policy=none
    export OMPI_MCA_btl_vader_single_copy_mechanism=none
    agent="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)/two_hosts.sh on"
    exec ip netns exec "${name}1" mpirun -n "$ranks" \
        --host "${name}1:$(((ranks + 1) / 2)),${name}2:$((ranks / 2))" \
        --mca plm_rsh_agent "$agent" --mca plm_rsh_no_tree_spawn 1 \
        --mca oob_tcp_if_include "$address.0/24" --mca btl_tcp_if_include "$address.0/24" "$@"
    ;;
*)
    sed -n '2,12s/^# \{0,1\}//p' "${BASH_SOURCE[0]}" >&2
    exit 2
    ;;
esac
